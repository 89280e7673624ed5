"""What a physical effect is: where it may sit, what it is measured in, and how it enters the simulation."""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
import torch

from dropo_torch.data.observation import Observation
from dropo_torch.effects.drive import Drive
from dropo_torch.effects.path import SensedPath
from dropo_torch.errors import InputError, choices
from dropo_torch.parameters import object_names, object_number

Kind = Literal["joint", "tendon", "body", "world", "actuator", "sensor", "geom"]
#: The methods by which an effect acts on a simulation.
Method = Literal["apply", "force", "force_under", "replay", "wrench", "command", "sense"]
#: Share of its start that an amount is at least, where a prediction of places is divided by it.
LEAST_AMOUNT = 0.2


@dataclass(frozen=True)
class Quantity:
    """One number of an effect at one target.

    Attributes:
        name: what it is called in files and reports.
        unit: its unit.
        neutral: the value at which the effect is absent.
        low, high: values outside are no physics, or freeze the model.
        scale: a size that matters on this log; steps and thresholds are taken relative to it.
        discrete: whether only some values in between mean anything, such as those of the starts: nothing moves it,
            it has no interval, and it is no parameter.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    scale: float
    discrete: bool = False


@dataclass(frozen=True)
class Signals:
    """Sizes that the log and the model give, by which effects know what matters; units cancel against them.

    Attributes:
        timestep: seconds of one logged transition.
        position: measured positions of each joint coordinate, 1 and 99 percentile, ``(nq, 2)``; NaN if not observed.
        speed: root mean square of each degree of freedom's velocity, ``(nv,)``.
        force: typical generalized force on each degree of freedom, ``(nv,)``.
        inertia: diagonal of the mass matrix at the typical configuration, ``(nv,)``.
        command: largest absolute command, ``(nu,)``.
        column: standard deviation of each observed column, ``(n,)``.
        linear_speed: root mean square speed of each body's center, ``(nbody,)``.
        angular_speed: root mean square angular velocity of each body, ``(nbody,)``.
        contacts: geoms that touch something somewhere in the log, ``(ngeom,)`` bool.
        ripples: angular frequencies over the position at which a joint lacks a force, by its position coordinate.
        smoothed: rows on each side by which a column is smoothed where windows begin, and its noise, by its number.
        late: rows by which commands may act late, beside which noise is told, too.
    """

    timestep: float
    position: np.ndarray
    speed: np.ndarray
    force: np.ndarray
    inertia: np.ndarray
    command: np.ndarray
    column: np.ndarray
    linear_speed: np.ndarray
    angular_speed: np.ndarray
    contacts: np.ndarray
    ripples: Mapping[int, tuple[float, ...]] = field(default_factory=dict)
    smoothed: Mapping[int, tuple[int, float]] = field(default_factory=dict)
    late: tuple[float, ...] = ()


@dataclass(frozen=True)
class Setting:
    """Where effects are looked for: the model as given, the columns of the log (some masked), and its sizes.

    Of columns that are derived, ``derived`` has the errors, ``(column, error)`` each. Where the log's velocities are
    ``differentiated`` positions, what a sensor does to a position shows in its velocity, too. Columns ``slopes`` are
    velocities that were derived from positions, those of ``lead`` seconds before each row.
    """

    model: mujoco.MjModel
    observation: Observation
    signals: Signals
    frame_skip: int
    masked: frozenset[int] = frozenset()
    derived: tuple[tuple[int, float], ...] = ()
    differentiated: bool = False
    slopes: tuple[int, ...] = ()
    lead: float = 0.0

    @property
    def has_impacts(self) -> bool:
        """Whether contacts or stops may break a motion off."""
        return bool(self.signals.contacts.any() or self.model.jnt_limited.any())

    def joint(self, name: str | None) -> int:
        """Return a joint's number."""
        return self._joints.index(str(name))

    @cached_property
    def _joints(self) -> list[str]:
        return object_names(self.model, "jnt")

    def dof(self, name: str | None) -> int:
        """Return the degree of freedom of a hinge or slide joint."""
        return int(self.model.jnt_dofadr[self.joint(name)])

    def coordinate(self, name: str | None) -> int:
        """Return the position coordinate of a hinge or slide joint."""
        return int(self.model.jnt_qposadr[self.joint(name)])

    def is_slide(self, name: str | None) -> bool:
        """Return whether a joint slides, so that its force is in newtons."""
        return bool(self.model.jnt_type[self.joint(name)] == mujoco.mjtJoint.mjJNT_SLIDE)

    def command_column(self, name: str | None) -> int:
        """Return the command of an actuator, by the actuator's name."""
        return int(self.model.actuator_ctrladr[object_number(self.model, "actuator", name)])

    def column(self, name: str | None) -> int:
        """Return the number of an observed column."""
        return self.observation.labels.index(str(name))

    def names(self, prefix: str) -> list[str]:
        """Return the names of all objects of a kind, in order; unnamed ones are called ``geom0``."""
        return object_names(self.model, prefix)


#: Every effect that a config may name, by its name: the package's, and a user's own.
VOCABULARY: dict[str, Effect] = {}


def find_effect(name: str) -> Effect:
    """Return an effect by its name.

    Raises:
        InputError: an unknown name; the nearest is offered.
    """
    if name not in VOCABULARY:
        raise InputError(f"effect: unknown {name!r}" + choices(name, VOCABULARY))
    return VOCABULARY[name]


def all_of(kind: str) -> str:
    """Return all targets of a kind of effects in words, such as ``all bodies``."""
    return "all bodies" if kind == "body" else f"all {kind}s"


class Effect(abc.ABC):
    """A kind of physical effect that a model may lack. It holds no state.

    A class says where the effect can sit, what its quantities are there, and overrides whichever of
    :meth:`apply`, :meth:`force`, :meth:`wrench`, :meth:`command` and :meth:`sense` it needs. Forces, commands and
    sensors are computed for R rows (simulations, windows, environments) at once; ``values`` are ``(R, p)``, or
    ``(1, p)`` where all rows have the same.

    Attributes:
        name: its name in files and reports.
        kind: what its target is.
        sentence: what it is, to a person; ``{target}`` stands for the target.
        shares: the values, in scales of its only quantity, from which a search begins; none for the neutral value.
        contains: names of effects that are special cases of it, at the same target.
        alone: whether it is looked for by itself; otherwise only in the place of a simpler one, or in the base family.
        known_as: name of the effect of which it is a kind, by which answers call it; none for its own.
        steps: whether it sets the physics step. It is then written first, for others may depend on that.
        everywhere_like: names of effects that do the same, or nearly, if both are everywhere: what is late on the way
            to the robot and on the way back, and what follows late.
        differentiates: whether a velocity that is derived from a measured position shows it as the position does.
    """

    name: ClassVar[str]
    kind: ClassVar[Kind]
    sentence: ClassVar[str]
    shares: ClassVar[tuple[float, ...]] = ()
    contains: ClassVar[tuple[str, ...]] = ()
    alone: ClassVar[bool] = True
    known_as: ClassVar[str] = ""
    steps: ClassVar[bool] = False
    everywhere_like: ClassVar[tuple[str, ...]] = ()
    differentiates: ClassVar[bool] = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy, and hand to other processes, by name: whoever takes it must have registered the effect, too."""
        return find_effect, (self.name,)

    @abc.abstractmethod
    def targets(self, setting: Setting) -> list[str | None]:
        """Return where the effect can sit in this model; ``[None]`` for the world."""

    @abc.abstractmethod
    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        """Return the effect's numbers at a target."""

    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        """Return the values from which a search begins, each ``(p,)``: those of :attr:`shares`, or the neutral ones."""
        quantities = self.quantities(setting, target)
        return [np.array([share * quantities[0].scale]) for share in self.shares] or [
            np.array([q.neutral for q in quantities])
        ]

    def extends(self, setting: Setting, simpler: Placed) -> list[np.ndarray]:
        """Return starts near a simpler effect that this one contains, each ``(p,)``; none where it contains none."""
        return []

    def screened(self) -> list[int] | None:
        """Return which quantities the screening moves beside each start; ``None`` for all."""
        return None

    def settle(self, start: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the values that a linear prediction ``values`` from ``start`` stands for.

        Numbers that act by their product are not linear, such as a mass and where it is: see :func:`by_product`.
        """
        return values

    def directions(self, values: np.ndarray) -> np.ndarray:
        """Return the moves of the values along which differences are taken, ``(p, p)``; by default of each alone.

        Where a move of several at once changes next to nothing, that does not follow from what each alone changes.
        """
        return np.eye(len(values))

    def eased(self, setting: Setting, values: tuple[float, ...]) -> tuple[float, ...]:
        """Return values under which a simulation costs less and changes alike with initial states and other numbers."""
        return values

    def apply(self, model: mujoco.MjModel, target: str | None, values: np.ndarray) -> None:
        """Write the effect, with values ``(p,)``, into a copy of the model; constants are derived afterwards."""
        return

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return generalized forces ``(R, nv)`` at states ``(R, nq)`` and ``(R, nv)``."""
        return np.zeros_like(velocity)

    def recall(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return what a force remembers of the past where a simulation begins, ``(R, k)``; by default, nothing."""
        return np.zeros((len(position), 0))

    def replay(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        drive: Drive,
    ) -> np.ndarray:  # fmt: skip
        """Return :meth:`recall` where the log shows the past: the states of P rows before, and the one that begins.

        Args:
            setting, target, values: see :meth:`recall`.
            position, velocity: the states, ``(R, P + 1, nq)`` and ``(R, P + 1, nv)``; NaN before an episode begins.
            drive: the actuators under the commands of the P rows before, of which each is a step.
        """
        return self.recall(setting, target, values, position[:, -1], velocity[:, -1])

    def force_after(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return :meth:`force` with what it remembers of the states before, and what it remembers then, ``(R, k)``.

        It is called once in every physics step, first with :meth:`recall`. By default, a force remembers nothing.
        """
        return self.force(setting, target, values, position, velocity), memory

    def force_under(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray, drive: Drive,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return :meth:`force_after` of one that depends on what the actuators give.

        It is called in the place of :meth:`force_after` where it is overridden; :meth:`force` is then that without any
        drive.
        """
        return self.force_after(setting, target, values, position, velocity, memory)

    def wrench(self, setting: Setting, target: str | None, values: np.ndarray) -> np.ndarray:
        """Return constant world-frame forces and torques on the bodies' centers ``(nbody, 6)``, of values ``(p,)``."""
        return np.zeros((setting.model.nbody, 6))

    def settled(self, command: torch.Tensor, values: torch.Tensor, step: float) -> torch.Tensor:
        """Return the state of a filter that has long had commands ``(R, 1)``, ``(R, k)``; by default, these commands.

        Its width may depend on the values. Where another call's is wider, the last entries count.
        """
        return command

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Filter an actuator's commands, a whole episode's or those of some physics steps.

        Args:
            signal: commands of S physics steps, ``(R, S)``.
            values: the effect's numbers, ``(R, p)`` or ``(1, p)``.
            step: seconds of a physics step.
            state: what is remembered of the commands before, ``(R, k)``; see :meth:`settled`.

        Returns:
            The commands as they act, ``(R, S)``, and the state to go on from.
        """
        return signal, state

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        """Return what the sensor of an observed column shows of simulated paths, ``(R, T)``."""
        return path.shown[..., column]

    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        """Return a column of true states ``(R,)`` from observed columns and their time derivatives, ``(R, n)`` each."""
        return shown[:, column]

    def memory(self, values: np.ndarray) -> float:
        """Return the seconds that :meth:`command`, :meth:`sense` or :meth:`replay` looks back; infinite for all."""
        return math.inf if self.has("command") or self.has("replay") else 0.0

    def has(self, method: Method) -> bool:
        """Whether the effect acts by a method."""
        return getattr(type(self), method) is not getattr(Effect, method)

    @property
    def native(self) -> bool:
        """Whether the effect is numbers of the model and nothing else."""
        return not (self.has("force") or self.has("wrench") or self.is_filter)

    @property
    def in_mjcf(self) -> bool:
        """Whether MJCF can express the effect: not all numbers of a model can be told apart there."""
        return self.native

    @property
    def outer(self) -> bool:
        """Whether the effect stays outside of the simulator: it filters commands or measurements and nothing else."""
        return self.is_filter and not (self.has("apply") or self.has("force") or self.has("wrench"))

    @property
    def is_filter(self) -> bool:
        """Whether the effect filters commands or measurements."""
        return self.has("command") or self.has("sense")


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

    @property
    def called(self) -> tuple[str, str | None]:
        """Effect and target as answers call them: kinds of the same effect have one name, and exclude each other."""
        return self.effect.known_as or self.effect.name, self.target

    def at(self, values: Sequence[float] | np.ndarray) -> Placed:
        """Return the same effect with other values."""
        return Placed(self.effect, self.target, tuple(float(v) for v in values))

    def eased(self, setting: Setting) -> Placed:
        """Return the effect with the values under which differences by other numbers are taken."""
        return self.at(self.effect.eased(setting, self.values))

    def is_neutral(self, setting: Setting) -> bool:
        """Return whether the effect is absent with these values."""
        quantities = self.effect.quantities(setting, self.target)
        return all(v == q.neutral for q, v in zip(quantities, self.values, strict=True))

    def summary(self, setting: Setting) -> dict[str, Any]:
        """Return the values by name."""
        return {q.name: v for q, v in zip(self.effect.quantities(setting, self.target), self.values, strict=True)}


def by_product(start: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values that a linear prediction stands for where the first number multiplies the others, ``(p,)``.

    What acts is linear: of a mass at a place, its moment; of a spring, the force at rest. The prediction moves that by
    the amount at the start times the move of a place, and a larger amount does it with less of a move.

    Args:
        start: an amount, and places where it acts.
        values: the prediction.
    """
    least = LEAST_AMOUNT * abs(start[0])
    amount = values[0] if values[0] * start[0] > 0 else start[0]
    share = start[0] / (np.sign(amount) * max(abs(amount), least)) if amount else 1.0
    return np.concatenate([values[:1], start[1:] + share * (values[1:] - start[1:])])


def apply_all(model: mujoco.MjModel, placed: Iterable[Placed]) -> None:
    """Write effects into a model, in whatever order they are given, but not yet what is derived from them."""
    for p in sorted(placed, key=lambda p: not p.effect.steps):
        p.effect.apply(model, p.target, np.asarray(p.values))


def applied(model: mujoco.MjModel, placed: Iterable[Placed]) -> mujoco.MjModel:
    """Return a copy of a model with effects written into it, but not yet what is derived from them."""
    out = copy.copy(model)
    apply_all(out, placed)
    return out
