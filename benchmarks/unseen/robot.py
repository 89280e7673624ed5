"""What a robot of the benchmark is: the model that a user has, what that lacks, how it moves and what is logged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.unseen.drives import Drive

MODELS = Path(__file__).parent / "models"
RK4, IMPLICIT, EULER = (getattr(mujoco.mjtIntegrator, f"mjINT_{n}") for n in ("RK4", "IMPLICITFAST", "EULER"))
DEG = 180 / np.pi

#: An effect of the vocabulary and where it is; a world's has no target.
Name = tuple[str, str | None]
#: What is commanded at a time (s), by measured positions and velocities.
Command = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
#: Sets an initial state, and returns how the robot is commanded from there.
Start = Callable[[mujoco.MjData, np.random.Generator], Command]
#: A column that has nothing to do with the robot: of times ``(n,)``, positions ``(n, nq)``, and a generator.
Extra = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Hidden:
    """Something that the model lacks.

    Attributes:
        names: the effects that it is; the first is its own name, and ``values`` are the numbers of all of them.
        equals: effects with other numbers that are the same on this robot.
        values: true numbers by the parameters of the effect, in SI units.
        edit: changes the model.
        drives: actuator → what stands between its command and what acts.
        push: sets forces, before each step.
        offsets: joint → what its measured position is too large by, rad or m.
    """

    names: tuple[Name, ...] = ()
    equals: tuple[Name, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    edit: Callable[[mujoco.MjSpec], None] | None = None
    drives: Mapping[str, Drive] = field(default_factory=dict)
    push: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    offsets: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_outside(self) -> bool:
        """Whether the vocabulary has no effect for it."""
        return not self.names


@dataclass(frozen=True)
class Log:
    """What is logged of a robot; units follow from the names of columns, which end in ``_deg`` or ``_mm``, or are SI.

    Attributes:
        positions, velocities, commands: columns of the first positions, velocities and commands. In an npz, columns
            of one name are an array of this name.
        noise: standard deviation of each degree of freedom's position and velocity, rad, m and seconds.
        encoder: steps of each degree of freedom's position, 0 for none.
        cutoff: of a filter of the logged velocities, Hz.
        time: column of the time stamps; in s, or as ``units`` says.
        decimals: of time stamps and of commands.
        from_zero: whether the clock begins with the log.
        late: rows that a command is logged after it was sent.
        episode: column of the episode's number.
        extras: columns of no use, with their decimals.
        suffix: of the file.
    """

    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    commands: tuple[str, ...]
    noise: tuple[tuple[float, ...], tuple[float, ...]]
    encoder: tuple[float, ...] | float = 0.0
    cutoff: float | None = None
    time: str = "time"
    decimals: tuple[int, int] = (4, 4)
    from_zero: bool = True
    late: int = 0
    episode: str = ""
    extras: Mapping[str, tuple[Extra, int]] = field(default_factory=dict)
    suffix: str = ".csv"


@dataclass(frozen=True)
class Robot:
    """A robot whose model lacks something, or nothing.

    Attributes:
        summary: what it is, and what its model lacks.
        file: the user's model, in ``models/``.
        start: its initial state, and how it is commanded.
        log: what is logged.
        hidden: all that the model lacks.
        beside: names that may stand beside the right ones.
        motors: joints that motors drive which the model lacks.
        step: of the truth, s.
        integrator: of the truth.
        row: seconds between rows of the log, a whole number of steps.
        seconds: of an episode.
        warm: seconds before the log begins.
        episodes: how many.
        jitter: largest relative error of ``row``.
        hold: rows that a command is held.
        window: seconds over which what the model lacks surely shows.
    """

    summary: str
    file: str
    start: Start
    log: Log
    hidden: tuple[Hidden, ...] = ()
    beside: tuple[Name, ...] = ()
    motors: tuple[str, ...] = ()
    step: float = 0.0005
    integrator: int = RK4
    row: float = 0.01
    seconds: float = 20.0
    warm: float = 0.0
    episodes: int = 1
    jitter: float = 0.0
    hold: int = 1
    window: float = 0.2

    @property
    def name(self) -> str:
        """What it is called."""
        return Path(self.file).stem

    @property
    def is_outside(self) -> bool:
        """Whether it lacks something that has no name in the vocabulary."""
        return any(h.is_outside for h in self.hidden)

    @cached_property
    def text(self) -> str:
        """The user's model."""
        return (MODELS / self.file).read_text(encoding="utf-8")

    def given(self) -> mujoco.MjModel:
        """Return the user's model, with the motors that it lacks."""
        return self._compiled(())

    def true(self, without: Sequence[Hidden] = ()) -> mujoco.MjModel:
        """Return the true model, with its step and integrator; ``without`` some of the things that are hidden."""
        model = self._compiled(h for h in self.hidden if h not in without)
        model.opt.timestep, model.opt.integrator = self.step, self.integrator
        return model

    def _compiled(self, hidden: Iterable[Hidden]) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(self.text)
        for joint in self.motors:
            spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        for one in hidden:
            if one.edit is not None:
                one.edit(spec)
        return spec.compile()


def units(column: str) -> float:
    """Return the factor from an SI unit to that of a column, by its name."""
    factors = {"deg": DEG, "mm": 1e3, "ms": 1e3, "us": 1e6}
    return next((factors[word] for word in column.split("_") if word in factors), 1.0)


def columns(names: str) -> tuple[str, ...]:
    """Return the names of a text."""
    return tuple(names.split())


def pose(name: str) -> tuple[str, ...]:
    """Return columns of a free body's pose."""
    return columns(" ".join(f"{name}_p{c}" for c in "xyz") + " " + quaternion(name))


def quaternion(name: str) -> str:
    """Return columns of an orientation, as a text."""
    return " ".join(f"{name}_q{c}" for c in "wxyz")


def twist(name: str) -> tuple[str, ...]:
    """Return columns of a free body's velocity and angular velocity."""
    return (*(f"{name}_v{c}" for c in "xyz"), *(f"{name}_w{c}" for c in "xyz"))


def around(mean: float, spread: float) -> Extra:
    """Return a column of noise."""
    return lambda times, positions, rng: mean + spread * rng.standard_normal(len(times))
