"""Effects on commands and measurements, one after the other: in a search, a fit and a training alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
import torch

from dropo_torch.effects.base import Effect, Placed, Setting
from dropo_torch.effects.path import SensedPath

#: Share of a command's range within which two commands as they act are the same.
AGREE = 1e-3


@dataclass(frozen=True)
class Filter:
    """An effect on one command or one observed column, with the numbers of each row.

    Attributes:
        effect: the effect.
        column: of the commands, or of the observation.
        values: its numbers, ``(R, p)``, or ``(1, p)`` where all rows have the same.
    """

    effect: Effect
    column: int
    values: torch.Tensor


def filters_of(
    acting: Iterable[tuple[Effect, str | None, torch.Tensor]], method: Literal["command", "sense"], setting: Setting
) -> list[Filter]:
    """Return the effects, each at its target and with its values, that act by a method, in order.

    Those of a measured position act on the velocity that is derived from it, too, with the same values.
    """
    given = [(effect, target, values) for effect, target, values in acting if effect.has(method)]
    if method == "command":
        return [Filter(effect, setting.command_column(target), values) for effect, target, values in given]
    rates = differentiated(setting) if given else {}
    found = []
    for effect, target, values in given:
        column = setting.column(target)
        found.append(Filter(effect, column, values))
        if effect.differentiates and column in rates:
            found.append(Filter(effect, rates[column], values))
    return found


def placed_filters(placed: Iterable[Placed], method: Literal["command", "sense"], setting: Setting) -> list[Filter]:
    """Return the effects that act by a method, with the same numbers in all rows."""
    own = (p for p in placed if p.effect.has(method))  # most do not, and this is asked of every variant
    acting = ((p.effect, p.target, torch.tensor([p.values], dtype=torch.float64)) for p in own)
    return filters_of(acting, method, setting)


def filtered(signal: np.ndarray, filters: Iterable[Filter], step: float) -> np.ndarray:
    """Return commands ``(R, S, nu)`` of physics steps as they act, of filters that have settled at the first ones."""
    out = torch.from_numpy(signal.copy())
    for f in filters:
        given = out[..., f.column]
        out[..., f.column], _ = f.effect.command(given, f.values, step, f.effect.settled(given[:, :1], f.values, step))
    return out.numpy()


def settled_after(commands: np.ndarray, filters: Sequence[Filter], skip: int, step: float) -> np.ndarray:
    """Return the logged steps of each episode after which commands from before them no longer matter, ``(E,)``.

    Whatever the filters are: they run from several pasts, and what was before matters for as long as the commands as
    they act differ. All steps where they do so to the end.

    Args:
        commands: commands of the episodes' logged steps, ``(E, N, nu)``.
        filters: what the commands go through.
        skip: physics steps of a logged one.
        step: seconds of a physics step.
    """
    if not any(f.effect.memory(v) > 0 for f in filters for v in f.values.numpy()):
        return np.zeros(len(commands), dtype=int)
    low, high = np.minimum(commands.min((0, 1)), 0.0), np.maximum(commands.max((0, 1)), 0.0)
    signal = np.repeat(commands, skip, axis=1)
    pasts = [np.broadcast_to(past, commands[:, 0].shape)[:, None] for past in (low, high, commands[:, 0])]
    acting = np.stack([filtered(np.concatenate([past, signal], 1), filters, step)[:, 1:] for past in pasts])
    differ = (np.ptp(acting, axis=0) > AGREE * (high - low)).any(-1)
    last = np.where(differ.any(1), signal.shape[1] - np.argmax(differ[:, ::-1], axis=1), 0)
    return -(-last // skip)


def sensed(path: SensedPath, sensors: Iterable[Filter]) -> torch.Tensor:
    """Return what sensors show of paths, ``(R, T, n)``."""
    for f in sensors:
        shown = path.shown.clone()
        shown[..., f.column] = f.effect.sense(path, f.column, f.values)
        path = replace(path, shown=shown)
    return path.shown


def unsensed(shown: torch.Tensor, rates: torch.Tensor, sensors: Sequence[Filter]) -> torch.Tensor:
    """Return observed columns ``(R, n)`` of true states, of which the sensors show ``shown``.

    Args:
        shown: what the sensors show, ``(R, n)``.
        rates: time derivatives of the columns, ``(R, n)``.
        sensors: the effects on measurements.
    """
    out = shown.clone()
    for f in reversed(sensors):
        out[:, f.column] = f.effect.unsense(out, rates, f.column, f.values)
    return out


def extended(
    fine: torch.Tensor,
    rates: torch.Tensor,
    curvature: torch.Tensor | float,
    count: int,
    step: float,
    *,
    exact: bool = False,
) -> torch.Tensor:
    """Return fine paths with ``count`` physics steps before them, as if they had moved evenly so far.

    Args:
        fine: columns at every physics step, ``(R, F, n)``.
        rates: their time derivatives at the first, ``(R, n)``.
        curvature: the second derivatives, ``(R, 1, n)``.
        count: physics steps of the past.
        step: seconds of a physics step.
        exact: whether positions follow from velocities as under Runge-Kutta; otherwise as under Euler's steps.
    """
    if not count:
        return fine
    before = step * torch.arange(-count, 0, dtype=fine.dtype, device=fine.device)[:, None]
    past = fine[:, :1] + before * rates[:, None] + 0.5 * before * (before + (0.0 if exact else step)) * curvature
    return torch.cat([past, fine], 1)


def is_exact(model: mujoco.MjModel) -> bool:
    """Return whether a model's positions follow from its velocities better than by Euler's steps."""
    return int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)


def rate_columns(model: mujoco.MjModel) -> np.ndarray:
    """Return for every state column the one that is its time derivative, or -1, ``(nq + nv,)``."""
    found = np.full(model.nq + model.nv, -1)
    for j in range(model.njnt):
        position, velocity = int(model.jnt_qposadr[j]), model.nq + int(model.jnt_dofadr[j])
        width = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}.get(int(model.jnt_type[j]), 1)
        found[position : position + width] = velocity + np.arange(width)
    return found


def observed_rates(setting: Setting) -> tuple[int, ...]:
    """Return for every observed column the observed one that is its time derivative, or -1."""
    of, places = rate_columns(setting.model), {int(c): i for i, c in enumerate(setting.observation.index)}
    return tuple(places.get(int(of[c]), -1) for c in setting.observation.index)


def differentiated(setting: Setting) -> dict[int, int]:
    """Return the observed columns whose velocities the log has as derivatives, and those velocities' columns."""
    return {c: rate for c, rate in enumerate(observed_rates(setting)) if rate >= 0} if setting.differentiated else {}
