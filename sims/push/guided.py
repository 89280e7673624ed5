"""One long trajectory of an arm that a hand guides: it pushes the box from all sides, and no command is there to log.

The log is what instruments write, not transitions: encoders at 1 kHz, with where the controller has the tip by them,
and poses of box and rod by motion capture at 120 Hz, whose clock is another one.
:class:`~dropo_torch.data.preprocess.Preprocess` makes transitions of it, for the model that
``python -m dropo_sims.push.guided MODEL.xml`` writes.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.parameters import ParameterSpace

from ..reaching import Reach
from ..recorder import check_names, check_request
from . import SIM
from .policy import START

#: The variant's name.
GUIDED = "guided"
#: Time step of a transition, and of the simulated world and the encoders, s; rate of the motion capture, Hz.
DT, STEP, CAPTURE_RATE = 0.01, 1e-3, 120.0
#: Seconds at rest before and after the motion.
REST = 0.5
#: Smallest step of an encoder and standard deviation of its noise, rad.
ENCODER_STEP, ENCODER_NOISE = 1e-5, 1e-5
#: Standard deviations of captured positions, m, and rotations, rad; largest offset between the clocks, s.
CAPTURE_NOISE, CAPTURE_TURN, CLOCK_OFFSET = 3e-4, 3e-3, 0.08
#: The hand, a spring and a damper at the tip: N/m and N s/m, N m/rad and N m s/rad.
STIFFNESS, DAMPING, TURN_STIFFNESS, TURN_DAMPING = 1500.0, 120.0, 60.0, 3.0
#: Height of the tip and its distance from the box's middle as it goes round it, m; its speed there, m/s.
HEIGHT, AROUND, GOING = 0.03, 0.115, 0.3
#: How far pushes go on after the touch, m, how fast, m/s, beside the box's middle, m, and off its side's normal, rad.
LENGTHS, SPEEDS, SIDE, HEADING = (0.04, 0.1), (0.15, 0.4), 0.03, 0.25
#: Where the box is kept, and how far from there it is pushed whichever way, m.
HOME, NEAR = np.array([0.53, 0.0]), 0.05
#: Seconds in which the hand stops or turns, about.
REACTION = 0.04
JOINTS = 7
#: Inertia of the joints of a model whose arm follows a guided log, kg m², and how far its drives are behind, s.
HEAVY, LAG = 100.0, 0.627 * DT
#: Columns of the file.
COLUMNS = ("episode", "stamp", "q", "tip", "box", "hand")


@dataclass(frozen=True)
class InstrumentLog:
    """What the instruments wrote, one row a time stamp; NaN where an instrument has no sample then.

    Attributes:
        episode: of each row, counted from 0, ``(N,)``.
        stamp: time, s, ``(N,)``; that of captured poses is late by ``offset``.
        q: joint positions, rad, ``(N, 7)``.
        tip: where these have the rod's tip, m, ``(N, 3)``.
        box: the box's captured position, m, and quaternion, ``(N, 7)``.
        hand: captured position of a marker at the tip, m, ``(N, 3)``.
        offset: between the clocks, s.
    """

    episode: np.ndarray
    stamp: np.ndarray
    q: np.ndarray
    tip: np.ndarray
    box: np.ndarray
    hand: np.ndarray
    offset: float

    @property
    def size(self) -> str:
        """How much it is, in words."""
        return f"{len(self.stamp)} samples"

    def save(self, path: str | Path) -> None:
        """Write the log as ``.npz``, and nothing that instruments do not tell."""
        with open(path, "wb") as stream:
            np.savez_compressed(stream, **{name: getattr(self, name) for name in COLUMNS})


def record_guided(
    *, episodes: int = 1, steps: int = 1286, seed: int = 0, truth: Mapping[str, float] | None = None
) -> InstrumentLog:
    """Guide the arm around the box, and log it by instruments.

    Args:
        episodes: how often.
        steps: how long the hand moves each time, in steps of 10 ms; half a second before and after, the arm rests.
        seed: of the motion, the noise and the offset between the clocks.
        truth: parameters by name; the model's own where absent.

    Raises:
        InputError: an unknown parameter or number.
    """
    check_request(GUIDED, (GUIDED,), episodes, steps, seed)
    check_names("truth", truth or {}, SIM.parameters)
    space, generator = ParameterSpace(SIM.model, SIM.parameters), np.random.default_rng(seed)
    model = space.apply(space.named(space.nominal) | dict(truth or {}))
    model.opt.timestep = STEP
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0  # the drives let the arm be guided
    offset = float(generator.uniform(-CLOCK_OFFSET, CLOCK_OFFSET))
    parts = []
    for episode in range(episodes):
        stamp, samples = _instruments(model, *_motion(model, steps * DT, generator), offset, generator)
        parts.append(np.column_stack([np.full(len(stamp), episode), stamp, samples]))
    number, stamps, q, tip, box, hand = np.split(np.concatenate(parts), (1, 2, 9, 12, 19), axis=1)
    return InstrumentLog(number[:, 0].astype(int), stamps[:, 0], q, tip, box, hand, offset)


def _instruments(
    model: mujoco.MjModel, joints: np.ndarray, poses: np.ndarray, tips: np.ndarray, offset: float,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Time stamps ``(N,)``, and what encoders, controller and motion capture have then, ``(N, 20)``."""
    time, reach = STEP * np.arange(len(joints)), Reach(model)
    encoders = joints + ENCODER_NOISE * generator.standard_normal(joints.shape)
    encoders = ENCODER_STEP * np.round(encoders / ENCODER_STEP)
    frames = np.arange(generator.uniform(0, 1 / CAPTURE_RATE), time[-1], 1 / CAPTURE_RATE)
    box, hand = (np.stack([np.interp(frames, time, x) for x in part.T], 1) for part in (poses, tips))
    box[:, :3] += CAPTURE_NOISE * generator.standard_normal((len(frames), 3))
    hand += CAPTURE_NOISE * generator.standard_normal(hand.shape)
    for quaternion, turn in zip(box[:, 3:], CAPTURE_TURN * generator.standard_normal((len(frames), 3)), strict=True):
        mujoco.mju_quatIntegrate(quaternion, turn, 1.0)
    stamps = np.concatenate([time, frames + offset])
    rows, order = np.full((len(stamps), 20), np.nan), np.argsort(stamps, kind="stable")
    rows[: len(time), :10] = np.hstack([encoders, np.stack([reach.tip(row) for row in encoders])])
    rows[len(time) :, 10:] = np.hstack([box, hand])
    return stamps[order], rows[order]


def _motion(
    model: mujoco.MjModel, duration: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint positions ``(N, 7)``, the box's poses ``(N, 7)`` and the tip's positions ``(N, 3)``, every ``STEP``."""
    data, hand = mujoco.MjData(model), _Hand(model, generator)
    data.qpos[:JOINTS] = START
    found = []
    for step in range(round((duration + 2 * REST) / STEP) + 1):
        mujoco.mj_step1(model, data)
        found.append(np.concatenate([data.qpos, data.site("tip").xpos]))
        hand.pull(data, moves=REST <= step * STEP < REST + duration)
        mujoco.mj_step2(model, data)
    states = np.array(found)
    return states[:, :JOINTS], states[:, JOINTS : JOINTS + 7], states[:, JOINTS + 7 :]


@dataclass(frozen=True)
class _Line:
    """A push: the line that the tip follows, and how fast and far it goes beyond the touch."""

    through: np.ndarray
    along: np.ndarray
    speed: float
    length: float

    def progress(self, tip: np.ndarray) -> float:
        """How far the tip is beyond the box's middle, as it lay at the push's begin, m."""
        return float((tip - self.through) @ self.along)

    def velocity(self, tip: np.ndarray, speed: float) -> np.ndarray:
        """Velocity along the line, and back to it, ``(2,)``, m/s."""
        across = np.array([-self.along[1], self.along[0]])
        return speed * self.along - 5.0 * ((tip - self.through) @ across) * across


class _Hand:
    """A hand at the tip, that sees the box: it goes round it, pushes at its sides, and lets go.

    Args:
        model: arm and box.
        generator: of sides and pushes.
    """

    def __init__(self, model: mujoco.MjModel, generator: np.random.Generator) -> None:
        self._model, self._generator = model, generator
        self._body = int(model.site("tip").bodyid[0])
        self._side: int | None = None
        self._grip: np.ndarray | None = None
        self._velocity = np.zeros(3)
        self._phase, self._line, self._waited = self._round, _Line(np.zeros(2), np.zeros(2), 0.0, 0.0), 0.0

    def pull(self, data: mujoco.MjData, *, moves: bool) -> None:
        """Apply the hand's force and torque to the arm, and move the hand on by a step."""
        site, twist = data.site("tip"), np.zeros(6)
        mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_SITE, site.id, twist, 0)
        tip, turn, box = np.array(site.xpos), site.xmat.reshape(3, 3), data.body("box")
        grip = np.array([*tip[:2], HEIGHT]) if self._grip is None else self._grip
        wanted = np.zeros(3)
        if moves:
            yaw = float(np.arctan2(box.xmat[3], box.xmat[0]))
            wanted[:2] = self._phase(tip[:2], np.array(box.xpos[:2]), yaw)
        self._velocity += (wanted - self._velocity) * STEP / REACTION
        self._grip = grip + STEP * self._velocity
        force = STIFFNESS * (grip - tip) + DAMPING * (self._velocity - twist[3:])
        upright = np.cross(turn[:, 2], [0.0, 0.0, -1.0]) + np.cross(turn[:, 0], [1.0, 0.0, 0.0]) * [0.0, 0.0, 1.0]
        torque = TURN_STIFFNESS * upright - TURN_DAMPING * twist[:3]
        data.qfrc_applied[:] = 0
        mujoco.mj_applyFT(self._model, data, force, torque, tip, self._body, data.qfrc_applied)

    def _round(self, tip: np.ndarray, box: np.ndarray, yaw: float) -> np.ndarray:
        """Go round the box to the next side."""
        if self._side is None:
            self._side = self._choose(box, yaw)
        side = yaw + 0.5 * np.pi * self._side
        outward = (tip - box) / np.linalg.norm(tip - box)
        left = (side - np.arctan2(outward[1], outward[0]) + np.pi) % (2 * np.pi) - np.pi
        if abs(left) < 0.1:
            self._side, self._line, self._phase = None, self._new_line(box, side), self._push
        tangent = np.array([-outward[1], outward[0]])
        return GOING * np.clip(left / 0.4, -1, 1) * tangent + 5.0 * (AROUND - np.linalg.norm(tip - box)) * outward

    def _choose(self, box: np.ndarray, yaw: float) -> int:
        """A side, counted from the box's x axis on; far from home, one from which a push leads back."""
        while True:
            side = int(self._generator.integers(4))
            outward = np.array([np.cos(yaw + 0.5 * np.pi * side), np.sin(yaw + 0.5 * np.pi * side)])
            if np.linalg.norm(box - HOME) < NEAR or outward @ (box - HOME) > 0.5 * np.linalg.norm(box - HOME):
                return side

    def _new_line(self, box: np.ndarray, side: float) -> _Line:
        draw = self._generator.uniform
        heading, offset = side + np.pi + draw(-HEADING, HEADING), draw(-SIDE, SIDE)
        along = np.array([np.cos(heading), np.sin(heading)])
        return _Line(box + offset * np.array([-along[1], along[0]]), along, draw(*SPEEDS), draw(*LENGTHS))

    def _push(self, tip: np.ndarray, box: np.ndarray, yaw: float) -> np.ndarray:
        """Follow the line until the box has been pushed far enough."""
        if self._line.progress(tip) > self._line.length - 0.06:
            self._phase, self._waited = self._stop, 0.0
        return self._line.velocity(tip, self._line.speed)

    def _stop(self, tip: np.ndarray, box: np.ndarray, yaw: float) -> np.ndarray:
        """Stand still, so that the box slides on alone."""
        self._waited += STEP
        if self._waited > 3 * REACTION:
            self._phase = self._back
        return np.zeros(2)

    def _back(self, tip: np.ndarray, box: np.ndarray, yaw: float) -> np.ndarray:
        """Go back to where the tip is free of the box."""
        if np.linalg.norm(tip - box) > AROUND - 0.01:
            self._phase = self._round
        return self._line.velocity(tip, -GOING)


def write_model(path: str | Path) -> None:
    """Write the model whose arm moves as a guided log has it, whatever it touches.

    Nobody logged what moved the arm: its motion is given, and says nothing of the box. So its joints are as heavy and
    its drives as strong as to feel no contact. Told the velocity at a step's end, they pass through the measured
    positions: a lag of ``LAG`` makes up for the acceleration within the step.
    """
    spec = mujoco.MjSpec.from_file(str(SIM.model))
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.armature = HEAVY
    for drive in spec.actuators:
        drive.gainprm[0], drive.biasprm[2] = HEAVY / LAG, -HEAVY / LAG
        drive.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.compile()
    Path(path).write_text(spec.to_xml())


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the model from the command line."""
    parser = argparse.ArgumentParser(description="Write the model whose arm moves as a guided log has it.")
    parser.add_argument("path", type=Path, help="the MJCF file to write")
    given = parser.parse_args(arguments)
    try:
        write_model(given.path)
    except OSError as error:
        parser.error(str(error))
    print(f"an arm that feels no contact in {given.path}")


if __name__ == "__main__":
    main()
