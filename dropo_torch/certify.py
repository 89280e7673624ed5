"""A certificate of gradients: those of the differentiable backend against finite differences of MuJoCo itself."""

from __future__ import annotations

import copy
import math
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from dropo_torch.errors import InputError
from dropo_torch.objective import Objective
from dropo_torch.simulators.mujoco import MujocoSimulator
from dropo_torch.support.rows import evenly

SCHEMA = "dropo-torch/certificate/1"
#: Half the distance of the central differences, as a share of the search width.
STEP = 1e-5
#: A parameter's median error must stay below this, relative to its derivative.
LIMIT = 1e-4
#: A transition whose error is larger than this has its active set changed by the differences' own step.
DISAGREEMENT = 1e-2
#: The median must rest on at least this share of transitions that agree.
LEAST_AGREEING = 0.5


@dataclass(frozen=True)
class ParameterCertificate:
    """One parameter's gradient.

    Attributes:
        name: the parameter.
        magnitude: root mean square derivative of the compared columns, per unit of the parameter.
        median_error: median over transitions of the largest difference, relative to the derivative.
        worst_error: the same, 99th percentile.
        disagreeing: share of transitions in which the two differ by more than 1 %: contacts or limits that
            the step of the differences itself switches.
        verdict: ``"exact"``, ``"wrong"`` or ``"dead"`` (no derivative where MuJoCo has one, or none at all).
    """

    name: str
    magnitude: float
    median_error: float
    worst_error: float
    disagreeing: float
    verdict: str


@dataclass(frozen=True)
class Certificate:
    """The gradients of every parameter on one model and log.

    Attributes:
        parameters: one entry each.
        transitions: number of (transition, parameter vector) pairs that were compared.
        state_error: largest difference of the next states of the two simulators.
    """

    parameters: tuple[ParameterCertificate, ...]
    transitions: int
    state_error: float

    @property
    def failures(self) -> tuple[ParameterCertificate, ...]:
        """The entries whose verdict is not ``"exact"``."""
        return tuple(p for p in self.parameters if p.verdict != "exact")

    def document(self) -> dict[str, Any]:
        """Return the content of ``certificate.json``."""
        return {"schema": SCHEMA} | asdict(self)

    def check(self) -> None:
        """Raise an :class:`InputError` that names every parameter whose gradient cannot be used."""
        if self.failures:
            found = "; ".join(f"{p.name} is {p.verdict} (median error {p.median_error:.2g})" for p in self.failures)
            raise InputError(f"certificate: {found}; fit with optimizer: fisher or cma instead, and report the model")


@torch.inference_mode(mode=False)  # whether or not the caller has switched gradients off
@torch.enable_grad()
def certify(objective: Objective, *, max_transitions: int = 100, points: int = 2, seed: int = 0) -> Certificate:
    """Compare the simulator's derivatives of every parameter with central differences of MuJoCo.

    Args:
        objective: over a differentiable simulator of a MuJoCo model.
        max_transitions: transitions compared, spread over the log.
        points: parameter vectors, drawn uniformly from the middle half of the box.
        seed: seeds those.

    Raises:
        InputError: a simulator without gradients.
    """
    simulator = objective.simulator
    if not simulator.differentiable or not hasattr(simulator, "jacobian"):
        raise InputError(f"backend: {simulator.name} has no gradients to certify; {simulator.remedy}")
    spread = evenly(len(objective), max_transitions)
    part = objective.transitions.select(spread)
    states, controls = torch.from_numpy(part.states.copy()), torch.from_numpy(part.controls.copy())
    box, space = objective.box, simulator.parameters
    unit = np.random.default_rng((seed, 7)).uniform(0.25, 0.75, (points, len(space)))
    values = torch.from_numpy(box.values(box.low + unit * box.width))
    columns = torch.as_tensor(objective.observation.index)
    directions = torch.eye(simulator.num_states, dtype=torch.float64)[columns]
    after, exact, _ = simulator.jacobian(states, controls, values, directions)
    reference = _converged_reference(objective)
    difference = (after - reference.simulate(states, controls, values)).abs().nan_to_num().max()
    entries = []
    for i, step in enumerate(torch.from_numpy(np.diag(STEP * (space.high - space.low)))):
        plus, minus = (reference.simulate(states, controls, values + s)[..., columns] for s in (step, -step))
        slope = (plus - minus) / (2 * step[i])
        entries.append(_judge(space.names[i], exact[..., i].flatten(0, 1), slope.flatten(0, 1)))
    return Certificate(tuple(entries), len(states) * points, float(difference))


def has_reference(objective: Objective) -> bool:
    """Whether the objective's simulator has derivatives, and a MuJoCo model to compare them with."""
    simulator = objective.simulator
    return hasattr(simulator, "jacobian") and isinstance(simulator.parameters.model, mujoco.MjModel)


def _converged_reference(objective: Objective) -> MujocoSimulator:
    """MuJoCo with its solver run to convergence, so that differences see the physics and not its tolerance."""
    space = objective.simulator.parameters
    model = copy.copy(space.model)
    if not isinstance(model, mujoco.MjModel):
        raise InputError("certificate: this simulator has no MuJoCo model to compare with")
    model.opt.tolerance, model.opt.ls_tolerance = 1e-15, 1e-10
    model.opt.iterations, model.opt.ls_iterations = 200, 200
    return MujocoSimulator(model, parameters=space, frame_skip=objective.simulator.frame_skip)


def _judge(name: str, exact: torch.Tensor, differences: torch.Tensor) -> ParameterCertificate:
    """Compare derivatives ``(N, n)``, simulation by simulation."""
    kept = torch.isfinite(exact).all(-1) & torch.isfinite(differences).all(-1)
    exact, differences = exact[kept], differences[kept]
    size = differences.abs().amax(-1)
    typical = float(size.square().mean().sqrt()) if len(size) else 0.0
    if typical == 0.0 or float(exact.abs().max()) < 1e-9 * typical:
        return ParameterCertificate(name, typical, math.nan, math.nan, math.nan, "dead")
    acts = size > 1e-6 * typical
    error = (exact - differences).abs().amax(-1)[acts] / size[acts].clamp(min=1e-3 * typical)
    median = float(error.median())
    disagreeing = float((error > DISAGREEMENT).double().mean())
    verdict = "exact" if median <= LIMIT and disagreeing <= 1 - LEAST_AGREEING else "wrong"
    worst = float(torch.quantile(error, 0.99))
    return ParameterCertificate(name, typical, median, worst, disagreeing, verdict)
