"""The laws of a simulator."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.base import DIVERGED, Simulator
from dropo_torch.simulators.hidden import POSE, filters_of, prescribed_bodies
from dropo_torch.testing.laws import Broken, NotApplicable, Report, require, require_same, try_laws

#: ``reference(states (T, n), controls (T, lag, nu), values (K, d)) -> (T, K, lag, n)``
Reference = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Tolerance:
    """How near a simulator must come to its reference.

    Attributes:
        states: largest error of a transition's states, relative to 1 + their size, in nine of ten transitions;
            0 for equality to the bit.
        worst: the same in every transition; ``states`` by default.
        gradient: median relative error of a derivative.
        most: relative error below which nine of ten derivatives stay.
        floor: derivatives smaller than this share of the largest count as that large.
        step: half the distance of the central differences, relative to a parameter's value.
    """

    states: float = 0.0
    worst: float | None = None
    gradient: float = 1e-6
    most: float = 1e-3
    floor: float = 1e-6
    step: float = 1e-5


def check_simulator(
    simulator: Simulator,
    states: torch.Tensor,
    controls: torch.Tensor,
    values: torch.Tensor | None = None,
    *,
    variants: Sequence[Simulator] = (),
    reference: Reference | None = None,
    tolerance: Tolerance | None = None,
    diverging: torch.Tensor | None = None,
    idle: Sequence[str] = (),
) -> Report:
    """Check that a simulator keeps the laws that fits rely on; see :class:`~dropo_torch.simulators.Simulator`.

    Args:
        simulator: what is checked.
        states: initial states, ``(T, num_states)``, as varied as those of a log.
        controls: the controls of each transition, ``(T, lag, num_controls)``.
        values: parameter vectors in their units, ``(K, d)``; by default four from within the bounds.
        variants: the same simulator made in other ways: with other threads, chunks, or its parameters in another
            order. Each must give the same results, to the bit.
        reference: gives the true states, such as :func:`mujoco_reference`.
        tolerance: how near the reference is met; by default to the bit.
        diverging: parameter vectors under which every simulation diverges, ``(M, d)``.
        idle: parameters that do nothing on these transitions.

    Raises:
        ConformanceError: the first law that does not hold.
    """
    if values is None:
        space = simulator.parameters
        share = np.random.default_rng(5).uniform(0, 1, (4, len(space)))
        values = torch.from_numpy(space.low + share * (space.high - space.low))
    case = SimulatorCase(
        simulator, states, controls, values, tuple(variants), reference, tolerance or Tolerance(), diverging,
        frozenset(idle),
    )  # fmt: skip
    return try_laws(type(simulator).__name__, case, LAWS)


def mujoco_reference(space: ParameterSpace, frame_skip: int = 1) -> Reference:
    """Return C MuJoCo's own answer: ``mj_step`` from a reset, one simulation after the other.

    First-order filters start settled at their first control. Derivatives are better compared with those of
    ``mujoco_reference(converged(space))``.

    Args:
        space: what varies; a space over a MuJoCo model.
        frame_skip: physics steps of one transition.
    """

    def reference(states: torch.Tensor, controls: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        models = [space.apply(v) for v in values.numpy()]
        rows = zip(states.numpy(), controls.numpy(), strict=True)
        return torch.from_numpy(np.array([[stepped(m, s, u, frame_skip) for m in models] for s, u in rows]))

    return reference


def converged(space: ParameterSpace) -> ParameterSpace:
    """Return a space over a copy of its model whose constraint solver runs to convergence."""
    model = copy.copy(space.model)
    assert model is not None
    model.opt.solver, model.opt.jacobian = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-12
    model.opt.iterations, model.opt.ls_iterations = 200, 200
    return space.on(model)


def stepped(model: mujoco.MjModel, state: np.ndarray, controls: np.ndarray, frame_skip: int) -> np.ndarray:
    """Return C MuJoCo's states ``(lag, nq + nv)`` after each control; filters start settled.

    Controls are ``(lag, nu)``, with poses of mocap bodies behind them, see :class:`MujocoSimulator`.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
    filters = filters_of(model)
    data.act[filters.activations] = filters.settled(model, controls[0])
    states = []
    for control in controls:
        data.ctrl[:] = control[: model.nu]
        poses = control[model.nu :].reshape(-1, POSE)
        mocap = model.body_mocapid[prescribed_bodies(model)[: len(poses)]]
        data.mocap_pos[mocap], data.mocap_quat[mocap] = poses[:, :3], poses[:, 3:]
        for _ in range(frame_skip):
            mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


@dataclass(frozen=True)
class SimulatorCase:
    """A simulator and what it is checked on; see :func:`check_simulator`."""

    simulator: Simulator
    states: torch.Tensor
    controls: torch.Tensor
    values: torch.Tensor
    variants: tuple[Simulator, ...]
    reference: Reference | None
    tolerance: Tolerance
    diverging: torch.Tensor | None
    idle: frozenset[str]

    @cached_property
    def result(self) -> torch.Tensor:
        """What the simulator said first, ``(T, K, num_states)``."""
        return self.simulator.simulate(self.states, self.controls, self.values).detach().clone()

    @cached_property
    def truth(self) -> torch.Tensor:
        """What the reference says, ``(T, K, lag, num_states)``."""
        assert self.reference is not None
        return self.reference(self.states, self.controls, self.values)


def _it_says_what_it_is(case: SimulatorCase) -> None:
    simulator, space = case.simulator, case.simulator.parameters
    require(isinstance(space, ParameterSpace), f"parameters of type {type(space).__name__}", "a ParameterSpace")
    require(isinstance(simulator.name, str) and simulator.name, f"name {simulator.name!r}", "a name")
    for attribute in ("num_states", "num_controls", "frame_skip"):
        number = getattr(simulator, attribute)
        least = 0 if attribute == "num_controls" else 1
        is_count = isinstance(number, int) and number >= least
        require(is_count, f"{attribute} {number!r}", f"a whole number, {least} or more")
    step = simulator.timestep
    require(step is None or step > 0, f"timestep {step!r}", "seconds of one logged transition, or None")
    widths = (case.states.shape[-1], case.controls.shape[-1], case.values.shape[-1])
    own = (simulator.num_states, simulator.num_controls, len(space))
    require(widths == own, f"states, controls and parameters of widths {own}", f"{widths}, as in the arguments given")


def _results_have_their_shape_and_are_float64(case: SimulatorCase) -> None:
    (count, num), lag, width = (len(case.states), len(case.values)), case.controls.shape[1], case.states.shape[1]
    found = {
        "simulate": (case.result, (count, num, width), "(T, K, num_states)"),
        "rollout": (
            case.simulator.rollout(case.states, case.controls, case.values),
            (count, num, lag, width),
            "(T, K, lag, num_states)",
        ),
    }
    for name, (result, shape, words) in found.items():
        require(result.shape == shape, f"{name} of shape {tuple(result.shape)}", f"{words}, {shape}")
        require(result.dtype == torch.float64, f"{name} in {result.dtype}", "torch.float64")


def _empty_batches_give_empty_results(case: SimulatorCase) -> None:
    width = case.states.shape[1]
    for count, num in ((0, len(case.values)), (len(case.states), 0)):
        found = case.simulator.simulate(case.states[:count], case.controls[:count], case.values[:num])
        require(
            found.shape == (count, num, width),
            f"shape {tuple(found.shape)} for {count} transitions under {num} vectors",
            f"shape {(count, num, width)}",
        )


def _arguments_that_do_not_fit_are_refused(case: SimulatorCase) -> None:
    states, controls, values = case.states, case.controls, case.values
    for what, arguments in (
        ("states without their last column", (states[:, :-1], controls, values)),
        ("controls without their steps", (states, controls[:, 0], values)),
        ("a single parameter vector without its axis", (states, controls, values[0])),
        ("fewer states than controls", (states[:-1], controls, values)),
        ("controls of no step", (states, controls[:, :0], values)),
        ("a parameter too many", (states, controls, torch.cat([values, values[:, :1]], 1))),
    ):
        try:
            case.simulator.simulate(*arguments)
        except InputError:
            continue
        except Exception as error:
            raise Broken(f"{type(error).__name__} for {what}", "an InputError; see Simulator.check_arguments") from None
        raise Broken(f"a result for {what}", "an InputError; see Simulator.check_arguments")


def _arrays_are_taken_as_tensors_are(case: SimulatorCase) -> None:
    given = (case.states, case.controls, case.values)
    for what, convert in (("arrays", lambda x: x.numpy()), ("lists", lambda x: x.tolist())):
        try:
            found = case.simulator.simulate(*map(convert, given))
        except Exception as error:
            raise Broken(f"{type(error).__name__} for {what}", "a result; see Simulator.tensors") from None
        require_same(found.detach(), case.result, f"a result for {what}", "that for tensors")


def _the_same_arguments_give_the_same_result(case: SimulatorCase) -> None:
    simulator, states, controls, values = case.simulator, case.states, case.controls, case.values
    expected = case.result
    wild = values if case.diverging is None else case.diverging
    for arguments in (
        (states, controls, values),
        (states.flip(0), controls, values[:1]),
        (states[:1], controls[:1, :1], torch.cat([values] * 3)),
        (torch.full_like(states, torch.nan), controls, wild),
    ):
        simulator.rollout(*arguments)
        again = simulator.simulate(states, controls, values)
        require_same(again, expected, "a result after other simulations", "the first")


def _arguments_are_left_as_they_are(case: SimulatorCase) -> None:
    given = {"states": case.states, "controls": case.controls, "values": case.values}
    copies = {name: x.clone() for name, x in given.items()}
    case.simulator.rollout(**copies)
    case.simulator.simulate(**copies)
    for name, x in given.items():
        require_same(copies[name], x, f"{name} after the call", f"the {name} that were given")


def _a_result_belongs_to_the_caller(case: SimulatorCase) -> None:
    expected = case.result
    mine = case.simulator.simulate(case.states, case.controls, case.values)
    kept = mine.detach().clone()
    again = case.simulator.simulate(case.states.flip(0), case.controls.flip(0), case.values)
    require_same(mine, kept, "a result after the next call", "what it was before")
    for result in (mine, again):
        result.detach().fill_(1e3)
    found = case.simulator.simulate(case.states, case.controls, case.values)
    require_same(found, expected, "a result after an earlier one was overwritten", "the first")


def _order_and_size_of_the_batch_do_not_matter(case: SimulatorCase) -> None:
    states, controls, values = case.states, case.controls, case.values
    turned = case.simulator.simulate(states.flip(0), controls.flip(0), values.flip(0))
    require_same(turned.flip(0).flip(1), case.result, "a result in reverse order", "that in order")
    t, k = len(states) // 2, len(values) // 2
    alone = case.simulator.simulate(states[t : t + 1], controls[t : t + 1], values[k : k + 1])
    require_same(alone[0, 0], case.result[t, k], "a transition simulated alone", "the same within the batch")


def _threads_do_not_matter(case: SimulatorCase) -> None:
    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found = case.simulator.simulate(case.states, case.controls, case.values)
            require_same(found, case.result, f"a result on {threads} threads of torch", f"that on {before}")
    finally:
        torch.set_num_threads(before)


def _variants_give_the_same_result(case: SimulatorCase) -> None:
    if not case.variants:
        raise NotApplicable("no variants were given")
    names = case.simulator.parameters.names
    for i, other in enumerate(case.variants):
        own = other.parameters.names
        require(sorted(own) == sorted(names), f"parameters {own} of variant {i}", f"{names}, in any order")
        found = other.simulate(case.states, case.controls, case.values[:, [names.index(n) for n in own]])
        require_same(found, case.result, f"the result of variant {i}", "that of the simulator")


def _simulate_is_the_last_of_a_rollout(case: SimulatorCase) -> None:
    every = case.simulator.rollout(case.states, case.controls, case.values)
    require_same(every[:, :, -1], case.result, "the last of a rollout", "what simulate gives")
    first = case.simulator.simulate(case.states, case.controls[:, :1], case.values)
    require_same(first, every[:, :, 0], "one transition", "the first of a rollout")


def _what_diverges_is_nan_throughout_and_takes_no_other_with_it(case: SimulatorCase) -> None:
    simulator = case.simulator
    good = simulator.rollout(case.states, case.controls, case.values)
    states = case.states.clone()
    row = len(states) // 2
    states[row] = torch.nan
    values, spoilt = case.values, torch.zeros(len(case.values), dtype=torch.bool)
    if case.diverging is not None:
        values = torch.cat([values, case.diverging])
        spoilt = torch.cat([spoilt, torch.ones(len(case.diverging), dtype=torch.bool)])
    found = simulator.rollout(states, case.controls, values)
    rest = [t for t in range(len(states)) if t != row]
    require(bool(found[row].isnan().all()), "numbers after an initial state of NaN", "NaN throughout")
    require(
        bool(found[:, spoilt].isnan().all()),
        "numbers under a parameter vector that makes every simulation diverge",
        "NaN at every step, also before it diverged",
    )
    require_same(found[rest][:, ~spoilt], good[rest], "a simulation beside one that diverges", "that without it")
    lost = ~(found.detach().abs() < DIVERGED)
    require(
        bool((lost.flatten(2).all(-1) | ~lost.flatten(2).any(-1)).all()),
        "a simulation that is partly NaN, infinite or beyond 1e10",
        "NaN at every step and in every column of a simulation that diverges",
    )


def _values_beyond_the_bounds_are_simulated(case: SimulatorCase) -> None:
    space = case.simulator.parameters
    margin = 0.1 * (space.high - space.low)
    outside = np.clip(np.stack([space.low - margin, space.high + margin]), *space.limits.T)
    try:
        case.simulator.simulate(case.states[:1], case.controls[:1], torch.from_numpy(outside))
    except InputError as error:
        raise Broken(
            f"an InputError beyond the bounds: {error}",
            "a simulation: bounds are those of the search, samples lie within the physical limits",
        ) from None


def _every_parameter_acts(case: SimulatorCase) -> None:
    space, base = case.simulator.parameters, case.values[:1]
    size = 0.01 * np.where(base[0].numpy() == 0, 0.1 * (space.high - space.low), base[0].numpy())
    moved = np.clip(base.numpy() + np.diag(size), *space.limits.T)
    found = case.simulator.simulate(case.states, case.controls, torch.cat([base, torch.from_numpy(moved)])).detach()
    change = (found[:, 1:] - found[:, :1]).abs().nan_to_num().amax((0, 2))
    dead = [n for n, c in zip(space.names, change.tolist(), strict=True) if c == 0 and n not in case.idle]
    require(
        not dead, f"no effect of {', '.join(dead)} on any transition", "one; or transitions that excite it, or idle"
    )


def _states_are_those_of_the_reference(case: SimulatorCase) -> None:
    if case.reference is None:
        raise NotApplicable("no reference was given")
    found = case.simulator.rollout(case.states, case.controls, case.values).detach()
    if case.tolerance.states == 0:
        require_same(found, case.truth, "a rollout", "the reference")
        return
    scale = 1 + case.truth.abs()
    error = ((found - case.truth).abs() / scale).nan_to_num(nan=np.inf).flatten(2).amax((1, 2))
    worst = case.tolerance.states if case.tolerance.worst is None else case.tolerance.worst
    usual, largest = float(torch.quantile(error, 0.9)), float(error.max())
    require(
        usual <= case.tolerance.states and largest <= worst,
        f"relative errors of {usual:.2g} in nine of ten transitions and {largest:.2g} at worst",
        f"{case.tolerance.states:g} and {worst:g}",
    )


def _gradients_are_those_of_central_differences(case: SimulatorCase) -> None:
    simulator = case.simulator
    if not simulator.differentiable:
        require(simulator.remedy, "no remedy", "words on what to do where gradients are needed")
        try:
            simulator.simulate(case.states, case.controls, case.values.clone().requires_grad_(True))
        except InputError:
            pass
        else:
            raise Broken("a result without gradients where they are asked", "an InputError; see Simulator.tensors")
        raise NotApplicable("the simulator is not differentiable")
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=tuple(case.states.shape)))
    arguments = [case.states, case.controls, case.values[:1]]
    for position, name in enumerate(("states", "controls", "values")):
        exact = _backward(simulator, arguments, position, weights)
        if exact.shape[1]:
            labels = simulator.parameters.names if name == "values" else [str(i) for i in range(exact.shape[1])]
            _judge(name, labels, exact, _differences(case, arguments, position, weights), case)


def _backward(
    simulator: Simulator, arguments: list[torch.Tensor], position: int, weights: torch.Tensor
) -> torch.Tensor:
    """Each transition's gradient ``(T, p)`` of its weighted final state in one of the arguments."""
    rows = []
    for t in range(len(weights)):
        own = [x if i == 2 else x[t : t + 1] for i, x in enumerate(arguments)]
        own[position] = leaf = own[position].clone().requires_grad_(True)
        total = (simulator.simulate(*own)[:, 0] * weights[t]).sum()
        (gradient,) = torch.autograd.grad(total, leaf, allow_unused=True)
        rows.append((torch.zeros_like(leaf) if gradient is None else gradient).reshape(-1))
    return torch.stack(rows)


def _differences(
    case: SimulatorCase, arguments: list[torch.Tensor], position: int, weights: torch.Tensor
) -> torch.Tensor:
    """The same by central differences of the reference, or of the simulator itself."""
    rollout = case.reference or case.simulator.rollout
    given, step = arguments[position], case.tolerance.step
    width = given[0].numel()
    columns = []
    for j in range(width):
        size = step * (abs(float(given[0, j])) or 0.1) if position == 2 else step
        ends = []
        for sign in (1, -1):
            moved = given.flatten(1).clone()
            moved[:, j] += sign * size
            own = [moved.reshape(given.shape) if i == position else x for i, x in enumerate(arguments)]
            ends.append(rollout(*own)[:, 0, -1].detach())
        columns.append(((ends[0] - ends[1]) * weights).sum(-1) / (2 * size))
    return torch.stack(columns, 1)


def _judge(name: str, labels: Sequence[str], exact: torch.Tensor, true: torch.Tensor, case: SimulatorCase) -> None:
    """Compare derivatives ``(T, p)`` of one argument with the true ones."""
    tolerance = case.tolerance
    scale = true.abs() + tolerance.floor * (1 + true.abs().amax(0))
    error = ((exact - true).abs() / scale).nan_to_num(nan=np.inf)
    medians = torch.quantile(error, 0.5, dim=0)
    wrong = ", ".join(f"{n} {m:.2g}" for n, m in zip(labels, medians.tolist(), strict=True) if m > tolerance.gradient)
    median, most = float(torch.quantile(error, 0.5)), float(torch.quantile(error, 0.9))
    require(
        median <= tolerance.gradient and most <= tolerance.most,
        f"derivatives by {name} wrong by {median:.2g} at the median and {most:.2g} in one of ten ({wrong or 'all'})",
        f"relative errors of {tolerance.gradient:g} and {tolerance.most:g} at most",
    )
    if name == "values":
        # one column among many may be more sensitive to the differences' own step
        far = [n for n, m in zip(labels, medians.tolist(), strict=True) if m > 30 * tolerance.gradient]
        require(not far, f"derivatives by {', '.join(far)} wrong ({wrong})", f"{30 * tolerance.gradient:g} at most")
        dead = [n for n, t in zip(labels, true.abs().amax(0), strict=True) if float(t) == 0 and n not in case.idle]
        require(not dead, f"no derivative by {', '.join(dead)} in the reference", "one; or idle")


LAWS = (
    _it_says_what_it_is,
    _arguments_are_left_as_they_are,
    _results_have_their_shape_and_are_float64,
    _empty_batches_give_empty_results,
    _arguments_that_do_not_fit_are_refused,
    _the_same_arguments_give_the_same_result,
    _a_result_belongs_to_the_caller,
    _order_and_size_of_the_batch_do_not_matter,
    _threads_do_not_matter,
    _variants_give_the_same_result,
    _simulate_is_the_last_of_a_rollout,
    _what_diverges_is_nan_throughout_and_takes_no_other_with_it,
    _values_beyond_the_bounds_are_simulated,
    _every_parameter_acts,
    _states_are_those_of_the_reference,
    _gradients_are_those_of_central_differences,
    _arrays_are_taken_as_tensors_are,
)
