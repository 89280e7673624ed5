"""Effects of actuators: gain, kp, offset, delay, lag, activation, dead band, play, saturation."""

from __future__ import annotations

import itertools
import math

import mujoco
import numpy as np
import torch
from scipy.signal import lfilter

from dropo_torch.effects.base import Effect, Quantity, Setting, object_number

_NONE, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


class ActuatorEffect(Effect):
    """An effect of one actuator that is commanded in the log."""

    kind = "actuator"

    def targets(self, setting: Setting) -> list[str | None]:
        m, command = setting.model, setting.signals.command
        commanded = [m.actuator_ctrlnum[i] == 1 and command[m.actuator_ctrladr[i]] > 0 for i in range(m.nu)]
        return list(itertools.compress(setting.names("actuator"), commanded))

    @staticmethod
    def force_scale(setting: Setting, target: str | None) -> float:
        """Return the typical force of an actuator, in its own units."""
        m, i = setting.model, object_number(setting.model, "actuator", target)
        joint, servo = driven_joint(m, i), m.actuator_biasprm[i, 1:3].any()
        if servo and joint is not None:  # its force is of the error
            return float(setting.signals.force[m.jnt_dofadr[joint]]) / gear(m, i)
        return 0.3 * abs(float(m.actuator_gainprm[i, 0])) * ActuatorEffect.command_scale(setting, target)

    @staticmethod
    def command_scale(setting: Setting, target: str | None) -> float:
        """Return the largest command of the log."""
        return float(setting.signals.command[setting.command_column(target)])


def driven_joint(model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the joint through which an actuator drives."""
    through = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    return int(model.actuator_trnid[actuator, 0]) if through else None


def gear(model: mujoco.MjModel, actuator: int) -> float:
    """Return the size of an actuator's gear ratio."""
    return max(abs(float(model.actuator_gear[actuator, 0])), 1e-9)


def is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator pulls toward a target: its force is of the error between command and length."""
    fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    affine, kp = model.actuator_biastype[actuator] == _AFFINE, model.actuator_gainprm[actuator, 0]
    return bool(fixed and affine and kp != 0 and np.isclose(model.actuator_biasprm[actuator, 1], -kp))


def unit_of(setting: Setting, target: str | None, turning: str, sliding: str) -> str:
    """Of two units that of an actuator, by whether its force turns or slides what it acts on; none where it does both.

    Of a tendon over joints and of a site, by these joints, or its lever arms, and by which components the gear has.
    """
    model = setting.model
    i = object_number(model, "actuator", target)
    kind, through, kinds = int(model.actuator_trntype[i]), int(model.actuator_trnid[i, 0]), mujoco.mjtTrn
    if kind in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
        slides = {_slides(model, through, i)}
    elif kind == kinds.mjTRN_TENDON:
        wraps = range(model.tendon_adr[through], model.tendon_adr[through] + model.tendon_num[through])
        over = [w for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
        arms = any(abs(model.wrap_prm[w]) != 1 for w in over)  # lever arms: what turns with one pulls along its length
        slides = {arms or _slides(model, int(model.wrap_objid[w]), i) for w in over} or {True}  # so does one in space
    elif kind == kinds.mjTRN_SITE:
        slides = {half == 0 for half in (0, 1) if model.actuator_gear[i, 3 * half : 3 * half + 3].any()}
    else:
        slides = {True}
    return {frozenset({True}): sliding, frozenset({False}): turning}.get(frozenset(slides), "")


def _slides(model: mujoco.MjModel, joint: int, actuator: int) -> bool:
    """Whether a force on a joint is in newtons; on a free one, by the components that the actuator's gear has."""
    kind, kinds = int(model.jnt_type[joint]), mujoco.mjtJoint
    return kind == kinds.mjJNT_SLIDE or (kind == kinds.mjJNT_FREE and not model.actuator_gear[actuator, 3:].any())


def make_affine(model: mujoco.MjModel, actuator: int) -> None:
    """Let an actuator without bias have an affine one, which is still zero."""
    if model.actuator_biastype[actuator] == _NONE:
        model.actuator_biastype[actuator] = _AFFINE
        model.actuator_biasprm[actuator] = 0.0


class ActuatorGain(ActuatorEffect):
    """An actuator that is weaker or stronger than the model's: its whole force is scaled."""

    name = "actuator_gain"
    sentence = "actuator {target} gives another force for the same command than in the model"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("gain", "-", 1.0, 0.05, 10.0, 0.5),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "actuator", target)
        model.actuator_gainprm[i, :3] *= values[0]
        model.actuator_biasprm[i, :3] *= values[0]


class ActuatorStiffness(ActuatorEffect):
    """A servo that pulls toward its target with another kp than the model's, and brakes with the same kv.

    For servos that have a kv: of others the whole force changes, which is a gain.
    """

    name = "actuator_stiffness"
    sentence = "actuator {target} pulls toward its target with another kp than in the model"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        numbers = {t: object_number(m, "actuator", t) for t in super().targets(setting)}
        return [t for t, i in numbers.items() if is_servo(m, i) and m.actuator_biasprm[i, 2] != 0]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("factor", "-", 1.0, 0.05, 10.0, 0.5),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "actuator", target)
        model.actuator_gainprm[i, 0] *= values[0]
        model.actuator_biasprm[i, 1] *= values[0]


class ActuatorBias(ActuatorEffect):
    """A constant force that an actuator adds."""

    name = "actuator_bias"
    sentence = "actuator {target} adds a constant force to what is commanded"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        scale = self.force_scale(setting, target)
        return (Quantity("force", unit_of(setting, target, "N·m", "N"), 0.0, -10 * scale, 10 * scale, scale),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "actuator", target)
        make_affine(model, i)
        model.actuator_biasprm[i, 0] += values[0]


class ActuatorDamping(ActuatorEffect):
    """A force of the actuator against its velocity, such as a motor's back-EMF."""

    name = "actuator_damping"
    sentence = "actuator {target} brakes in proportion to its velocity, such as by back-EMF"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, i = setting.model, object_number(setting.model, "actuator", target)
        scale = self.force_scale(setting, target) / max(self.speed_scale(setting, target), 1e-12)
        own = max(-float(m.actuator_biasprm[i, 2]), 0.0)
        unit = unit_of(setting, target, "N·m·s/rad", "N·s/m")
        return (Quantity("damping", unit, 0.0, -own, 30 * scale, scale),)

    def targets(self, setting: Setting) -> list[str | None]:
        """Return the actuators that drive a joint, or pull a tendon that moves in the log."""
        m = setting.model
        return [
            t for t in super().targets(setting)
            if driven_joint(m, i := object_number(m, "actuator", t)) is not None
            or (m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON and self.speed_scale(setting, t) > 0)
        ]  # fmt: skip

    @staticmethod
    def speed_scale(setting: Setting, target: str | None) -> float:
        """Return the typical speed of an actuator, times its gear; of a tendon's, by its lever arms at ``qpos0``."""
        m, i = setting.model, object_number(setting.model, "actuator", target)
        if (joint := driven_joint(m, i)) is not None:
            return gear(m, i) * float(setting.signals.speed[m.jnt_dofadr[joint]])
        data, moment = mujoco.MjData(m), np.zeros((m.nu, m.nv))
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_tendon(m, data)
        mujoco.mj_transmission(m, data)
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        return float(np.linalg.norm(moment[i] * setting.signals.speed))

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "actuator", target)
        make_affine(model, i)
        model.actuator_biasprm[i, 2] -= values[0]


class ActuatorDelay(ActuatorEffect):
    """A command that arrives late."""

    name = "actuator_delay"
    sentence = "commands reach actuator {target} late"
    everywhere_like = ("sensor_delay",)
    shares = (0.4, 2.0, 5.0)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("delay", "s", 0.0, 0.0, 20 * setting.signals.timestep, setting.signals.timestep),)

    def memory(self, values: np.ndarray) -> float:
        return float(values[0])

    def settled(self, command: torch.Tensor, values: torch.Tensor, step: float) -> torch.Tensor:
        """Return as many past commands as the longest delay asks for."""
        return command.expand(-1, int(values[:, 0].max() / step) + 1)

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Shift in time; a physics step takes the mean over it of what arrives. The state is the last commands."""
        late = values[:, :1] / step
        whole = late.floor()
        part = late - whole
        known = torch.cat([state, signal], 1)
        at = state.shape[1] + torch.arange(signal.shape[1], device=signal.device) - whole.long()
        at = at.expand(len(signal), -1)
        return (1 - part) * known.gather(1, at) + part * known.gather(1, at - 1), known[:, signal.shape[1] :]


class ActuatorLag(ActuatorEffect):
    """A command that acts through a first-order filter."""

    name = "actuator_lag"
    sentence = "actuator {target} follows its command with a first-order lag"
    everywhere_like = ("actuator_delay",)
    shares = (0.4, 2.0, 5.0)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("time_constant", "s", 0.0, 0.0, 50 * setting.signals.timestep, setting.signals.timestep),)

    def memory(self, values: np.ndarray) -> float:
        """Return the time after which a step is followed to 3e-4."""
        return 8 * float(values[0])

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Filter exactly; a physics step takes the mean over it of the filter's output, which is the state."""
        tau = values[:, :1]
        absent = tau <= 1e-6 * step
        tau = torch.where(absent, step, tau)
        passed = torch.full_like(tau, -step) / tau
        decay = torch.where(absent, 0.0, torch.exp(passed))
        after = first_order(signal, decay, state)
        before = torch.cat([state, after[:, :-1]], 1)
        mean = signal + (before - signal) * (tau / step) * -torch.expm1(passed)
        return torch.where(absent, signal, mean), after[:, -1:]


def first_order(signal: torch.Tensor, decay: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Return y[s] = decay·y[s - 1] + (1 - decay)·signal[s], ``(R, S)``.

    Args:
        signal: what is filtered, ``(R, S)``.
        decay: of each row ``(R, 1)``, or of all ``(1, 1)``.
        before: y before the first step, ``(R, 1)``.
    """
    if len(decay) == 1 and signal.device.type == "cpu":  # one pass, however long
        d = float(decay)
        out, _ = lfilter([1 - d], [1, -d], signal.numpy(), axis=1, zi=d * before.numpy())
        return torch.from_numpy(out)
    out = (1 - decay) * signal
    out[:, :1] += decay * before
    reach = 1
    while reach < signal.shape[1]:  # sums over 1, 2, 4, ... steps
        out = torch.cat([out[:, :reach], out[:, reach:] + decay * out[:, :-reach]], 1)
        decay, reach = decay**2, 2 * reach
    return out


class ActuatorTimeConstant(ActuatorEffect):
    """A first-order activation, as a model's own ``dyntype`` has it, with another time constant than the model's."""

    name = "actuator_time_constant"
    sentence = "the force of actuator {target} builds up with another time constant than in the model"

    def targets(self, setting: Setting) -> list[str | None]:
        m, kinds = setting.model, (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
        numbers = {t: object_number(m, "actuator", t) for t in super().targets(setting)}
        return [t for t, i in numbers.items() if int(m.actuator_dyntype[i]) in kinds and m.actuator_dynprm[i, 0] > 0]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        own = float(setting.model.actuator_dynprm[object_number(setting.model, "actuator", target), 0])
        least = min(own, max(0.1 * own, setting.signals.timestep / setting.frame_skip))  # a shorter one is unstable
        return (Quantity("time_constant", "s", own, least, 5 * own, 0.5 * own),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        model.actuator_dynprm[object_number(model, "actuator", target), 0] = values[0]


class ActuatorDeadband(ActuatorEffect):
    """Small commands that do nothing."""

    name = "actuator_deadband"
    sentence = "small commands do nothing at actuator {target}"
    shares = (0.03, 0.15)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        largest = self.command_scale(setting, target)
        return (Quantity("width", "command", 0.0, 0.0, largest, largest),)

    def memory(self, values: np.ndarray) -> float:
        return 0.0

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Take the width off every command; it remembers nothing."""
        return signal.sign() * (signal.abs() - values[:, :1]).clamp(min=0.0), state


class ActuatorBacklash(ActuatorEffect):
    """Play in the transmission: a reversed command first crosses a gap."""

    name = "actuator_backlash"
    sentence = "actuator {target} has play: a reversed command first crosses a gap"
    shares = (0.03, 0.2)

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        largest = self.command_scale(setting, target)
        return (Quantity("width", "command", 0.0, 0.0, 2 * largest, largest),)

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Hold what is within half the width of the command; the state is what is held.

        Each step clamps what was held to its limits. A clamp after a clamp is again one, so that those of 1, 2, 4, ...
        steps are found in turn, and no step waits for the one before.
        """
        half = 0.5 * values[:, :1]
        low, high = signal - half, signal + half
        reach = 1
        while reach < signal.shape[1]:
            low, high = (
                torch.cat([x[:, :reach], x[:, :-reach].clamp(low[:, reach:], high[:, reach:])], 1) for x in (low, high)
            )
            reach *= 2
        held = state.clamp(low, high)
        return held, held[:, -1:]


class ActuatorSaturation(ActuatorEffect):
    """A force that an actuator cannot exceed; where the model has such a limit, another one than that.

    Of a model's range of forces the larger end is the limit; the other one changes in proportion.
    """

    name = "actuator_saturation"
    sentence = "actuator {target} cannot give more than a certain force"
    shares = (0.3, 0.5, 0.7, 0.85)

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        return [t for t in super().targets(setting) if self.own(m, object_number(m, "actuator", t)) > 0]

    @staticmethod
    def own(model: mujoco.MjModel, i: int) -> float:
        """Return the largest force that a model allows an actuator."""
        return float(np.abs(model.actuator_forcerange[i]).max()) if model.actuator_forcelimited[i] else math.inf

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, i = setting.model, object_number(setting.model, "actuator", target)
        largest = abs(float(m.actuator_gainprm[i, 0])) * self.command_scale(setting, target)
        if m.actuator_biasprm[i, 1] != 0:  # of a servo, roughly
            largest = 3 * self.force_scale(setting, target)
        unit = unit_of(setting, target, "N·m", "N")
        own = self.own(m, i)
        absent = own if own < math.inf else 4 * largest
        return (Quantity("limit", unit, absent, 0.02 * min(largest, absent), max(4 * largest, absent), largest),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = object_number(model, "actuator", target)
        own = self.own(model, i)
        ends = model.actuator_forcerange[i] / own if own < math.inf else np.array([-1.0, 1.0])
        model.actuator_forcelimited[i] = 1
        model.actuator_forcerange[i] = values[0] * ends
