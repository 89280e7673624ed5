"""What chance alone does: p-values of one hypothesis over another, and whether two explain a log alike.

All are over blocks of the log. The misfit of a wrong model is no noise: over a window it nearly has one shape, of
another size and sign from window to window. So a block counts as one draw, whatever it holds, and its gain is only as
sure as its sign is, which the size of a gain says little about: true effects gain in every block, by sizes that differ
by decades.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

#: Independent shapes that the misfit of one stretch may have, at least.
SHAPES = 3


def p_of_ranks(gains: np.ndarray) -> float:
    """Return how likely gains of blocks ``(B,)`` are as large, by Wilcoxon's signed ranks, where either sign is.

    It is at least 2^−B: blocks that are few prove nothing, however much each gains.
    """
    gains = gains[gains != 0]
    return float(stats.wilcoxon(gains, alternative="greater").pvalue) if len(gains) else 1.0


def p_of_share(before: np.ndarray, after: np.ndarray, numbers: int) -> float:
    """Return how likely an effect that has nothing to do with a misfit removes as large a share of it.

    The squared correlation of a misfit of n independent sizes with p directions drawn at random is a beta variable with
    p/2 and (n − p)/2; n is the number of blocks, weighted by what each has of the misfit.

    Args:
        before, after: excess χ² of each block without and with the effect, ``(B,)``.
        numbers: p, those that the effect has.
    """
    sizes, whole = np.maximum(before, 0.0), float(before.sum())
    if whole <= 0:
        return 1.0
    count = float(sizes.sum() ** 2 / (sizes**2).sum())
    share = 1 - max(float(after.sum()), 0.0) / whole
    if count <= numbers or share <= 0:
        return 1.0
    return float(stats.beta.sf(share, 0.5 * numbers, 0.5 * (count - numbers)))


def p_of_stretch(before: np.ndarray, after: np.ndarray, noise: np.ndarray, numbers: int) -> float:
    """Return how likely an effect that has nothing to do with the worst block's misfit removes as large a share of it.

    What shows in one stretch only, such as a limit that is reached once, no test over blocks can see. Of misfits of
    :data:`SHAPES` independent shapes, p numbers drawn at random remove a share as in :func:`p_of_share`. That proves
    something only where all but a hundred-thousandth is gone, of a misfit that is as much larger than its noise.

    Args:
        before, after: excess χ² of each block without and with the effect, ``(B,)``.
        noise: standard deviation of each block's χ² by noise alone, ``(B,)``.
        numbers: p, those that the effect has.
    """
    worst = int(np.argmax(before))
    if numbers >= SHAPES or before[worst] <= 0:
        return 1.0
    left = max(float(after[worst]), 2 * float(noise[worst])) / float(before[worst])
    return float(stats.beta.cdf(min(left, 1.0), 0.5 * (SHAPES - numbers), 0.5 * numbers))


def p_of_gain(before: np.ndarray, after: np.ndarray, numbers: int) -> float:
    """Return how likely chance makes a hypothesis as much better, by either test; see :func:`p_of_share`."""
    return min(1.0, 2 * min(p_of_ranks(before - after), p_of_share(before, after, numbers)))


def p_of_ratio(gain: float, numbers: int) -> float:
    """Return how likely noise alone lets numbers that are not there lower χ² by as much (Wilks' theorem).

    Args:
        gain: by how much χ² is lower.
        numbers: how many are fitted more; one that is chosen among a few counts as fitted.
    """
    return float(stats.chi2.sf(max(gain, 0.0), max(numbers, 1)))


def p_of_scores(scores: np.ndarray) -> float:
    """Return how likely scores of independent blocks ``(B, p)`` have a mean as far from zero (Hotelling's test).

    It holds whatever noise makes within a block. Directions in which no block has a score do not count.

    Args:
        scores: derivatives of each block's χ² by the numbers that are not there.
    """
    size = np.sqrt((scores**2).sum(0))
    scores = scores[:, size > 0] / size[size > 0]
    blocks, numbers = scores.shape
    if not numbers or blocks <= numbers:
        return 1.0
    mean, covariance = scores.mean(0), np.cov(scores, rowvar=False).reshape(numbers, numbers)
    distance = blocks * float(mean @ np.linalg.pinv(covariance, rcond=1e-10, hermitian=True) @ mean)
    return float(stats.f.sf(distance * (blocks - numbers) / (numbers * (blocks - 1)), numbers, blocks - numbers))


def least_surplus(surplus: np.ndarray, error: float) -> float:
    """Return by how much a hypothesis is worse, of blocks ``(B,)`` together, at least: Student's lower limit.

    Args:
        surplus: by how much the χ² of each block is larger.
        error: how often the true surplus is below the limit.
    """
    count = len(surplus)
    if count < 2:
        return -np.inf
    spread = float(surplus.std(ddof=1)) * np.sqrt(count)
    return float(surplus.sum()) - float(stats.t.isf(error, count - 1)) * spread
