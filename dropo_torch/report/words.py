"""What a fit says, in plain words: numbers, findings, and the sentence at the top of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np

from dropo_torch.baselines.mixture import Mixture
from dropo_torch.diagnostics import Diagnostics
from dropo_torch.distribution import Distribution, SearchBox, coordinate_limits, to_coordinates, to_values
from dropo_torch.fit import Fit
from dropo_torch.parameters import ParameterSpace
from dropo_torch.report.figures import plain

#: A mean nearer to its bound than this share of the box is at its bound.
AT_BOUND = 2e-3
#: A deviation this near to a bound of its own, as a factor, is at it.
AT_DEVIATION_BOUND = 1.02
#: Standardised residuals with a root mean square above this are not explained, small logs apart.
UNEXPLAINED = 1.5
#: ... and below this they are so small that ε or noise, not the parameters, makes up what is expected.
DROWNED = 0.3
#: A standard error above this share of the search box tells that the log says little.
VAGUE = 0.25
#: Lists in sentences name at most this many.
MOST_NAMED = 6

#: Share of its mean from which a deviation is suspect.
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


def findings(fit: Fit, diagnostics: Diagnostics) -> list[Finding]:
    """Return what needs attention first, then what is good to know."""
    found = [
        *_unobserved(diagnostics),
        *_at_bounds(fit.distribution),
        *(_deviations(fit.distribution) if fit.method == "dropo" else _of_method(fit)),
        *([] if fit.method == "udr" else _residuals(diagnostics)),
        *_confounded(diagnostics),
        *_vague(fit.distribution, diagnostics),
        *_failures(fit, diagnostics),
    ]
    return sorted(found, key=lambda finding: finding.level != "attention")


def _unobserved(diagnostics: Diagnostics) -> list[Finding]:
    if not diagnostics.at_rest:
        return []
    return [
        Finding(
            "attention",
            "Velocities that the log lacks",
            f"{joined(diagnostics.at_rest)}: every simulated window starts with them at rest, which the robot was not. "
            "Let data: preprocess derive velocities from the positions, and name them in observation.",
        )
    ]


def headline(fit: Fit, diagnostics: Diagnostics) -> str:
    """Return what was found, in one or two sentences."""
    distribution = fit.distribution
    count = len(diagnostics.rows)
    names = distribution.names
    many = f"{len(names)} parameters were" if len(names) > 1 else f"The parameter {names[0]} was"
    start = f"{many} fitted to the log, judged here on {whole(count, 'transition')}."
    if len(names) > MOST_NAMED:
        return f"{start} The fitted values are in the table below."
    pairs = _pairs(distribution, diagnostics.standard_error)
    values = [
        f"{name} = {value} ± {std}{f' {unit}' if unit else ''}".replace(" ", "\u00a0")
        for name, (value, std), unit in zip(names, pairs, distribution.units, strict=True)
    ]
    return f"{start} Mean ± standard deviation: {joined(values, len(values))}."


def verdict(fit: Fit, diagnostics: Diagnostics) -> tuple[bool, str]:
    """Return whether the model explains the log without reservation, and that in words."""
    standardised = column_rms(diagnostics)
    overall = overall_rms(diagnostics)
    if not np.isfinite(overall):
        return False, "Whether the simulator explains the log cannot be told: no residual is finite."
    worst = int(np.nanargmax(np.where(np.isfinite(standardised), standardised, -1)))
    at_worst = f"{diagnostics.labels[worst]} is worst, at {rms(standardised[worst])}"
    limit = unexplained_above(diagnostics)
    scale = f"Measured next states lie {rms(overall)} expected deviations from the simulated ones (rms; 1 is ideal)"
    if fit.method == "udr":
        return True, f"A box was drawn at random; the log had no part in it. {scale}; {at_worst}."
    if standardised[worst] > limit:
        bad = int(np.sum(standardised > limit))
        where = "" if len(standardised) == 1 else f" in {bad} of {len(standardised)} columns"
        return False, f"The simulator does not explain the log{where}. {scale}; {at_worst}."
    if fit.method == "dropo" and at_largest_deviation(fit.distribution).any():
        return False, (
            "The simulator explains the log only with parameters that vary as widely as they may (see below). "
            f"{scale}; {at_worst}."
        )
    if overall < DROWNED:
        return True, f"The simulator explains the log, with room to spare. {scale}; {at_worst}."
    return True, f"The simulator explains the log. {scale}; {at_worst}."


def column_rms(diagnostics: Diagnostics) -> np.ndarray:
    """Return the root mean square standardised residual of each column, over finite entries; NaN where none."""
    z = standardised_residual(diagnostics)
    finite = np.isfinite(z)
    total = np.sum(np.where(finite, z, 0.0) ** 2, axis=0)
    return np.sqrt(np.where(finite.any(0), total / np.maximum(finite.sum(0), 1), np.nan))


def overall_rms(diagnostics: Diagnostics) -> float:
    """Return the root mean square standardised residual over all columns; NaN where none is finite."""
    z = standardised_residual(diagnostics)
    z = z[np.isfinite(z)]
    return float(np.sqrt(np.mean(z**2))) if len(z) else float("nan")


def standardised_residual(diagnostics: Diagnostics) -> np.ndarray:
    """Return residual over expected deviation, ``(T, m)``."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.asarray(diagnostics.residual / diagnostics.expected)


def unexplained_above(diagnostics: Diagnostics) -> float:
    """Return the rms above which a column is not explained: wider for a short log, whose rms varies by chance."""
    return UNEXPLAINED + 3 / np.sqrt(2 * max(len(diagnostics.rows), 1))


def has_standard_errors(fit: Fit) -> bool:
    """Whether the means are where the likelihood is largest, so that its curvature tells their standard errors."""
    return fit.method not in ("bayessim", "simopt", "udr")


def search_box(distribution: Distribution) -> SearchBox:
    """Return the search box of a fitted distribution."""
    return SearchBox.of(cast(ParameterSpace, distribution))  # it has the same low, high and is_log


def at_largest_deviation(distribution: Distribution) -> np.ndarray:
    """Return which deviations lie at their upper bound, ``(d,)`` bool."""
    return np.asarray(distribution.std >= search_box(distribution).max_std / AT_DEVIATION_BOUND)


def law(fit: Fit) -> str:
    """Return what the distribution is, and what its standard deviation says, by the method that found it."""
    normal = "Each parameter follows a normal distribution cut off two standard deviations from its mean"
    if fit.distribution.correlation is not None:
        normal += ", and parameters vary together (correlation in fit.json)"
    meaning = {
        "droid": "how far the search had contracted when it stopped; it says nothing about the log",
        "simopt": "how far the search had contracted when it stopped",
        "bayessim": "how uncertain the network is about one fixed value",
        "laplace": "how uncertain the log leaves one fixed value; not how much the parameter varies",
        "udr": "the width of a box that was drawn at random",
    }.get(fit.method, "how much the parameter must vary for the simulator to cover the log")
    first = "Each parameter is uniform over a random interval" if fit.distribution.is_uniform else normal
    return f"{first}. The standard deviation says {meaning}"


def density_curve(distribution: Distribution, index: int, points: int = 121) -> tuple[np.ndarray, np.ndarray]:
    """Return values, in units, and density in coordinates, of one parameter over its support."""
    mean, std = float(distribution.mean[index]), float(distribution.std[index])
    if not (np.isfinite(mean) and np.isfinite(std) and std > 0):
        return np.zeros(0), np.zeros(0)
    z = np.linspace(*support(distribution, index), points)
    density = np.ones_like(z) if distribution.is_uniform else np.exp(-0.5 * z**2)
    x = mean + std * np.concatenate([z[:1], z, z[-1:]])
    return to_values(x, np.full(x.shape, distribution.is_log[index])), np.concatenate([[0], density, [0]])


def support(distribution: Distribution, index: int) -> tuple[float, float]:
    """Return the ends of one parameter's support, in deviations from its mean."""
    if distribution.is_uniform:
        return -math.sqrt(3), math.sqrt(3)
    low, high = (float(limit[index]) for limit in coordinate_limits(distribution.limits, distribution.is_log))
    mean, std = float(distribution.mean[index]), float(distribution.std[index])
    a, b = max(-2.0, (low - mean) / std), min(2.0, (high - mean) / std)
    return min(a, 2.0), max(b, a)


def box_shares(distribution: Distribution, values: np.ndarray) -> np.ndarray:
    """Return where values, in units, lie between the ends of the search box, as shares in [0, 1]; NaN kept."""
    box = search_box(distribution)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip((to_coordinates(values, distribution.is_log) - box.low) / box.width, 0, 1)


def number(value: float, uncertainty: float = float("nan")) -> str:
    """Return a number to two digits of its uncertainty, or to four digits where that is not known."""
    if np.isnan(value):
        return "n/a"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    digits = 4
    if np.isfinite(uncertainty) and uncertainty > 0 and value != 0:
        digits = int(np.clip(np.floor(np.log10(abs(value))) - np.floor(np.log10(uncertainty)) + 2, 2, 6))
    small_or_large = value != 0 and not 1e-4 <= abs(value) < 1e6
    text = f"{value:.{digits - 1}e}" if small_or_large else f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        text = f"{value:.{digits - 1}e}"
        mantissa, exponent = text.split("e")
        text = f"{mantissa}e{int(exponent)}"
    return "0" if value == 0 else text.replace("-", "−")


def rms(value: float) -> str:
    """Return a standardised root mean square, to what matters of it."""
    if not np.isfinite(value):
        return "n/a"
    return f"{value:.2f}" if 0.095 <= value < 10 else f"{value:.2g}" if value < 10 else number(round(value, 0), 1.0)


def signed(value: float, digits: int = 2) -> str:
    """Return a number with its sign, zero without one."""
    if not np.isfinite(value):
        return plain(value)
    text = f"{value:+.{digits}f}"
    return text[1:] if not text.strip("+-0.") else text.replace("-", "−")


def whole(count: int, thing: str) -> str:
    """Return a count with its noun."""
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


def joined(items: Sequence[str], most: int = MOST_NAMED) -> str:
    """Return a list in words, cut after ``most``."""
    if len(items) > most:
        return f"{', '.join(items[:most])} and {len(items) - most} more"
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


def place(spec: Any) -> str:
    """Return where a parameter of a config sits in the model, such as ``body_mass of thigh``."""
    if not isinstance(spec, Mapping) or not spec.get("field"):
        return ""
    names = spec.get("name") or []
    names = [names] if isinstance(names, str) else [str(n) for n in names]
    component = "" if spec.get("index") is None else f"[{spec['index']}]"
    extras = [
        text
        for key, text in (("relative", "times the model's own"), ("scale_inertia", "inertia in proportion"))
        if spec.get(key)
    ]
    tail = f" ({', '.join(extras)})" if extras else ""
    return f"{spec['field']}{component}{f' of {joined(names)}' if names else ''}{tail}"


def _pairs(distribution: Distribution, error: np.ndarray) -> list[tuple[str, str]]:
    """Mean, to digits that its deviation and standard error ``(d,)`` support, and deviation of each parameter."""
    center, spread = distribution.center, distribution.spread
    unsure = np.fmax(spread, np.where(np.isfinite(error), error, 0.0))
    return [(number(m, u), number(s, s)) for m, s, u in zip(center, spread, unsure, strict=True)]


def _at_bounds(distribution: Distribution) -> list[Finding]:
    box = search_box(distribution)
    share = (distribution.mean - box.low) / box.width
    found = []
    physical = distribution.low <= distribution.limits[:, 0]
    none = _with_values(distribution, (share < AT_BOUND) & physical, distribution.low)
    if none:
        found.append(
            Finding(
                "note",
                "Mean at its physical limit",
                f"{joined(none)}. The log shows no sign of this effect; leave it out, or log a motion that needs it.",
            )
        )
    for side, at, bound in (
        ("lower", (share < AT_BOUND) & ~physical, distribution.low),
        ("upper", share > 1 - AT_BOUND, distribution.high),
    ):
        names = _with_values(distribution, at, bound)
        if names:
            found.append(
                Finding(
                    "attention",
                    f"Mean at its {side} search bound",
                    f"{joined(names)}. The best value may lie outside: widen the bounds if the hardware allows it, "
                    "or look for what else in the model could cause the same motion.",
                )
            )
    return found


def _deviations(distribution: Distribution) -> list[Finding]:
    box = search_box(distribution)
    top = at_largest_deviation(distribution)
    floor = distribution.std <= box.min_std * AT_DEVIATION_BOUND
    found = []
    if top.any():
        found.append(
            Finding(
                "attention",
                "Standard deviation at its upper bound",
                f"{joined(_chosen(distribution, top))}. The log asks for more variation than a quarter of the search "
                "box. Usually the model lacks something (a delay, friction, an offset) and this parameter stands in "
                "for it; do not read the spread as that of the real quantity.",
            )
        )
    wide = ~top & (distribution.spread >= WIDE * np.abs(distribution.center)) & (distribution.mean > box.low)
    if wide.any():
        found.append(
            Finding(
                "attention",
                "Standard deviation as large as the mean",
                f"{joined(_chosen(distribution, wide))}. Such a spread rarely is the quantity's own: it usually stands "
                "in for something that is wrong in the model, such as a mass whose inertia did not follow "
                "(scale_inertia), one value tied over joints that differ, a missing friction or delay, or noise on "
                "the log that was not declared.",
            )
        )
    if floor.any():
        found.append(
            Finding(
                "note",
                "Standard deviation at its floor",
                f"{joined(_chosen(distribution, floor))}. One fixed value explains the log as well as any "
                "distribution: this is a point estimate. For training a policy you may want to add spread.",
            )
        )
    return found


def _of_method(fit: Fit) -> list[Finding]:
    """What to know about the deviations of a method other than DROPO."""
    box = search_box(fit.distribution)
    share = fit.distribution.std / box.width
    texts = {
        "droid": (
            "attention",
            "They shrink with every generation, noise or not. Take the means, and spread of your own.",
        ),
        "simopt": (
            "attention",
            "Other iterations or another bound on their steps give others. Take the means, and spread of your own.",
        ),
        "laplace": ("note", "The model lacking something does not widen them; a longer log narrows them."),
        "udr": ("note", "The log has no part in them."),
        "bayessim": ("note", "They rest on simulations that resemble the log; see the posterior below."),
    }
    if fit.extras.get("extrapolates"):
        texts["bayessim"] = ("attention", f"But the posterior is a guess: {fit.caveat}.")
    level, text = texts.get(fit.method, ("note", ""))
    found = [Finding(cast(Level, level), "What the standard deviations are", f"{law(fit).split('. ')[1]}. {text}")]
    if fit.method != "bayessim":
        return found
    several = _several_peaks(fit)
    if several:
        found.append(
            Finding(
                "attention",
                "Several values explain the log",
                f"{joined([f'{name}: {joined(values)}' for name, values in several.items()])}. The normal distribution "
                "above covers the values between them, too, which the log excludes: do not train on it. Narrow the "
                "bounds to one of them, or log a motion that tells them apart.",
            )
        )
    vague = [
        name
        for name, s in zip(fit.distribution.names, share, strict=True)
        if s > 0.8 / math.sqrt(12) and name not in several
    ]
    if vague:
        found.append(
            Finding(
                "attention",
                "Hardly narrower than the search box",
                f"{joined(vague)}. By itself the log tells next to nothing about it, or the network has not learned "
                "it: if the posterior's dots form a line, only a combination with another parameter is known; if not, "
                "more simulations, or a horizon over which the parameter shows, may help.",
            )
        )
    return found


def _several_peaks(fit: Fit) -> dict[str, list[str]]:
    """The parameters whose posterior has more than one peak, and where the peaks are."""
    mixture = Mixture.of(fit.extras["mixture"])
    found = {}
    for i, (name, is_log) in enumerate(zip(fit.distribution.names, fit.distribution.is_log, strict=True)):
        peaks = mixture.peaks(i)
        if len(peaks) > 1:
            found[name] = [
                number(float(v), 0.01 * abs(float(v))) for v in to_values(peaks, np.full(len(peaks), is_log))
            ]
    return found


def _residuals(diagnostics: Diagnostics) -> list[Finding]:
    standardised = column_rms(diagnostics)
    limit = unexplained_above(diagnostics)
    order = np.argsort(-np.nan_to_num(standardised, nan=-1))
    bad = [f"{diagnostics.labels[i]} ({rms(standardised[i])})" for i in order if standardised[i] > limit]
    drowned = [diagnostics.labels[i] for i in range(len(standardised)) if _is_drowned(diagnostics, i)]
    found = []
    if bad:
        found.append(
            Finding(
                "attention",
                "The model does not explain every column",
                f"{joined(bad)}: measured next states are further from the simulated ones than the fit expects "
                "(rms of standardised residuals, 1 is ideal). Something that acts on these columns is not among the "
                "parameters, or is wrong in the model; or their noise is larger than ε allows.",
            )
        )
    if drowned:
        found.append(
            Finding(
                "note",
                "Columns that hardly count",
                f"{len(drowned)} of {len(standardised)} columns: {joined(drowned)}. Their residuals are far smaller "
                "than expected: ε (or the noise) given for them is larger than what the simulator misses by, so the "
                "fit barely looks at them. Give ε per column, or lower it, to use them.",
            )
        )
    lost = [label for label, value in zip(diagnostics.labels, standardised, strict=True) if not np.isfinite(value)]
    if lost:
        found.append(Finding("attention", "Columns without a finite residual", f"{joined(lost)}."))
    return found


def _is_drowned(diagnostics: Diagnostics, column: int) -> bool:
    """Whether ε and the noise given for a column are far larger than what the simulator misses by."""
    residual, given = diagnostics.residual[:, column], diagnostics.given[:, column]
    finite = np.isfinite(residual) & np.isfinite(given)
    if not finite.any():
        return False
    return bool(np.sqrt(np.mean(residual[finite] ** 2)) < DROWNED * np.median(given[finite]))


def _confounded(diagnostics: Diagnostics) -> list[Finding]:
    if not diagnostics.confounded:
        return []
    pairs = [f"{a} and {b} ({signed(correlation)})" for a, b, correlation in strongest(diagnostics)]
    return [
        Finding(
            "attention",
            "Parameters that this log cannot tell apart",
            f"{joined(pairs)}. Changing one is made up for by changing the other; only their combination is "
            "known. Fix one of them, or log a motion in which they act differently.",
        )
    ]


def strongest(diagnostics: Diagnostics) -> list[tuple[str, str, float]]:
    """Return the confounded pairs, the most correlated first."""
    return sorted(diagnostics.confounded, key=lambda pair: -np.nan_to_num(abs(pair[2])))


def _vague(distribution: Distribution, diagnostics: Diagnostics) -> list[Finding]:
    error, width = diagnostics.standard_error, search_box(distribution).width
    vague = ~(error < VAGUE * width)
    if not vague.any():
        return []
    return [
        Finding(
            "attention",
            "The log says little about some means",
            f"{joined(_chosen(distribution, vague))}: the standard error of the mean is not small against the search "
            "box. Log a motion that excites it, or leave it out.",
        )
    ]


def _failures(fit: Fit, diagnostics: Diagnostics) -> list[Finding]:
    found = []
    lost = max(fit.diverged, diagnostics.diverged)
    if lost:
        found.append(
            Finding(
                "attention",
                "Diverged simulations",
                f"{whole(lost, 'simulation')} diverged under the fitted distribution. Narrow the bounds or limits of "
                "the parameters that make the model unstable, or shorten its time step.",
            )
        )
    if not (np.isfinite(fit.log_likelihood) and np.isfinite(fit.distribution.mean).all()):
        found.append(Finding("attention", "No finite likelihood", "The fit did not arrive at a usable result."))
    return found


def _chosen(distribution: Distribution, mask: np.ndarray) -> list[str]:
    return [name for name, chosen in zip(distribution.names, mask, strict=True) if chosen]


def _with_values(distribution: Distribution, mask: np.ndarray, values: np.ndarray) -> list[str]:
    return [
        f"{name} ({plain(float(value))}{f' {unit}' if unit else ''})"
        for name, value, unit, chosen in zip(distribution.names, values, distribution.units, mask, strict=True)
        if chosen
    ]
