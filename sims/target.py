"""Targets that stand for real robots: what reality has and the bundled models lack, and what its equipment writes.

Nothing here is a simulator or an effect of the library. The loop is MuJoCo's own step, a fifth as long as the models',
with forces that are computed before each of them; sensors are sampled at times of their own. The same target yields
a raw log (:func:`write_raw`) and carries out a policy's commands.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.models.bundled import BundledSim
from dropo_torch.parameters import ParameterSpace

#: Joints of the arm, which come first, and numbers of an object's pose, which come next.
JOINTS, POSE = 7, 7
#: Physics steps of a target in one of the model's.
FINER = 5
#: Speed of a joint below which its dry friction fades, rad/s.
SLIPS = 0.01
#: Longest time between two samples of a signal of a raw log, s: blank cells are none.
GAP = 0.03
#: What a raw log has, in its order: at the controller's times, and at the camera's.
READINGS = (*(f"q{i}" for i in range(1, JOINTS + 1)), "tip_x", "tip_y", "tip_z")
COMMANDS = tuple(f"c{i}" for i in range(1, JOINTS + 1))
FRAMES = ("marker_x", "marker_y", "marker_z", "object_x", "object_y", "object_z") + tuple(
    f"object_q{a}" for a in "wxyz"
)


@dataclass(frozen=True)
class Arm:
    """What an arm has and its model lacks.

    Attributes:
        delay: seconds until a command acts.
        dry: friction of each joint that does not depend on its speed, N m.
        viscous: friction in proportion to it, N m s/rad.
    """

    delay: float
    dry: tuple[float, ...]
    viscous: tuple[float, ...]


@dataclass(frozen=True)
class Equipment:
    """How a target is measured.

    Attributes:
        period: seconds between the controller's readings of the encoders.
        angle: standard deviation of a reading, rad.
        rate: of the camera, Hz.
        latency: seconds by which a frame is stamped later than it was taken; its stamps have no jitter.
        place, turn: standard deviations of an object's place, m, and orientation, rad.
    """

    period: float = 0.005
    angle: float = 1e-5
    rate: float = 120.0
    latency: float = 0.025
    place: float = 5e-5
    turn: float = 5e-4


@dataclass
class Run:
    """What was done and measured in an episode.

    Attributes:
        readings: of the encoders, one row a controller's period: time, then :data:`JOINTS` angles.
        frames: of the camera: time at which it was taken, place of the marker at the arm's tip, pose of the object.
        commands: one row a command: time, then its numbers.
        final: the true state at the end, ``[qpos, qvel]``.
        qpos: true positions after each physics step.
    """

    readings: list[np.ndarray] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    commands: list[np.ndarray] = field(default_factory=list)
    final: np.ndarray = field(default_factory=lambda: np.empty(0))
    qpos: np.ndarray = field(default_factory=lambda: np.empty(0))


#: Gives the next command, ``(nu,)``, at a time and a state as the equipment shows it, ``[qpos, qvel]``.
Control = Callable[[float, np.ndarray], np.ndarray]


class Target:
    """An arm with an object that stands for a real one.

    Args:
        sim: the bundled simulation whose robot it is.
        truth: the true values of its parameters; of others, the model's.
        arm: what the arm has beside.
        equipment: how it is measured.
        tilt: roll and pitch of the table in the world, rad. The table is the frame of all measurements, and the arm's
            gravity is compensated as if it were level.
        law: changes the model before each physics step, by the state.
    """

    def __init__(
        self, sim: BundledSim, truth: Mapping[str, float], arm: Arm, equipment: Equipment = Equipment(), *,
        tilt: tuple[float, float] = (0.0, 0.0), law: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None,
    ) -> None:  # fmt: skip
        space = ParameterSpace(sim.model, sim.parameters)
        self.sim, self.truth, self.arm, self.equipment, self.tilt = sim, dict(truth), arm, equipment, tilt
        self.model = space.apply({**space.named(space.nominal), **truth})
        self.period = self.model.opt.timestep * sim.frame_skip
        self.model.opt.timestep /= FINER
        level = self.model.opt.gravity.copy()
        self.model.opt.gravity = _turned(*tilt).T @ level
        self._uneven = (self.model.body_gravcomp * self.model.body_mass)[:, None] * (self.model.opt.gravity - level)
        self._law = law
        self._seer = mujoco.MjData(self.model)
        self._dry, self._viscous = np.array(arm.dry), np.array(arm.viscous)

    def run(self, start: np.ndarray, control: Control, steps: int, generator: np.random.Generator) -> Run:
        """Carry out commands from a state of rest, one every :attr:`period`.

        Args:
            start: ``[qpos, qvel]``.
            control: gives each command.
            steps: how many commands.
            generator: of the noise of the measurements.
        """
        model, data, found = self.model, mujoco.MjData(self.model), Run()
        data.qpos[:], data.qvel[:] = np.split(start, [model.nq])
        data.xfrc_applied[:, :3] = self._uneven
        step = float(model.opt.timestep)
        hold, late = round(self.period / step), round(self.arm.delay / step)
        path = [data.qpos.copy()]
        self._measure(found, path, 0, generator)
        for k in range(steps * hold):
            if k % hold == 0:
                shown = self.shown(found, k * step)
                found.commands.append(np.append(k * step, control(k * step, shown)))
            data.ctrl[:] = found.commands[max(0, k - late) // hold][1:]
            data.qfrc_applied[:JOINTS] = self._friction(data.qvel[:JOINTS])
            if self._law is not None:
                self._law(model, data)
            mujoco.mj_step(model, data)
            path.append(data.qpos.copy())
            self._measure(found, path, k + 1, generator)
        found.final = np.concatenate([data.qpos, data.qvel])
        found.qpos = np.stack(path)
        return found

    def shown(self, run: Run, now: float) -> np.ndarray:
        """Return the state ``[qpos, qvel]`` as the equipment shows it: velocities are differences of measurements."""
        seen = [f for f in run.frames if f[0] + self.equipment.latency <= now + 1e-9] or run.frames[:1]
        last, before = seen[-1], seen[-min(3, len(seen))]
        angles, earlier = run.readings[-1], run.readings[-min(3, len(run.readings))]
        speeds = (angles[1:] - earlier[1:]) / max(angles[0] - earlier[0], 1e-9)
        span, pose, old = max(last[0] - before[0], 1e-9), last[4:], before[4:]
        linear, angular = (pose[:3] - old[:3]) / span, np.empty(3)
        mujoco.mju_subQuat(angular, pose[3:], old[3:])
        return np.concatenate([angles[1:], pose, speeds, linear, angular / span])

    def _friction(self, velocity: np.ndarray) -> np.ndarray:
        """Forces of the arm's friction at joint velocities ``(7,)``, N m."""
        return -self._viscous * velocity - self._dry * np.tanh(velocity / SLIPS)

    def _measure(self, run: Run, path: Sequence[np.ndarray], k: int, generator: np.random.Generator) -> None:
        """Take the readings and frames that are due by physics step ``k``, of positions until then."""
        means, step = self.equipment, float(self.model.opt.timestep)
        if k % round(means.period / step) == 0:
            noise = means.angle * generator.standard_normal(JOINTS)
            run.readings.append(np.concatenate([[k * step], path[k][:JOINTS] + noise]))
        due = len(run.frames) / means.rate
        if due <= k * step + 1e-9:
            share = 0.0 if k == 0 else due / step - (k - 1)
            qpos = path[k] if k == 0 else (1 - share) * path[k - 1] + share * path[k]
            run.frames.append(np.concatenate([[due], self._seen(qpos, generator)]))

    def _seen(self, qpos: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Place of the marker and pose of the object as the camera sees them, ``(10,)``."""
        means, pose = self.equipment, qpos[JOINTS : JOINTS + POSE].copy()
        places = np.concatenate([self.tip(qpos), pose[:3]]) + means.place * generator.standard_normal(6)
        mujoco.mju_normalize4(pose[3:])
        mujoco.mju_quatIntegrate(pose[3:], means.turn * generator.standard_normal(3), 1.0)
        return np.concatenate([places, pose[3:]])

    def tip(self, qpos: np.ndarray) -> np.ndarray:
        """Return where the arm's tip is at positions ``(nq,)`` or angles ``(7,)``, ``(3,)``, m."""
        self._seer.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(self.model, self._seer)
        return np.array(self._seer.site("tip").xpos)


def write_raw(path: str | Path, target: Target, runs: Sequence[Run]) -> None:
    """Write runs as a user's equipment does, in CSV: one row a stamp, and blank what was not measured then.

    The columns are ``time``, ``run``, those of :data:`READINGS` and :data:`COMMANDS` at the controller's times, and
    those of :data:`FRAMES` at the camera's, which are late. The controller works out the tip of its readings.
    """
    with open(path, "w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["time", "run", *READINGS, *COMMANDS, *FRAMES])
        for number, run in enumerate(runs):
            for stamp, entries in sorted(_rows(target, run).items()):
                cells = (f"{entries[name]:.9g}" if name in entries else "" for name in (*READINGS, *COMMANDS, *FRAMES))
                rows.writerow([f"{stamp / 1e6:.6f}", number, *cells])


def _rows(target: Target, run: Run) -> dict[int, dict[str, float]]:
    """What was measured at each stamp in microseconds."""
    found: dict[int, dict[str, float]] = {}

    def enter(time: float, names: Sequence[str], values: np.ndarray) -> None:
        found.setdefault(round(1e6 * time), {}).update(zip(names, values.tolist(), strict=True))

    for reading in run.readings:
        enter(reading[0], READINGS, np.concatenate([reading[1:], target.tip(reading[1:])]))
    for command in run.commands:
        enter(command[0], COMMANDS, command[1:])
    for frame in run.frames:
        enter(frame[0] + target.equipment.latency, FRAMES, frame[1:])
    return found


def log_config(path: str | Path, start: float) -> dict[str, object]:
    """Return what a user's config says of a raw log: which columns, and how they become transitions.

    How late the camera is follows from the marker at the arm's tip, which the controller knows, too; the object is as
    late.

    Args:
        path: the log.
        start: where the part that is used begins, s; a multiple of the time between commands, so that steps begin with
            them, and later than the camera's latency.
    """
    joints, pose = READINGS[:JOINTS], FRAMES[3:]
    preprocess = {
        "positions": [*joints, *pose], "quaternions": [list(pose[3:])], "reference": "tip_x", "align": ["marker_x"],
        "same_clock": list(pose), "start": start, "max_gap": GAP,
    }  # fmt: skip
    columns = {"observations": [*joints, *pose, "tip_x", "marker_x"], "actions": list(COMMANDS)}
    return {"path": str(path), "time": "time", "episode": "run", **columns, "preprocess": preprocess}


def arm_config(path: str | Path, start: float) -> dict[str, object]:
    """Return what a config says of a raw log of the arm alone; see :func:`log_config`."""
    columns = {"observations": list(READINGS[:JOINTS]), "actions": list(COMMANDS)}
    preprocess = {"start": start, "max_gap": GAP}
    return {"path": str(path), "time": "time", "episode": "run", **columns, "preprocess": preprocess}


def _turned(roll: float, pitch: float) -> np.ndarray:
    """How a table stands that is turned about the world's x and then about its y, ``(3, 3)``."""
    found = np.empty(9)
    turns = [
        np.array([np.cos(0.5 * a), *np.sin(0.5 * a) * axis])
        for a, axis in zip((roll, pitch), np.eye(3)[:2], strict=True)
    ]
    both = np.empty(4)
    mujoco.mju_mulQuat(both, turns[1], turns[0])
    mujoco.mju_quat2Mat(found, both)
    return found.reshape(3, 3)


def run_writer(
    about: str, target: Target, record: Callable[..., list[Run]], count: int, arguments: Sequence[str] | None
) -> None:
    """Write a raw log from the command line.

    Args:
        about: what the target is.
        target: the target.
        record: returns runs: ``record(count, seed, alone=...)``.
        count: how many by default.
        arguments: those of the command line, by default the process's own.
    """
    parser = argparse.ArgumentParser(description=f"Write the raw log of {about}.")
    parser.add_argument("path", type=Path, help="the .csv file to write")
    parser.add_argument("--runs", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--alone", action="store_true", help="the arm alone, the object out of reach")
    given = parser.parse_args(arguments)
    try:
        if given.runs < 1 or given.seed < 0:
            raise InputError(f"runs {given.runs}, seed {given.seed}: expected 1 or more, 0 or more")
        write_raw(given.path, target, record(given.runs, given.seed, alone=given.alone))
    except (InputError, OSError) as error:
        parser.error(str(error))
    print(f"{given.runs} runs in {given.path}")
