"""What a physical effect is: where it may sit, what it is measured in, and how it enters the simulation."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np

from dropo_torch.data.observation import Observation, joint_name
from dropo_torch.parameters import object_names

Kind = Literal["joint", "body", "world", "actuator", "sensor", "geom"]


@dataclass(frozen=True)
class Quantity:
    """One number of an effect at one target.

    Attributes:
        name: what it is called in files and reports.
        unit: its unit.
        neutral: the value at which the effect is absent.
        low, high: values outside are no physics, or freeze the model.
        scale: a size that matters on this log; steps and thresholds are taken relative to it.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    scale: float


@dataclass(frozen=True)
class Signals:
    """Sizes that the log and the model give, by which effects know what matters; units cancel against them.

    Attributes:
        timestep: seconds of one logged transition.
        position: measured positions of each joint coordinate, 1 and 99 percentile, ``(nq, 2)``; NaN if not observed.
        speed: root mean square of each degree of freedom's velocity, ``(nv,)``.
        force: typical generalised force on each degree of freedom, ``(nv,)``.
        inertia: diagonal of the mass matrix at the typical configuration, ``(nv,)``.
        command: largest absolute command, ``(nu,)``.
        column: standard deviation of each observed column, ``(n,)``.
        linear_speed: root mean square speed of each body's centre, ``(nbody,)``.
        contacts: geoms that touch something somewhere in the log, ``(ngeom,)`` bool.
    """

    timestep: float
    position: np.ndarray
    speed: np.ndarray
    force: np.ndarray
    inertia: np.ndarray
    command: np.ndarray
    column: np.ndarray
    linear_speed: np.ndarray
    contacts: np.ndarray


@dataclass(frozen=True)
class Setting:
    """Where effects are looked for: the model as given, the columns of the log (some masked), and its sizes."""

    model: mujoco.MjModel
    observation: Observation
    signals: Signals
    frame_skip: int
    masked: frozenset[int] = frozenset()

    def joint(self, name: str) -> int:
        """Return a joint's number."""
        return [joint_name(self.model, j) for j in range(self.model.njnt)].index(name)

    def dof(self, name: str) -> int:
        """Return the degree of freedom of a hinge or slide joint."""
        return int(self.model.jnt_dofadr[self.joint(name)])

    def coordinate(self, name: str) -> int:
        """Return the position coordinate of a hinge or slide joint."""
        return int(self.model.jnt_qposadr[self.joint(name)])

    def is_slide(self, name: str) -> bool:
        """Return whether a joint slides, so that its force is in newtons."""
        return bool(self.model.jnt_type[self.joint(name)] == mujoco.mjtJoint.mjJNT_SLIDE)

    def names(self, prefix: str) -> list[str]:
        """Return the names of all objects of a kind, in order; unnamed ones are called ``geom0``."""
        return object_names(self.model, prefix)


class Effect(abc.ABC):
    """A kind of physical effect that a model may lack. It holds no state.

    A class says where the effect can sit, what its quantities are there, and overrides whichever of
    :meth:`apply`, :meth:`force`, :meth:`wrench`, :meth:`command` and :meth:`sense` it needs.

    Attributes:
        name: its name in files and reports.
        kind: what its target is.
        sentence: what it is, to a person; ``{target}`` stands for the target.
        native: whether MJCF can express it.
    """

    name: ClassVar[str]
    kind: ClassVar[Kind]
    sentence: ClassVar[str]
    native: ClassVar[bool] = True

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by name: whoever reads it must have registered the effect, too."""
        from dropo_torch.effects import find_effect

        return find_effect, (self.name,)

    @abc.abstractmethod
    def targets(self, setting: Setting) -> list[str | None]:
        """Return where the effect can sit in this model; ``[None]`` for the world."""

    @abc.abstractmethod
    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        """Return the effect's numbers at a target."""

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Return the values from which a search begins, each ``(p,)``; by default the neutral ones."""
        return [np.array([q.neutral for q in self.quantities(setting, target)])]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        """Return starts near a simpler effect that this one contains, each ``(p,)``; none where it contains none."""
        return []

    def screened(self) -> list[int] | None:
        """Return which quantities the screening moves beside each start; ``None`` for all."""
        return None

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the values that a linear prediction ``values`` from ``start`` stands for."""
        return values

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        """Write the effect into a copy of the model; constants are derived afterwards."""
        return

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray | None:
        """Return generalised forces ``(R, nv)`` at states ``(R, nq)`` and ``(R, nv)``, or ``None`` if it has none."""
        return None

    def wrench(self, setting: Setting, target: str | None, values: np.ndarray) -> np.ndarray | None:
        """Return constant world-frame forces and torques on the bodies' centres ``(nbody, 6)``, or ``None``."""
        return None

    def command(self, signal: np.ndarray, actuator: int, step: float, values: np.ndarray) -> np.ndarray:
        """Return one actuator's commands ``(E, S)`` as they act, at every physics step of whole episodes."""
        return signal

    def sense(self, path: Path, column: int, values: np.ndarray) -> Path:
        """Return what the sensors say of a simulated path."""
        return path

    def unsense(self, start: np.ndarray, rate: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
        """Return observed columns ``(W, n)`` of the true state from measured ones and their rates."""
        return start

    def memory(self, values: np.ndarray) -> float:
        """Return the seconds that :meth:`command` or :meth:`sense` looks back; infinite for all of the past."""
        return math.inf if self.acts_on_command else 0.0

    @property
    def acts_on_command(self) -> bool:
        """Whether the effect filters commands."""
        return type(self).command is not Effect.command

    @property
    def acts_on_sensor(self) -> bool:
        """Whether the effect filters measurements."""
        return type(self).sense is not Effect.sense

    @property
    def has_force(self) -> bool:
        """Whether the effect is a force that depends on the state."""
        return type(self).force is not Effect.force


@dataclass(frozen=True)
class Path:
    """Observed columns of a simulated window.

    Attributes:
        columns: at the logged instants, the start included, ``(W, L + 1, n)``.
        fine: at every physics step, the start included, ``(W, L·skip + 1, n)``.
        valid: which of ``columns`` the simulation can know, ``(W, L + 1, n)`` bool.
        step: seconds of a physics step.
        rates: for a column, the column that is its time derivative, or -1, ``(n,)``.
    """

    columns: np.ndarray
    fine: np.ndarray
    valid: np.ndarray
    step: float
    rates: np.ndarray


@dataclass(frozen=True)
class Placed:
    """An effect at a target with values: what a config or a result holds.

    Attributes:
        effect: the effect.
        target: where it sits, ``None`` for the world.
        values: its numbers, in the order of its quantities, ``(p,)``.
    """

    effect: Effect
    target: str | None
    values: tuple[float, ...] = ()

    @property
    def key(self) -> tuple[str, str | None]:
        """Effect and target, without the values."""
        return self.effect.name, self.target

    def at(self, values: Sequence[float] | np.ndarray) -> Placed:
        """Return the same effect with other values."""
        return Placed(self.effect, self.target, tuple(float(v) for v in values))

    def summary(self, setting: Setting) -> dict[str, Any]:
        """Return the values by name."""
        return {q.name: v for q, v in zip(self.effect.quantities(setting, self.target), self.values, strict=True)}
