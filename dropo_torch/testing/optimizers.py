"""The laws of an optimizer."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from dropo_torch.distribution import DRAWN_STD, Distribution, SearchBox
from dropo_torch.errors import InputError
from dropo_torch.fit import answer, noise_of
from dropo_torch.objective import Objective
from dropo_torch.optimizers.base import Optimizer, Progress, Request
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.checkpoint import dumps, loads
from dropo_torch.support.rows import evenly
from dropo_torch.testing.laws import NotApplicable, Report, require, require_same, try_laws
from dropo_torch.testing.linear import LinearSimulator, linear_objective

#: Batches after which a search that goes on is taken for endless.
_ENDLESS = 10_000
#: Moments of a search from which it is continued.
_CONTINUED = 6

#: ``make(objective, seed) -> optimizer``
MakeOptimizer = Callable[[Objective, int], Optimizer]


@dataclass(frozen=True)
class KnownProblem:
    """A log whose most likely distribution is known.

    Attributes:
        name: what it is, for messages.
        objective: makes its objective, a new one at each call.
        mean, std: the most likely μ and standard deviation of the draws, in coordinates, ``(d,)`` each; where they
            are not known, NaN.
    """

    name: str
    objective: Callable[[], Objective]
    mean: np.ndarray
    std: np.ndarray


def linear_problem(
    number: int = 120,
    *,
    noise: float | None = None,
    transform: Callable[[torch.Tensor], torch.Tensor] | None = None,
    box: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 3.0), (1.0, 9.0)),
) -> KnownProblem:
    """Return two parameters that differ from transition to transition, each seen in a column of its own.

    Args:
        number: transitions.
        noise: standard deviation of the measurement that the objective reckons with, though there is none; the truth
            is then not known in closed form.
        transform: bends the simulation; the truth is then not known in closed form.
        box: bounds of the means; where they leave out the truth, 1.2 and 4, it is the nearest point.
    """
    gains, epsilon = np.array([2.0, -0.5]), 1e-4
    drawn = np.random.default_rng(0).normal([1.2, 4.0], [0.15, 0.4], (number, 2))
    bend = transform or (lambda x: x)
    measured = bend(torch.from_numpy(drawn)).numpy() * gains
    limits = [[low - 0.5, high + 1.0] for low, high in box]
    space = ParameterSpace(
        None, {n: {"bounds": list(b), "limits": x} for n, b, x in zip(("a", "b"), box, limits, strict=True)}
    )

    def objective() -> Objective:
        simulator = LinearSimulator(space, np.diag(gains), transform=bend)
        return linear_objective(simulator, measured, epsilon=epsilon, noise=noise)

    mean = np.clip(drawn.mean(0), space.low, space.high)
    std = np.sqrt(drawn.var(0) - epsilon / gains**2)
    is_known = noise is None and transform is None
    if not is_known:
        mean, std = np.full(2, np.nan), np.full(2, np.nan)
    elif not np.array_equal(mean, drawn.mean(0)):
        std = np.full(2, np.nan)
    words = ["linear" if transform is None else "curved", "exact" if noise is None else "noisy"]
    return KnownProblem(", ".join(words), objective, mean, std)


def check_optimizer(
    make: MakeOptimizer,
    *,
    problem: KnownProblem | None = None,
    mean: float | None = 0.02,
    std: float | None = 0.1,
    seed: int = 0,
) -> Report:
    """Check that an optimizer keeps the laws that fits rely on; see :class:`~dropo_torch.optimizers.Optimizer`.

    Args:
        make: makes an optimizer of an objective and a seed, a new one at each call.
        problem: what is searched; by default :func:`linear_problem`, whose best distribution is known.
        mean: how near the means must come to the truth, as a share of the search width; ``None`` for a method that
            does not look for it.
        std: how near the standard deviations of the draws must come, relative to the truth; ``None`` for a method
            whose spread is not that of the parameters.
        seed: of the search.

    Raises:
        ConformanceError: the first law that does not hold.
    """
    case = OptimizerCase(make, problem or linear_problem(), mean, std, seed)
    return try_laws(f"{type(make(case.problem.objective(), seed)).__name__} ({case.problem.name})", case, LAWS)


@dataclass(frozen=True)
class Step:
    """One batch of a search: the state around its request, what was asked, and the candidates after it was told."""

    before: bytes
    between: bytes
    request: Request
    progress: Progress
    candidates: list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Search:
    """A search from its beginning to its end."""

    objective: Objective
    optimizer: Optimizer
    steps: list[Step]


@dataclass(frozen=True)
class OptimizerCase:
    """An optimizer and what it is checked on; see :func:`check_optimizer`."""

    make: MakeOptimizer
    problem: KnownProblem
    mean: float | None
    std: float | None
    seed: int

    @cached_property
    def search(self) -> Search:
        """A search of the problem that nothing interrupts."""
        return run_search(self.make, self.problem.objective(), self.seed)


def told(objective: Objective, request: Request) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return what ``tell`` takes for a request."""
    sums = answer(objective, request, noise_of(objective, request))
    return sums.total, sums.gradient


def run_search(make: MakeOptimizer, objective: Objective, seed: int) -> Search:
    """Ask, simulate and tell until an optimizer stops, keeping its state at every step."""
    optimizer = make(objective, seed)
    steps: list[Step] = []
    while optimizer.stop_reason is None:
        require(len(steps) < _ENDLESS, f"a search that goes on after {_ENDLESS} batches", "a stop_reason in the end")
        before = _kept(optimizer)
        request = optimizer.ask()
        between = _kept(optimizer)
        optimizer.tell(*told(objective, request))
        steps.append(Step(before, between, request, optimizer.progress, optimizer.candidates()))
    return Search(objective, optimizer, steps)


def _kept(optimizer: Optimizer) -> bytes:
    """The optimizer's state as a checkpoint holds it."""
    return b"".join(dumps("fit", (), optimizer.state(), optimizer.KINDS))


def _flat(candidates: list[tuple[np.ndarray, np.ndarray]]) -> torch.Tensor:
    return torch.from_numpy(np.array([np.concatenate(c) for c in candidates]))


def _it_has_a_name(case: OptimizerCase) -> None:
    optimizer = case.search.optimizer
    for attribute in ("name", "method"):
        given = getattr(optimizer, attribute, None)
        require(isinstance(given, str) and given, f"{attribute} {given!r}", "a word for files and reports")


def _it_stops_and_says_why(case: OptimizerCase) -> None:
    reason = case.search.optimizer.stop_reason
    require(isinstance(reason, str) and reason, f"stop_reason {reason!r}", "words")


def _progress_is_a_stage_and_a_share(case: OptimizerCase) -> None:
    for progress in [case.search.optimizer.progress, *(s.progress for s in case.search.steps)]:
        require(0 <= progress.fraction <= 1, f"a fraction of {progress.fraction}", "one between 0 and 1")
        require(progress.stage, f"stage {progress.stage!r}", "words")


def _requests_are_vectors_within_the_physical_limits(case: OptimizerCase) -> None:
    space = case.search.objective.simulator.parameters
    for step in case.search.steps:
        values = step.request.values
        shape = getattr(values, "shape", None)
        is_batch = isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] == len(space)
        require(is_batch, f"values of shape {shape}", f"an array (P, {len(space)})")
        require(np.isfinite(values).all(), "values that are not finite", "parameter vectors in their units")
        slack = 1e-9 * (1 + np.abs(space.limits))
        inside = (values >= space.limits[:, 0] - slack[:, 0]) & (values <= space.limits[:, 1] + slack[:, 1])
        where = [n for n, ok in zip(space.names, inside.all(0), strict=True) if not ok]
        require(not where, f"a request beyond the physical limits of {', '.join(where)}", "none")
        require(step.request.evaluations >= 0, f"{step.request.evaluations} evaluations", "0 or more")


def _asking_again_asks_the_same(case: OptimizerCase) -> None:
    objective = case.problem.objective()
    optimizer = case.make(objective, case.seed)
    while optimizer.stop_reason is None:
        first, second = optimizer.ask(), optimizer.ask()
        _require_same_request(second, first, "a second request before it was told", "the first")
        sums, gradient = told(objective, first)
        require_same(told(objective, second)[0], sums, "sums of a request asked for again", "those of the first")
        optimizer.tell(sums, gradient)


def _it_only_asks_for_simulations(case: OptimizerCase) -> None:
    objective = case.problem.objective()
    simulator: Any = objective.simulator
    optimizer = case.make(objective, case.seed)
    while optimizer.stop_reason is None:
        before = simulator.calls
        request = optimizer.ask()
        require(simulator.calls == before, "a simulation inside ask", "a Request that names it")
        sums = told(objective, request)
        before = simulator.calls
        optimizer.tell(*sums)
        optimizer.candidates()
        require(simulator.calls == before, "a simulation inside tell or candidates", "none: what is told suffices")


def _means_stay_within_the_box(case: OptimizerCase) -> None:
    box = SearchBox.of(case.search.objective.simulator.parameters)
    for mean, std in [c for s in case.search.steps for c in s.candidates] + case.search.optimizer.candidates():
        require(mean.shape == std.shape == box.low.shape, f"μ {mean.shape}, σ {std.shape}", f"{box.low.shape} each")
        slack = 1e-9 * box.width
        inside = ((mean >= box.low - slack) & (mean <= box.high + slack)).all()
        require(inside, f"a candidate's mean {mean}", f"one between {box.low} and {box.high}")
        positive = ((std >= 0.999 * box.min_std) & (std <= box.width)).all()
        require(positive, f"a candidate's σ {std}", f"one between {box.min_std} and the width {box.width}")


def _distributions_are_over_the_space(case: OptimizerCase) -> None:
    space = case.search.objective.simulator.parameters
    found = case.search.optimizer.distributions(space)
    require(found, "no final distribution", "one or more")
    for distribution in found:
        require(isinstance(distribution, Distribution), f"a {type(distribution).__name__}", "a Distribution")
        draws = distribution.sample(16, torch.Generator().manual_seed(0))
        require(draws.shape == (16, len(space)), f"draws of shape {tuple(draws.shape)}", f"(16, {len(space)})")
        require(np.isfinite(case.search.optimizer.bonus(distribution)), "a bonus that is not finite", "a number")


def _extras_are_plain_data(case: OptimizerCase) -> None:
    json.dumps(case.search.optimizer.extras())


def _it_goes_on_from_any_state_as_if_never_interrupted(case: OptimizerCase) -> None:
    whole = case.search
    used = whole.optimizer  # one that has finished takes up an earlier state, too
    final = _flat(whole.optimizer.candidates())
    reason = whole.optimizer.stop_reason
    for number, at in enumerate(evenly(len(whole.steps), _CONTINUED)):
        if not whole.steps:
            return
        objective = case.problem.objective()
        other = used if number == 1 else case.make(objective, case.seed)
        step = whole.steps[at]
        other.restore(loads(step.between if number % 2 else step.before, other.KINDS)[2])
        for i in range(at, len(whole.steps)):
            request = other.ask()
            _require_same_request(request, whole.steps[i].request, f"request {i} after going on from {at}", "the first")
            other.tell(*told(objective, request))
            require_same(
                _flat(other.candidates()), _flat(whole.steps[i].candidates), f"candidates {i} from {at}", "the first"
            )
        require(other.stop_reason == reason, f"stop_reason {other.stop_reason!r}", repr(reason))
    require_same(_flat(used.candidates()), final, "the final candidates", "those of the first run")


def _the_seed_alone_decides(case: OptimizerCase) -> None:
    before = torch.get_rng_state()
    kept = np.random.get_state()  # noqa: NPY002 - what others draw from must not matter
    try:
        for seed in (1, 2):
            torch.manual_seed(seed)
            np.random.seed(seed)  # noqa: NPY002
            again = run_search(case.make, case.problem.objective(), case.seed)
            require(
                len(again.steps) == len(case.search.steps),
                f"{len(again.steps)} batches with the same seed",
                f"{len(case.search.steps)}, as the first time",
            )
            for i, (found, expected) in enumerate(zip(again.steps, case.search.steps, strict=True)):
                _require_same_request(found.request, expected.request, f"request {i} with the same seed", "the first")
            require_same(
                _flat(again.optimizer.candidates()),
                _flat(case.search.optimizer.candidates()),
                "candidates with the same seed",
                "those of the first run",
            )
    finally:
        torch.set_rng_state(before)
        np.random.set_state(kept)  # noqa: NPY002


def _it_ends_where_every_simulation_fails(case: OptimizerCase) -> None:
    objective = case.problem.objective()
    simulator: Any = objective.simulator
    simulator.transform = lambda values: values * torch.nan
    try:
        found = run_search(case.make, objective, case.seed)
    except InputError:
        return  # refused in one line
    candidates = _flat(found.optimizer.candidates())
    require(bool(candidates.isfinite().all()), f"candidates {candidates.tolist()}", "finite numbers")


def _it_finds_the_means(case: OptimizerCase) -> None:
    if case.mean is None:
        raise NotApplicable("the method does not look for them")
    if np.isnan(case.problem.mean).any():
        raise NotApplicable("the problem's are not known in closed form")
    objective = case.search.objective
    for distribution in case.search.optimizer.distributions(objective.simulator.parameters):
        error = np.abs(distribution.mean - case.problem.mean) / objective.box.width
        require(
            (error <= case.mean).all(),
            f"means {distribution.mean}, off by {error.max():.2g} of the search width",
            f"{case.problem.mean}, within {case.mean:g} of it",
        )


def _it_finds_the_standard_deviations(case: OptimizerCase) -> None:
    if case.std is None:
        raise NotApplicable("the method's spread is not that of the parameters")
    if np.isnan(case.problem.std).any():
        raise NotApplicable("the problem's are not known in closed form")
    for distribution in case.search.optimizer.distributions(case.search.objective.simulator.parameters):
        found = distribution.std * DRAWN_STD  # draws end at two σ
        error = np.abs(found / case.problem.std - 1)
        require(
            (error <= case.std).all(),
            f"standard deviations of the draws {found}, off by {error.max():.2g}",
            f"{case.problem.std}, within {case.std:g} of them",
        )


def _require_same_request(found: Request, expected: Request, what: str, like: str) -> None:
    require_same(torch.from_numpy(found.values), torch.from_numpy(expected.values), f"{what}, values,", like)
    for name in ("linearise_at", "linearise_std", "widen", "rows"):
        one, other = getattr(found, name), getattr(expected, name)
        require(np.array_equal(one, other), f"{what}: {name} {one}", f"{other}, as in {like}")
    for name in ("evaluations", "gradient", "is_stencil"):
        one, other = getattr(found, name), getattr(expected, name)
        require(one == other, f"{what}: {name} {one}", f"{other}, as in {like}")


LAWS = (
    _it_stops_and_says_why,
    _it_has_a_name,
    _progress_is_a_stage_and_a_share,
    _requests_are_vectors_within_the_physical_limits,
    _asking_again_asks_the_same,
    _it_only_asks_for_simulations,
    _means_stay_within_the_box,
    _distributions_are_over_the_space,
    _extras_are_plain_data,
    _it_goes_on_from_any_state_as_if_never_interrupted,
    _the_seed_alone_decides,
    _it_ends_where_every_simulation_fails,
    _it_finds_the_means,
    _it_finds_the_standard_deviations,
)
