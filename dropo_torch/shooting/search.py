"""Parameters and the windows' initial states, fitted together: Levenberg-Marquardt between looks at the residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dropo_torch.diagnostics import estimates
from dropo_torch.shooting.begin import first_states, rough_noise
from dropo_torch.shooting.components import components
from dropo_torch.shooting.equations import Normal, Point, Residuals, Scales, Slopes, residuals, slopes
from dropo_torch.shooting.fusion import fused
from dropo_torch.shooting.windows import Windows

#: Looks at the residuals, at most, and steps between two.
LOOKS, STEPS = 30, 4
#: Link of a state with the end of the window before, at first, in sizes of moves.
LOOSE = 0.1
#: Share by which scales may still change, and standard errors by which parameters may still move, at the end.
SETTLED, AT_REST = 0.1, 0.05
#: States about a window's beginning that are tried at each look.
DRAWS = 6
#: How much more a second step is damped that is tried beside each.
SHORT = 30.0
#: Damping at first.
DAMPING = 1e-2
#: The shortest step that is tried, in widths and sizes, and the smallest gain in ½ χ² after which another follows.
LEAST_MOVE, LEAST_GAIN = 1e-7, 0.01


@dataclass(frozen=True)
class Search:
    """Where a fit stands.

    Attributes:
        point: the best so far.
        scales: by which residuals are weighed.
        damping: of the next step: each window's, and the parameters', ``(W + 1,)``.
        looks: at the residuals, so far.
        is_free: whether noise may be larger than the columns' second differences: not before parameters have come to
            rest, since states that are still wrong are no noise.
        stencils: derivatives taken so far.
        simulated_transitions: logged steps simulated so far.
        reason: why it has stopped, in words, or ``None``.
    """

    point: Point
    scales: Scales
    damping: np.ndarray
    looks: int = 0
    is_free: bool = False
    stencils: int = 0
    simulated_transitions: int = 0
    reason: str | None = None


def begin(windows: Windows, seed: int) -> Search:
    """Find states that follow the log with the parameters in the middle of their box."""
    noise, _ = rough_noise(windows)
    mean = windows.box.middle
    states = first_states(windows, mean, noise, seed)
    link = np.full(len(windows.sizes), LOOSE)
    return Search(Point(mean, states), Scales(noise, link), np.full(len(windows) + 1, DAMPING))


def improved(windows: Windows, search: Search, noise: np.ndarray | None) -> Search:
    """Take steps, then look at the residuals for the scales.

    Args:
        windows: the log.
        search: where it stands.
        noise: of each feature where it is known, ``(m,)``; of those with 0 it is estimated.
    """
    before = search.point.mean
    search, at, slope = _stepped(windows, search)
    normal = Normal.of(at, slope, search.scales)
    rough, spread = rough_noise(windows)
    scales = components(at, slope, search.scales, normal, spread, noise)
    if not search.is_free:
        most = rough if noise is None else np.maximum(rough, noise)
        scales = replace(scales, noise=np.minimum(scales.noise, most))
    error = estimates(normal.schur + np.eye(len(before)))[0] * windows.box.width
    moved = float(np.abs((search.point.mean - before) / error).max())
    pairs = ((scales.noise, search.scales.noise), (scales.link, search.scales.link))
    change = max(float(np.abs(np.log(ours / theirs)).max()) for ours, theirs in pairs)
    rests, reason = search.looks > 0 and change < SETTLED and moved < AT_REST, None
    if rests and search.is_free:
        reason = "parameters, states and noise are at rest"
    elif search.looks + 1 >= LOOKS:
        reason = f"{LOOKS} looks at the residuals"
    return replace(search, scales=scales, looks=search.looks + 1, reason=reason, is_free=search.is_free or rests)


def _stepped(windows: Windows, search: Search) -> tuple[Search, Residuals, Slopes]:
    """A few damped steps under the same scales, the residuals where they lead, and derivatives near there."""
    scales, tried = search.scales, _others(windows, search)
    point, at, _ = fused(windows, search.point.mean, (search.point.states, *tried), scales)
    damping = np.append(np.minimum(search.damping[:-1], DAMPING), search.damping[-1])
    search, simulations = replace(search, point=point, damping=damping), 2 + len(tried)
    for _ in range(STEPS):
        slope, cost, is_better = slopes(windows, search.point, at), at.cost(scales), False
        search, simulations = replace(search, stencils=search.stencils + 1), simulations + slope.simulations
        while not is_better:
            of_windows, of_parameters = search.damping[:-1], float(search.damping[-1])
            step = Normal.of(at, slope, scales, of_windows).step(windows, search.point, of_parameters)
            if _length(windows, search.point, step) < LEAST_MOVE:
                break
            short = Normal.of(at, slope, scales, SHORT * of_windows + SHORT * DAMPING)
            short_step = short.step(windows, search.point, of_parameters)
            options = (search.point.states, step.states, short_step.states)
            point, found, choice = fused(windows, step.mean, options, scales)
            simulations += len(options)
            is_better = found.cost(scales) < cost
            factors = np.append(np.array([6.0 * SHORT, 1 / 8, 6.0])[choice], 1 / 8 if is_better else 6.0)
            search = replace(search, damping=np.clip(search.damping * factors, 1e-9, 1e9))
            if is_better:
                search, at = replace(search, point=point), found
        if not is_better:
            search = replace(search, damping=np.full_like(search.damping, DAMPING))
            break
        if cost[1] - at.cost(scales)[1] < LEAST_GAIN:
            break
    steps = simulations * len(windows) * windows.length
    return replace(search, simulated_transitions=search.simulated_transitions + steps), at, slope


def _others(windows: Windows, search: Search) -> list[np.ndarray]:
    """Other states that windows may take: where those before end, and about there as links allow.

    From a state that misses a contact, or makes one too many, no derivative leads to the right one.
    """
    ends = np.roll(residuals(windows, search.point).ends, 1, axis=0)
    about = np.where(windows.follows[:, None], ends, search.point.states)
    draws = np.random.default_rng(search.looks).standard_normal((DRAWS, len(windows), len(windows.sizes)))
    return [about, *(windows.moved(about, search.scales.link * draw) for draw in draws)]


def _length(windows: Windows, start: Point, end: Point) -> float:
    """The longest move from one point to another, in widths and sizes."""
    moves = np.abs(windows.between(end.states, start.states)).max()
    return float(max(moves, np.abs((end.mean - start.mean) / windows.box.width).max()))
