"""Parameters and the windows' initial states, fitted together: Levenberg-Marquardt between looks at the residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.shooting.begin import first_states, rough_noise
from dropo_torch.shooting.components import components
from dropo_torch.shooting.equations import Normal, Point, Residuals, Scales, Slopes, residuals, slopes
from dropo_torch.shooting.windows import Windows

#: Looks at the residuals, at most, and steps between two.
LOOKS, STEPS = 30, 4
#: Link of a state with the end of the window before, at first, in sizes of moves.
LOOSE = 0.3
#: Share by which scales may still change, and by which parameters may still move, in widths, at the end.
SETTLED, AT_REST = 0.05, 1e-4
#: Damping at first.
DAMPING = 1e-2
#: The shortest step that is tried, in widths and sizes, and the smallest gain in ½ χ² after which another follows.
LEAST_MOVE, LEAST_GAIN = 1e-7, 0.01


@dataclass(frozen=True)
class Search:
    """Where a fit stands.

    Attributes:
        point: the best so far.
        first: states about which the episodes' first ones lie, ``(W, nq + nv)``.
        scales: by which residuals are weighed.
        damping: of the next step.
        looks: at the residuals, so far.
        stencils: derivatives taken so far.
        simulated_transitions: logged steps simulated so far.
        reason: why it has stopped, in words, or ``None``.
    """

    point: Point
    first: np.ndarray
    scales: Scales
    damping: float = DAMPING
    looks: int = 0
    stencils: int = 0
    simulated_transitions: int = 0
    reason: str | None = None


def begin(windows: Windows, seed: int) -> Search:
    """Find states that follow the log with the parameters in the middle of their box."""
    noise, _ = rough_noise(windows)
    mean = windows.box.middle
    states = first_states(windows, mean, noise, seed)
    link = np.full(len(windows.sizes), LOOSE)
    return Search(Point(mean, states), states, Scales(noise, link))


def improved(windows: Windows, search: Search, noise: np.ndarray | None) -> Search:
    """Take steps, then look at the residuals for the scales.

    Args:
        windows: the log.
        search: where it stands.
        noise: of each feature where it is known, ``(m,)``.
    """
    before = search.point.mean
    search, at, slope = _stepped(windows, search)
    normal = Normal.of(at, slope, search.scales)
    scales = components(at, slope, search.scales, normal, rough_noise(windows)[1], noise)
    moved = float(np.abs((search.point.mean - before) / windows.box.width).max())
    pairs = ((scales.noise, search.scales.noise), (scales.link, search.scales.link))
    change = max(float(np.abs(np.log(ours / theirs)).max()) for ours, theirs in pairs)
    reason = None
    if search.looks and change < SETTLED and moved < AT_REST:
        reason = "parameters, states and noise are at rest"
    elif search.looks + 1 >= LOOKS:
        reason = f"{LOOKS} looks at the residuals"
    return replace(search, scales=scales, looks=search.looks + 1, reason=reason)


def _stepped(windows: Windows, search: Search) -> tuple[Search, Residuals, Slopes]:
    """A few damped steps under the same scales, the residuals where they lead, and derivatives near there."""
    at, simulations = residuals(windows, search.point, search.first), 1
    for _ in range(STEPS):
        slope = slopes(windows, search.point, at)
        search, simulations = replace(search, stencils=search.stencils + 1), simulations + slope.simulations
        there, cost, tries = None, at.cost(search.scales), 0
        while there is None:
            point = Normal.of(at, slope, search.scales, search.damping).step(windows, search.point, search.damping)
            if _length(windows, search.point, point) < LEAST_MOVE:
                break
            tries, found = tries + 1, residuals(windows, point, search.first)
            there = found if found.cost(search.scales) < cost else None
            if there is None:
                search = replace(search, damping=max(6 * search.damping, 1e-3))
            else:
                search = replace(search, damping=max(search.damping / 8, 1e-9), point=point)
        simulations += tries
        if there is None:
            search = replace(search, damping=DAMPING)
            break
        at = there
        if cost[1] - at.cost(search.scales)[1] < LEAST_GAIN:
            break
    steps = simulations * len(windows) * windows.length
    return replace(search, simulated_transitions=search.simulated_transitions + steps), at, slope


def _length(windows: Windows, start: Point, end: Point) -> float:
    """The longest move from one point to another, in widths and sizes."""
    moves = np.abs(windows.between(end.states, start.states)).max()
    return float(max(moves, np.abs((end.mean - start.mean) / windows.box.width).max()))
