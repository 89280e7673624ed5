"""Effects of actuators: gain, offset, delay, lag, dead band, play, saturation."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.signal import lfilter

from dropo_torch.effects.base import Effect, Quantity, Setting
from dropo_torch.parameters import object_names

_NONE, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


def actuator_number(model: mujoco.MjModel, target: str | None) -> int:
    """Return the number of an actuator by its name; one without a name is called by its joint's."""
    return object_names(model, "actuator").index(str(target))


class ActuatorEffect(Effect):
    """An effect of one actuator that is commanded in the log."""

    kind = "actuator"

    def targets(self, setting: Setting) -> list[str | None]:
        names = setting.names("actuator")
        return [
            n for i, n in enumerate(names)
            if setting.model.actuator_ctrlnum[i] == 1 and setting.signals.command[setting.model.actuator_ctrladr[i]] > 0
        ]  # fmt: skip

    @staticmethod
    def force_scale(setting: Setting, target: str | None) -> float:
        """Return the typical force of an actuator, in its own units."""
        m, i = setting.model, actuator_number(setting.model, target)
        gain = abs(float(m.actuator_gainprm[i, 0]))
        command = float(setting.signals.command[m.actuator_ctrladr[i]])
        if m.actuator_biasprm[i, 1] != 0 or m.actuator_biasprm[i, 2] != 0:  # a servo's force is of the error
            dof = transmission_dof(m, i)
            if dof is not None:
                return float(setting.signals.force[dof]) / max(abs(float(m.actuator_gear[i, 0])), 1e-9)
        return 0.3 * gain * command

    @staticmethod
    def command_scale(setting: Setting, target: str | None) -> float:
        """Return the largest command of the log."""
        return float(setting.signals.command[setting.model.actuator_ctrladr[actuator_number(setting.model, target)]])


def transmission_dof(model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the degree of freedom that an actuator drives through a joint."""
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        return None
    return int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])


def _unit(setting: Setting, target: str | None, hinge: str, slide: str) -> str:
    m, i = setting.model, actuator_number(setting.model, target)
    slides = (
        m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        and m.jnt_type[m.actuator_trnid[i, 0]] == mujoco.mjtJoint.mjJNT_SLIDE
    )
    return slide if slides else hinge


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
        i = actuator_number(model, target)
        model.actuator_gainprm[i, :3] *= values[0]
        model.actuator_biasprm[i, :3] *= values[0]


class ActuatorBias(ActuatorEffect):
    """A constant force that an actuator adds."""

    name = "actuator_bias"
    sentence = "actuator {target} adds a constant force to what is commanded"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        scale = self.force_scale(setting, target)
        return (Quantity("force", _unit(setting, target, "N·m", "N"), 0.0, -10 * scale, 10 * scale, scale),)

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = actuator_number(model, target)
        make_affine(model, i)
        model.actuator_biasprm[i, 0] += values[0]


class ActuatorDamping(ActuatorEffect):
    """A force of the actuator against its velocity, such as a motor's back-EMF."""

    name = "actuator_damping"
    sentence = "actuator {target} brakes in proportion to its velocity, such as by back-EMF"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        m, i = setting.model, actuator_number(setting.model, target)
        dof = transmission_dof(m, i)
        gear = max(abs(float(m.actuator_gear[i, 0])), 1e-9)
        speed = gear * float(setting.signals.speed[dof if dof is not None else 0])
        scale = self.force_scale(setting, target) / max(speed, 1e-12)
        own = max(-float(m.actuator_biasprm[i, 2]), 0.0)
        unit = _unit(setting, target, "N·m·s/rad", "N·s/m")
        return (Quantity("damping", unit, 0.0, -own, 30 * scale, scale),)

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        found = super().targets(setting)
        return [t for t in found if transmission_dof(m, actuator_number(m, t)) is not None]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = actuator_number(model, target)
        make_affine(model, i)
        model.actuator_biasprm[i, 2] -= values[0]


class ActuatorSaturation(ActuatorEffect):
    """A force that an actuator cannot exceed."""

    name = "actuator_saturation"
    sentence = "actuator {target} cannot give more than a certain force"

    def targets(self, setting: Setting) -> list[str | None]:
        m = setting.model
        found = super().targets(setting)
        return [t for t in found if not m.actuator_forcelimited[actuator_number(m, t)]]

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        largest = self.largest(setting, target)
        low = 0.02 * largest
        return (Quantity("limit", _unit(setting, target, "N·m", "N"), 4 * largest, low, 4 * largest, largest),)

    def largest(self, setting: Setting, target: str | None) -> float:
        """Return the largest force that the log asks for, roughly."""
        m, i = setting.model, actuator_number(setting.model, target)
        if m.actuator_biasprm[i, 1] != 0:
            return 3 * self.force_scale(setting, target)
        return abs(float(m.actuator_gainprm[i, 0])) * self.command_scale(setting, target)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        largest = self.largest(setting, target)
        return [np.array([share * largest]) for share in (0.3, 0.5, 0.7, 0.85)]

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        i = actuator_number(model, target)
        model.actuator_forcelimited[i] = 1
        model.actuator_forcerange[i] = (-values[0], values[0])


class CommandEffect(ActuatorEffect):
    """An effect on the command before it reaches the actuator, which MJCF cannot express."""

    native = False


class ActuatorDelay(CommandEffect):
    """A command that arrives late."""

    name = "actuator_delay"
    sentence = "commands reach actuator {target} late"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("delay", "s", 0.0, 0.0, 20 * setting.signals.timestep, setting.signals.timestep),)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([k * setting.signals.timestep]) for k in (0.4, 2.0, 5.0)]

    def memory(self, values: np.ndarray) -> float:
        return float(values[0])

    def command(self, signal: np.ndarray, actuator: int, step: float, values: np.ndarray) -> np.ndarray:
        """Shift in time; a physics step takes the mean over it of what arrives."""
        whole, part = divmod(float(values[0]) / step, 1.0)
        late = np.arange(signal.shape[1]) - int(whole)
        return (1 - part) * signal[:, np.maximum(late, 0)] + part * signal[:, np.maximum(late - 1, 0)]


class ActuatorLag(CommandEffect):
    """A command that acts through a first-order filter."""

    name = "actuator_lag"
    sentence = "actuator {target} follows its command with a first-order lag"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("time_constant", "s", 0.0, 0.0, 50 * setting.signals.timestep, setting.signals.timestep),)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([k * setting.signals.timestep]) for k in (0.4, 2.0, 5.0)]

    def memory(self, values: np.ndarray) -> float:
        """Return the time after which a step is followed to 3e-4."""
        return 8 * float(values[0])

    def command(self, signal: np.ndarray, actuator: int, step: float, values: np.ndarray) -> np.ndarray:
        """Filter exactly; a physics step takes the mean over it of the filter's output."""
        tau = float(values[0])
        if tau <= 1e-6 * step:
            return signal
        decay = np.exp(-step / tau)
        state, _ = lfilter([1 - decay], [1, -decay], signal, axis=1, zi=decay * signal[:, :1])
        before = np.concatenate([signal[:, :1], state[:, :-1]], axis=1)
        return signal + (before - signal) * (tau / step) * -np.expm1(-step / tau)


class ActuatorDeadband(CommandEffect):
    """Small commands that do nothing."""

    name = "actuator_deadband"
    sentence = "small commands do nothing at actuator {target}"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        largest = self.command_scale(setting, target)
        return (Quantity("width", "command", 0.0, 0.0, largest, largest),)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([share * self.command_scale(setting, target)]) for share in (0.03, 0.15)]

    def memory(self, values: np.ndarray) -> float:
        return 0.0

    def command(self, signal: np.ndarray, actuator: int, step: float, values: np.ndarray) -> np.ndarray:
        return np.sign(signal) * np.maximum(np.abs(signal) - values[0], 0.0)


class ActuatorBacklash(CommandEffect):
    """Play in the transmission: a reversed command first crosses a gap."""

    name = "actuator_backlash"
    sentence = "actuator {target} has play: a reversed command first crosses a gap"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        largest = self.command_scale(setting, target)
        return (Quantity("width", "command", 0.0, 0.0, 2 * largest, largest),)

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([share * self.command_scale(setting, target)]) for share in (0.03, 0.2)]

    def command(self, signal: np.ndarray, actuator: int, step: float, values: np.ndarray) -> np.ndarray:
        half = 0.5 * float(values[0])
        out = np.empty_like(signal)
        held = signal[:, 0].copy()
        changes = np.append(True, (np.diff(signal, axis=1) != 0).any(0))
        for s in range(signal.shape[1]):
            if changes[s]:
                held = np.clip(held, signal[:, s] - half, signal[:, s] + half)
            out[:, s] = held
        return out
