"""What a fit says, in plain words: findings, the verdict, and the sentence at the top of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, Literal

import numpy as np

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution, SearchBox, to_coordinates, to_values
from dropo_torch.fit import Fit
from dropo_torch.report.formatting import MOST_NAMED, joined, number, plain, rms, signed, whole, with_unit
from dropo_torch.verdict import THRESHOLDS, Judgment, at_floor, at_largest_std, judge, means_at_bounds
from dropo_torch.verdict import column_rms as column_rms
from dropo_torch.verdict import overall_rms as overall_rms
from dropo_torch.verdict import root_mean_square as root_mean_square
from dropo_torch.verdict import standardized_residual as standardized_residual
from dropo_torch.verdict import unexplained_above as unexplained_above

#: A mean whose standard error exceeds this share of the search box is poorly identified.
VAGUE = 0.25
#: Share of its mean from which a standard deviation is suspect.
WIDE = 0.5
Level = Literal["attention", "note"]


@dataclass(frozen=True)
class Finding:
    """Something that a reader should know before using a fit.

    Attributes:
        level: ``"attention"`` asks for a decision, ``"note"`` for awareness.
        title: what it is, in a few words.
        text: what it means and what to do.
    """

    level: Level
    title: str
    text: str


_OF_METHOD = "What the standard deviations are"
#: What a finding means and what to do, by its title; {} is what it is about.
_TEXTS = {
    "Velocities missing from the log": "{}: every simulated window starts with these joints at rest, but the robot "
    "was moving. Use data: preprocess to derive velocities from the positions, and list them in observation.",
    "Mean at its physical limit": "{}. The log shows no sign of this effect. Drop it, or log a motion that excites it.",
    **dict.fromkeys(
        ("Mean at its lower search bound", "Mean at its upper search bound"),
        "{}. The optimum may lie outside. Widen the bounds if that is physically plausible, "
        "or look for something else in the model that would cause the same motion.",
    ),
    "Standard deviation at its upper bound": "{}. The log calls for more variation than the largest σ allowed, a "
    "quarter of the search box. Usually the model lacks something (a delay, friction, an offset) and this parameter "
    "compensates for it. Do not read σ as the spread of the real quantity.",
    "Standard deviation as large as the mean": "{}. Such a spread is rarely real. It usually compensates for a model "
    "error: a mass whose inertia was not scaled along (scale_inertia), one value shared by joints that differ, a "
    "missing friction or delay, or sensor noise that was not declared.",
    "Standard deviation at its floor": "{}. A single fixed value explains the log as well as any distribution: "
    "this is a point estimate. To train a policy, you may want to widen it.",
    _OF_METHOD: "{}",
    "Several values explain the log": "{}. The normal distribution above also covers the values in between, which the "
    "log rules out: do not train on it. Narrow the bounds to one of the peaks, or log a motion that distinguishes "
    "them.",
    "Hardly narrower than the search box": "{}. Either the log barely constrains the parameter on its own, or the "
    "network has not learned it. If the posterior samples form a line, only a combination with another parameter is "
    "identified; if not, more simulations or a longer horizon may help.",
    "The model does not explain every column": "{}: measured next states are farther from the simulated ones than the "
    "fit expects (rms of standardized residuals; 1 is ideal). Either the model is missing or misrepresents something "
    "that acts on these columns, or their noise is larger than ε allows.",
    "Columns that barely count": "{}. Their residuals are far smaller than expected: the ε (or noise) given for them "
    "exceeds the simulation error, so the fit barely uses them. Set ε per column, or lower it.",
    "Columns without a finite residual": "{}.",
    "Parameters that are not identifiable separately": "{}. A change in one is compensated by a change in the other, "
    "so only their combination is identified. Fix one of them, or log a motion that separates them.",
    "Poorly identified means": "{}: the standard error of the mean is not small compared to the search box. Log a "
    "motion that excites the parameter, or drop it.",
    "Diverged simulations": "{} diverged under the fitted distribution. Narrow the bounds or limits of the parameters "
    "that destabilize the model, or shorten its time step.",
    "No finite likelihood": "{} did not produce a usable result.",
}
#: Findings that are good to know; the others ask for a decision.
_NOTES = ("Mean at its physical limit", "Standard deviation at its floor", "Columns that barely count")
#: What a method's standard deviations tell, and what to know about them; DROPO's need no more.
_MEANINGS = {
    "droid": "how far the search had contracted when it stopped, which says nothing about the log",
    "simopt": "how far the search had contracted when it stopped",
    "bayessim": "how uncertain the network is about a single fixed value",
    "laplace": "how uncertain a single fixed value is, not how much the parameter varies",
    "udr": "how wide a box drawn at random is",
}
_CAUTIONS = {
    "droid": "They shrink with every generation, whatever the noise. Use the means, and choose σ yourself.",
    "simopt": "They depend on the number of iterations and on the step bound. Use the means, and choose σ yourself.",
    "bayessim": "They come from simulations that resemble the log; see the posterior below.",
    "laplace": "A longer log makes them smaller; a missing effect does not make them larger.",
    "udr": "The log does not affect them.",
}


def findings(fit: Fit, diagnostics: Diagnostics) -> list[Finding]:
    """Return what needs attention first, then what is good to know."""
    distribution, lost = fit.distribution, max(fit.diverged, diagnostics.diverged)
    usable = np.isfinite(fit.log_likelihood) and np.isfinite(distribution.mean).all()
    vague = ~(diagnostics.standard_error < VAGUE * SearchBox.of(distribution).width)
    about: dict[str, Sequence[str]] = {
        "Velocities missing from the log": diagnostics.at_rest,
        **_at_bounds(distribution),
        **(_standard_deviations(distribution) if fit.method == "dropo" else _of_method(fit)),
        **({} if fit.method == "udr" else _residuals(diagnostics)),
        "Parameters that are not identifiable separately": [
            f"{a} and {b} ({signed(correlation)})" for a, b, correlation in strongest(diagnostics)
        ],
        "Poorly identified means": _chosen(distribution, vague),
        "Diverged simulations": [whole(lost, "simulation")] if lost else [],
        "No finite likelihood": [] if usable else ["The fit"],
    }
    is_alarming = fit.method in ("droid", "simopt") or fit.extras.get("extrapolates")
    notes = _NOTES if is_alarming else (*_NOTES, _OF_METHOD)
    found = [
        Finding("note" if title in notes else "attention", title, _TEXTS[title].format(joined(items)))
        for title, items in about.items()
        if items
    ]
    return sorted(found, key=lambda finding: finding.level != "attention")


def headline(fit: Fit, diagnostics: Diagnostics) -> str:
    """Return what was found, in one or two sentences."""
    distribution, error = fit.distribution, diagnostics.standard_error
    names = distribution.names
    many = f"{len(names)} parameters were" if len(names) > 1 else f"The parameter {names[0]} was"
    start = f"{many} fitted to the log, judged here on {whole(len(diagnostics.rows), 'transition')}."
    if len(names) > MOST_NAMED:
        return f"{start} The fitted values are in the table below."
    unsure = np.fmax(distribution.spread, np.where(np.isfinite(error), error, 0.0))
    columns = zip(names, distribution.center, distribution.spread, unsure, distribution.units, strict=True)
    values = [
        with_unit(f"{name} = {number(mean, u)} ± {number(std, std)}", unit).replace(" ", "\u00a0")
        for name, mean, std, u, unit in columns
    ]
    return f"{start} Mean ± standard deviation: {joined(values, len(values))}."


def judgment(fit: Fit, diagnostics: Diagnostics) -> Judgment:
    """Return the verdict of a fit: its own where it has one."""
    share = fit.diverged / (max(len(diagnostics.rows), 1) * fit.samples)
    return fit.judgment or judge(fit.distribution, fit.method, diagnostics, min(share, 1.0))


def has_standard_errors(fit: Fit) -> bool:
    """Whether the means maximize the likelihood, so that its curvature gives their standard errors."""
    return fit.method not in ("bayessim", "simopt", "udr")


def shape(distribution: Distribution) -> str:
    """Return what the distribution is."""
    if distribution.is_uniform:
        return "Each parameter is uniform over a random interval"
    together = "" if distribution.correlation is None else "; parameters are correlated (see fit.json)"
    return f"Each parameter follows a normal distribution truncated at ±2σ{together}"


def meaning_of_std(fit: Fit) -> str:
    """Return what the standard deviations say, by the method that found them."""
    meaning = _MEANINGS.get(fit.method, "how much the parameter must vary for the simulator to cover the log")
    return f"The standard deviation tells {meaning}"


def density_curve(distribution: Distribution, index: int, points: int = 121) -> tuple[np.ndarray, np.ndarray]:
    """Return values, in units, and density in coordinates, of one parameter over its support."""
    mean, std = float(distribution.mean[index]), float(distribution.std[index])
    if not (np.isfinite(mean) and np.isfinite(std) and std > 0):
        return np.zeros(0), np.zeros(0)
    x = np.linspace(distribution.ends[0][index], distribution.ends[1][index], points)
    density = np.ones_like(x) if distribution.is_uniform else np.exp(-0.5 * ((x - mean) / std) ** 2)
    x = np.concatenate([x[:1], x, x[-1:]])
    return to_values(x, distribution.is_log[index]), np.concatenate([[0], density, [0]])


def box_shares(distribution: Distribution, values: np.ndarray) -> np.ndarray:
    """Return where values, in units, lie between the ends of the search box, as shares in [0, 1]; NaN kept."""
    box = SearchBox.of(distribution)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip((to_coordinates(values, distribution.is_log) - box.low) / box.width, 0, 1)


def place(spec: Mapping[str, Any]) -> str:
    """Return where a parameter of a config sits in the model, such as ``body_mass of thigh``."""
    if not spec.get("field"):
        return ""
    names = spec.get("name") or []
    names = [names] if isinstance(names, str) else [str(n) for n in names]
    component = "" if spec.get("index") is None else f"[{spec['index']}]"
    flags = {"relative": "times the model's own", "scale_inertia": "inertia in proportion"}
    extras = [text for key, text in flags.items() if spec.get(key)]
    tail = f" ({', '.join(extras)})" if extras else ""
    return f"{spec['field']}{component}{f' of {joined(names)}' if names else ''}{tail}"


def strongest(diagnostics: Diagnostics) -> list[tuple[str, str, float]]:
    """Return the confounded pairs, the most correlated first."""
    return sorted(diagnostics.confounded, key=lambda pair: -np.nan_to_num(abs(pair[2])))


def _at_bounds(distribution: Distribution) -> dict[str, list[str]]:
    """Means at the ends of the search box, with the ends' values."""
    (lower, upper), at_limit = means_at_bounds(distribution), distribution.low <= distribution.limits[:, 0]
    return {
        "Mean at its physical limit": _with_values(distribution, lower & at_limit, distribution.low),
        "Mean at its lower search bound": _with_values(distribution, lower & ~at_limit, distribution.low),
        "Mean at its upper search bound": _with_values(distribution, upper, distribution.high),
    }


def _standard_deviations(distribution: Distribution) -> dict[str, list[str]]:
    """Standard deviations of DROPO that say more of the model or the log than of the parameter."""
    box, top = SearchBox.of(distribution), at_largest_std(distribution)
    wide = ~top & (distribution.spread >= WIDE * np.abs(distribution.center)) & (distribution.mean > box.low)
    return {
        "Standard deviation at its upper bound": _chosen(distribution, top),
        "Standard deviation as large as the mean": _chosen(distribution, wide),
        "Standard deviation at its floor": _chosen(distribution, at_floor(distribution)),
    }


def _of_method(fit: Fit) -> dict[str, list[str]]:
    """What to know about the standard deviations of a method other than DROPO."""
    guessed = fit.extras.get("extrapolates")
    caution = f"But the posterior is a guess: {fit.caveat}." if guessed else _CAUTIONS.get(fit.method, "")
    about = {_OF_METHOD: [f"{meaning_of_std(fit)}. {caution}"]}
    if fit.method == "bayessim":
        peaks, shares = _several_peaks(fit), fit.distribution.std / SearchBox.of(fit.distribution).width
        vague = [n for n in _chosen(fit.distribution, shares > 0.8 / math.sqrt(12)) if n not in peaks]
        about["Several values explain the log"] = [f"{name}: {joined(values)}" for name, values in peaks.items()]
        about["Hardly narrower than the search box"] = vague
    return about


def _several_peaks(fit: Fit) -> dict[str, list[str]]:
    """The parameters whose posterior has more than one peak, and where the peaks are."""
    mixture, distribution = Mixture.of(fit.extras["mixture"]), fit.distribution
    peaks = [to_values(mixture.peaks(i), is_log).tolist() for i, is_log in enumerate(distribution.is_log)]
    found = zip(distribution.names, peaks, strict=True)
    return {name: [number(v, 0.01 * abs(v)) for v in values] for name, values in found if len(values) > 1}


def _residuals(diagnostics: Diagnostics) -> dict[str, list[str]]:
    """Columns whose residuals are too large, too small or not there."""
    standardized, labels, limit = column_rms(diagnostics), diagnostics.labels, unexplained_above(diagnostics)
    order = np.argsort(-np.nan_to_num(standardized, nan=-1))
    drowned = [label for i, label in enumerate(labels) if _is_drowned(diagnostics, i)]
    return {
        "The model does not explain every column": [
            f"{labels[i]} ({rms(standardized[i])})" for i in order if standardized[i] > limit
        ],
        "Columns that barely count": [f"{len(drowned)} of {len(labels)} columns: {joined(drowned)}"] if drowned else [],
        "Columns without a finite residual": list(compress(labels, ~np.isfinite(standardized))),
    }


def _is_drowned(diagnostics: Diagnostics, column: int) -> bool:
    """Whether ε and the noise given for a column are far larger than what the simulator misses by."""
    residual, given = diagnostics.residual[:, column], diagnostics.given[:, column]
    finite = np.isfinite(residual) & np.isfinite(given)
    return bool(finite.any() and root_mean_square(residual[finite]) < THRESHOLDS.drowned * np.median(given[finite]))


def _chosen(distribution: Distribution, mask: np.ndarray) -> list[str]:
    return list(compress(distribution.names, mask))


def _with_values(distribution: Distribution, mask: np.ndarray, values: np.ndarray) -> list[str]:
    columns = compress(zip(distribution.names, values, distribution.units, strict=True), mask)
    return [f"{name} ({with_unit(plain(float(v)), unit)})" for name, v, unit in columns]
