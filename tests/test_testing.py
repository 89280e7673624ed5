"""The conformance suite can fail: for every law there is an implementation that breaks it, and is told so."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from conftest import WHOLE, space_of

from dropo_torch.distribution import Distribution
from dropo_torch.effects import Effect, Quantity, Setting, find_effect, register
from dropo_torch.effects.actuator import ActuatorEffect
from dropo_torch.effects.joint import JointEffect
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.sensor import SensorEffect
from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FisherOptimizer, FitSettings, Progress, Request
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.effects import RowForces
from dropo_torch.testing import (
    ConformanceError,
    LinearSimulator,
    Tolerance,
    check_effect,
    check_optimizer,
    check_simulator,
    linear_problem,
)
from dropo_torch.testing import effects as effect_laws
from dropo_torch.testing import optimizers as optimizer_laws
from dropo_torch.testing import simulators as simulator_laws
from dropo_torch.testing.laws import Report, try_laws


def law_names(laws: tuple[Callable[..., None], ...]) -> set[str]:
    return {law.__name__.strip("_").replace("_", " ") for law in laws}


# Simulators

GAINS = np.array([[2.0, 0.3], [-0.5, 1.0]])
SPRING = np.array([[0.9, 0.1], [-0.2, 0.95]])


class Sound(LinearSimulator):
    """Two states that two parameters and a control drive."""

    def __init__(self, space: ParameterSpace | None = None, **options: Any) -> None:
        space = space or space_of(a=[0.0, 3.0], b={"bounds": [1.0, 9.0], "limits": [0.1, 20.0]})
        super().__init__(space, GAINS, transition=SPRING, control=np.array([[0.0], [0.5]]), **options)


class TooSmall(Sound):
    num_controls = property(lambda self: 1, lambda self, value: None)
    frame_skip = property(lambda self: 0, lambda self, value: None)


class InFloat32(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states, controls, values).float()


class DislikesEmpty(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states, controls, values)[: max(1, len(states))].reshape(-1, len(values), 3, 2)

    def simulate(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        self.check_arguments(states, controls, values)
        after = super().rollout(states, controls, values)[:, :, -1]
        return after if after.numel() else torch.zeros(1, 1, 2, dtype=torch.float64)


class Careless(Sound):
    def check_arguments(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> None:
        if states.shape[1] != self.num_states:
            raise InputError("states")


class Warm(Sound):
    """Something is left of what was simulated before."""

    left = 0.0

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        out = super().rollout(states, controls, values) + 1e-9 * self.left
        self.left = float(len(values))
        return out


class Meddling(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        out = super().rollout(states, controls, values)
        with torch.no_grad():
            controls.clamp_(-0.1, 0.1)
        return out


class Shared(Sound):
    """The result is a buffer of its own."""

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        out = super().rollout(states, controls, values)
        key = tuple(out.shape)
        self.kept = getattr(self, "kept", {})
        self.kept.setdefault(key, torch.empty_like(out)).copy_(out)
        return self.kept[key]


class Crowded(Sound):
    """A transition depends on how many there are."""

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states, controls, values) * (1 + 1e-15 * len(states))


class Threaded(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states, controls, values) * (1 + 1e-15 * (torch.get_num_threads() == 3))


class Early(Sound):
    """What simulate gives is the first of a rollout, not the last."""

    def simulate(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return self.rollout(states, controls, values)[:, :, 0]


class Contagious(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        out = super().rollout(states, controls, values)
        return out * torch.nan if bool(states.isnan().any()) else out


class LateToTell(Sound):
    """What was simulated before it diverged is still there."""

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        out = super().rollout(states, controls, values)
        lost = values.isnan().any(1)
        return torch.cat([out[:, :, :1].masked_fill(lost[:, None, None], 0.0), out[:, :, 1:]], 2)


class Strict(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        self.check_arguments(states, controls, values)
        if bool((values > torch.from_numpy(self.parameters.high)).any()):
            raise InputError("values: outside the bounds")
        return super().rollout(states, controls, values)


class Deaf(Sound):
    """The second parameter does nothing."""

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        self.check_arguments(states, controls, values)
        return super().rollout(states, controls, values * torch.tensor([1.0, 0.0]))


class WrongGradient(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states, controls, values + 0.01 * (values.detach() - values))


class Silent(Sound):
    """It says that it has no gradients, but lets them be asked."""

    differentiable: ClassVar[bool] = False

    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(*(x.detach() for x in (states, controls, values)))


class TensorsOnly(Sound):
    def rollout(self, states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return super().rollout(states.clone(), controls, values)


def off_by_little(states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    return Sound().rollout(states, controls, values) + 1e-6


BROKEN_SIMULATORS: list[tuple[str, LinearSimulator, dict[str, Any]]] = [
    ("it says what it is", TooSmall(), {}),
    ("results have their shape and are float64", InFloat32(), {}),
    ("empty batches give empty results", DislikesEmpty(), {}),
    ("arguments that do not fit are refused", Careless(), {}),
    ("the same arguments give the same result", Warm(), {}),
    ("arguments are left as they are", Meddling(), {}),
    ("a result belongs to the caller", Shared(), {}),
    ("order and size of the batch do not matter", Crowded(), {}),
    ("threads do not matter", Threaded(), {}),
    ("variants give the same result", Sound(), {"variants": [Sound(), Sound(transform=lambda v: v * (1 + 1e-15))]}),
    (
        "variants give the same result",
        Sound(),
        {"variants": [Sound(space_of(b={"bounds": [1.0, 9.0], "limits": [0.1, 20.0]}, a=[0.0, 3.0]))]},
    ),
    ("simulate is the last of a rollout", Early(), {}),
    ("what diverges is nan throughout and takes no other with it", Contagious(), {}),
    ("what diverges is nan throughout and takes no other with it", LateToTell(), {"diverging": True}),
    ("values beyond the bounds are simulated", Strict(), {}),
    ("every parameter acts", Deaf(), {}),
    ("states are those of the reference", Sound(), {"reference": off_by_little}),
    ("states are those of the reference", Sound(), {"reference": off_by_little, "tolerance": Tolerance(states=1e-8)}),
    ("gradients are those of central differences", WrongGradient(), {}),
    ("gradients are those of central differences", Silent(), {}),
    ("arrays are taken as tensors are", TensorsOnly(), {}),
]


def checked(simulator: LinearSimulator, **options: Any) -> Report:
    rng = np.random.default_rng(0)
    states, controls = (torch.from_numpy(rng.normal(size=shape)) for shape in ((5, 2), (5, 3, 1)))
    if options.get("diverging"):
        options["diverging"] = torch.full((1, 2), torch.nan, dtype=torch.float64)
    return check_simulator(simulator, states, controls, **options)


def test_a_sound_simulator_keeps_every_law() -> None:
    same = Sound().rollout
    report = checked(Sound(), variants=[Sound()], reference=same, diverging=True)
    assert set(report.checked) == law_names(simulator_laws.LAWS)
    assert not report.skipped
    assert "17 laws hold" in str(report)
    alone = checked(Sound())
    assert alone.skipped["variants give the same result"] == "no variants were given"
    assert "no reference was given" in str(alone)


def test_every_law_of_simulators_can_be_broken() -> None:
    assert {law for law, _, _ in BROKEN_SIMULATORS} == law_names(simulator_laws.LAWS)


@pytest.mark.parametrize(
    ("law", "simulator", "options"), BROKEN_SIMULATORS, ids=[f"{x[0]}-{type(x[1]).__name__}" for x in BROKEN_SIMULATORS]
)
def test_a_broken_simulator_is_told_which_law(law: str, simulator: LinearSimulator, options: dict[str, Any]) -> None:
    with pytest.raises(ConformanceError) as caught:
        checked(simulator, **options)
    assert caught.value.law == law
    assert caught.value.found
    assert caught.value.expected
    assert str(caught.value).startswith(f"{type(simulator).__name__}: broken law '{law}': found ")


# Optimizers


class Fisher(FisherOptimizer):
    """The scoring, made as a search of an objective."""

    def __init__(self, objective: Objective, seed: int) -> None:
        super().__init__(objective, FitSettings(seed=seed, samples=10))
        self.objective = objective


class Endless(Fisher):
    stop_reason = property(lambda self: None)
    ask = lambda self: FisherOptimizer(self.objective, FitSettings()).ask()  # noqa: E731
    tell = lambda self, sums, gradient=None: None  # noqa: E731


class Nameless(Fisher):
    name: ClassVar[str] = ""


class Overdone(Fisher):
    progress = property(lambda self: Progress("overdone", 0.0, 1.5))


class Impossible(Fisher):
    """It asks for what cannot be."""

    def ask(self) -> Request:
        request = super().ask()
        request.values[0, 0] = -7.0
        return request


class Restless(Fisher):
    """Every request is another."""

    def ask(self) -> Request:
        request = super().ask()
        self.asked = getattr(self, "asked", 0) + 1
        request.values[0, 0] += 1e-12 * self.asked
        return request


class Nosy(Fisher):
    def ask(self) -> Request:
        request = super().ask()
        self.objective.map(request.values, request.reduce)
        return request


class Outside(Fisher):
    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(mean + 100, std) for mean, std in super().candidates()]


class Indistinct(Fisher):
    def distributions(self, space: ParameterSpace) -> list[Distribution]:
        return []


class Fancy(Fisher):
    def extras(self) -> dict[str, Any]:
        return {"array": np.zeros(3)}


class Forgetful(Fisher):
    def restore(self, state: dict[str, Any]) -> None:
        super().restore({**state, "means": {**state["means"], "damping": 1.0}})


class Moody(Fisher):
    """It draws from the generator that all share."""

    def __init__(self, objective: Objective, seed: int) -> None:
        super().__init__(objective, seed=int(torch.randint(1000, (1,))))
        self._means.damping *= 1 + float(torch.rand(1))


class Brittle(Fisher):
    def tell(self, sums: torch.Tensor, gradient: torch.Tensor | None = None) -> None:
        super().tell(sums, gradient)
        if not self._means.hessian.any():
            raise ZeroDivisionError("division by zero")


class Biased(Fisher):
    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(mean + 0.2, std) for mean, std in super().candidates()]


class Overconfident(Fisher):
    def candidates(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(mean, np.maximum(0.7 * std, self._box.min_std)) for mean, std in super().candidates()]


BROKEN_OPTIMIZERS: dict[str, type[Fisher]] = {
    "it stops and says why": Endless,
    "it has a name": Nameless,
    "progress is a stage and a share": Overdone,
    "requests are vectors within the physical limits": Impossible,
    "asking again asks the same": Restless,
    "it only asks for simulations": Nosy,
    "means stay within the box": Outside,
    "distributions are over the space": Indistinct,
    "extras are plain data": Fancy,
    "it goes on from any state as if never interrupted": Forgetful,
    "the seed alone decides": Moody,
    "it ends where every simulation fails": Brittle,
    "it finds the means": Biased,
    "it finds the standard deviations": Overconfident,
}


def test_a_sound_optimizer_keeps_every_law() -> None:
    report = check_optimizer(Fisher)
    assert set(report.checked) == law_names(optimizer_laws.LAWS) == set(BROKEN_OPTIMIZERS)
    assert not report.skipped


@pytest.mark.parametrize(("law", "kind"), BROKEN_OPTIMIZERS.items(), ids=BROKEN_OPTIMIZERS)
def test_a_broken_optimizer_is_told_which_law(law: str, kind: type[Fisher], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimizer_laws, "_ENDLESS", 100)
    with pytest.raises(ConformanceError) as caught:
        check_optimizer(kind, problem=linear_problem(40))
    assert caught.value.law == law


# Effects


class Drag(JointEffect):
    """A sound effect: a force against the motion."""

    name = "drag_test"
    sentence = "{target} is braked"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("damping", "N·m·s/rad", 0.0, 0.0, 10.0, 1.0),)

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        out = np.zeros_like(velocity)
        out[:, setting.dof(target)] = -values[:, 0] * velocity[:, setting.dof(target)]
        return out


class Smoothed(ActuatorEffect):
    """A sound filter: each step takes a share of the difference to the command."""

    name = "smoothed_test"
    sentence = "{target} follows late"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("share", "-", 0.0, 0.0, 0.9, 1.0),)

    def memory(self, values: np.ndarray) -> float:
        return 0.2

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        out, last = [], state
        for now in signal.split(1, 1):
            last = values[:, :1] * last + (1 - values[:, :1]) * now
            out.append(last)
        return torch.cat(out, 1), last


class Shifted(SensorEffect):
    """A sound sensor, that is off by a constant."""

    name = "shifted_test"
    sentence = "{target} is off"

    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("shift", "rad", 0.0, -1.0, 1.0, 0.1),)

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return path.shown[..., column] + values[:, :1]

    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        return shown[:, column] - values[:, 0]


class Silent(Drag):
    sentence = "something is braked"


class Nowhere(Drag):
    def targets(self, setting: Setting) -> list[str | None]:
        return ["knee"]


class Upside(Drag):
    def quantities(self, setting: Setting, target: str | None) -> tuple[Quantity, ...]:
        return (Quantity("damping", "N·m·s/rad", 0.0, 0.5, 10.0, 1.0),)


class FarOff(Drag):
    def starts(self, setting: Setting, target: str | None) -> list[np.ndarray]:
        return [np.array([11.0])]


class Twin(Drag):
    """Pickled, it is another."""

    name = "twin_test"

    def __reduce__(self) -> tuple[Any, ...]:
        return find_effect, ("joint_damping",)


class Rough(Drag):
    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        velocity *= 1.0001
        return super().force(setting, target, values, position, velocity)


class Tired(Drag):
    """It weakens with every use."""

    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        self.used = getattr(self, "used", 0) + 1
        return super().force(setting, target, values, position, velocity) / self.used


class OneForAll(Drag):
    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        return super().force(setting, target, values[:1], position, velocity)


class Sudden(Drag):
    """Once it has a past, if only of an instant, it is another force."""

    def force_after(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray,
        memory: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        return 2 * self.force(setting, target, values, position, velocity), memory


class Amnesic(Smoothed):
    """What it remembers is lost between two calls."""

    def command(
        self, signal: torch.Tensor, values: torch.Tensor, step: float, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return super().command(signal, values, step, state)[0], state


class Unsettled(Smoothed):
    def settled(self, command: torch.Tensor, values: torch.Tensor, step: float) -> torch.Tensor:
        return torch.zeros_like(command)


class LongMemory(Smoothed):
    def memory(self, values: np.ndarray) -> float:
        return 0.0


class Averaging(Shifted):
    """A measurement depends on how many there are."""

    def sense(self, path: SensedPath, column: int, values: torch.Tensor) -> torch.Tensor:
        return super().sense(path, column, values) + values[:, :1] * path.shown[..., column].mean(1, keepdim=True)


class OneWay(Shifted):
    def unsense(self, shown: torch.Tensor, rates: torch.Tensor, column: int, values: torch.Tensor) -> torch.Tensor:
        return shown[:, column]


class NeverNeutral(Drag):
    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        return super().force(setting, target, values + 0.01, position, velocity)


class Powerless(Drag):
    def force(
        self, setting: Setting, target: str | None, values: np.ndarray, position: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        return np.zeros_like(velocity)


BROKEN_EFFECTS: dict[str, Effect] = {
    "it says what it is": Silent(),
    "it has places": Nowhere(),
    "its numbers are consistent": Upside(),
    "searches begin within the bounds": FarOff(),
    "it is kept by its name": Twin(),
    "the same numbers do the same and nothing given is changed": Rough(),
    "rows do not depend on each other": OneForAll(),
    "a force without a past is that of its state": Sudden(),
    "commands in pieces are those in one": Amnesic(),
    "a settled filter is steady": Unsettled(),
    "what lies beyond its memory does not matter": LongMemory(),
    "measurements in pieces are those in one": Averaging(),
    "true states are found from shown ones": OneWay(),
    "neutral numbers change nothing": NeverNeutral(),
    "numbers that matter change the simulation": Powerless(),
}
#: What makes environments of their own of an effect, and so may disagree, is no part of an effect.
OTHERS = {"fit and training agree"}


@pytest.mark.parametrize("effect", [Drag(), Smoothed(), Shifted()], ids=lambda e: e.name)
def test_a_sound_effect_keeps_every_law(effect: Effect) -> None:
    places = ("root.position[x]", "root.position[y]", "rail.position") if isinstance(effect, Shifted) else ()
    report = check_effect(effect, idle=places)
    assert report.skipped["it is kept by its name"] == "the effect is not registered"
    assert {*report.checked, *report.skipped} == law_names(effect_laws.LAWS) == {*BROKEN_EFFECTS, *OTHERS}


@pytest.mark.parametrize(
    ("law", "effect"),
    [*BROKEN_EFFECTS.items(), ("the same numbers do the same and nothing given is changed", Tired())],
    ids=lambda x: x if isinstance(x, str) else type(x).__name__,
)
def test_a_broken_effect_is_told_which_law(law: str, effect: Effect) -> None:
    if isinstance(effect, Twin):
        register(effect)
    with pytest.raises(ConformanceError) as caught:
        check_effect(effect)
    assert caught.value.law == law


def test_a_training_that_disagrees_with_a_fit_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RowForces, "restart", lambda self, ids, values: None)
    with pytest.raises(ConformanceError, match="broken law 'fit and training agree': found states of a training at"):
        check_effect(Drag())


def test_what_raises_in_a_law_is_told_with_it() -> None:
    counter = itertools.count()

    def _nothing_is_divided_by_zero(case: int) -> None:
        next(counter)
        1 / case

    with pytest.raises(ConformanceError, match=r"it: broken law 'nothing is divided by zero': found ZeroDivisionError"):
        try_laws("it", 0, [_nothing_is_divided_by_zero])
    assert try_laws("it", 1, [_nothing_is_divided_by_zero]).checked == ("nothing is divided by zero",)


# Tiers


def test_what_is_left_out_of_every_commit_exists() -> None:
    for file, names in WHOLE.items():
        text = (Path(__file__).parent / file).read_text()
        assert [n for n in names if n and f"def {n}(" not in text] == [], file
