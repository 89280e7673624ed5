"""The conformance suite can fail: for every law there is an implementation that breaks it, and is told so."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from conftest import space_of

from dropo_torch.distribution import Distribution
from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.optimizers import FisherOptimizer, FitSettings, Progress, Request
from dropo_torch.parameters import ParameterSpace
from dropo_torch.testing import (
    ConformanceError,
    LinearSimulator,
    Tolerance,
    check_optimizer,
    check_simulator,
    linear_problem,
)
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
    assert "16 laws hold" in str(report)
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


def test_what_raises_in_a_law_is_told_with_it() -> None:
    counter = itertools.count()

    def _nothing_is_divided_by_zero(case: int) -> None:
        next(counter)
        1 / case

    with pytest.raises(ConformanceError, match=r"it: broken law 'nothing is divided by zero': found ZeroDivisionError"):
        try_laws("it", 0, [_nothing_is_divided_by_zero])
    assert try_laws("it", 1, [_nothing_is_divided_by_zero]).checked == ("nothing is divided by zero",)
