"""What each method can be told: the keys of a config's ``method_options``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from dropo_torch.errors import InputError, choices

METHODS = ("dropo", "droid", "bayessim", "simopt", "udr", "laplace")


@dataclass(frozen=True)
class DroidSettings:
    """DROID.

    Attributes:
        budget: parameter vectors to simulate the log under, at most.
        population: vectors per generation; 0 for pycma's choice.
    """

    budget: int = 2000
    population: int = 0


@dataclass(frozen=True)
class SimOptSettings:
    """SimOpt, offline.

    Attributes:
        samples: parameter vectors an iteration.
        iterations: of relative-entropy policy search, at most.
        kl: bound on the relative entropy of a step, in nats.
        horizon: logged steps that are replayed open loop from a logged state.
        tolerance: deviation, as a share of the search width, below which it stops.
    """

    samples: int = 100
    iterations: int = 30
    kl: float = 0.5
    horizon: int = 50
    tolerance: float = 1e-4


@dataclass(frozen=True)
class BayesSimSettings:
    """BayesSim.

    Attributes:
        features: ``mdnn``, a neural network, or ``mdrff``, quasi-random Fourier features.
        simulations: parameter vectors drawn from the search box.
        components: Gaussians of the mixture.
        horizon: logged steps that are replayed open loop from a logged state, 2 or more.
        hidden: width of the two hidden layers of ``mdnn``, or number of frequencies of ``mdrff``.
        epochs: passes over the simulations, at most.
    """

    features: str = "mdnn"
    simulations: int = 1000
    components: int = 5
    horizon: int = 50
    hidden: int = 64
    epochs: int = 600


@dataclass(frozen=True)
class UdrSettings:
    """Uniform domain randomization.

    Attributes:
        boxes: random boxes to draw.
        box: which of them is the distribution, counted from 0; the others are listed in ``fit.json``.
    """

    boxes: int = 10
    box: int = 0


@dataclass(frozen=True)
class LaplaceSettings:
    """The Laplace posterior has nothing to set."""


@dataclass(frozen=True)
class DropoSettings:
    """DROPO's options are keys of the config itself."""


Settings = DroidSettings | SimOptSettings | BayesSimSettings | UdrSettings | LaplaceSettings | DropoSettings
_OF: dict[str, type[Settings]] = {
    "dropo": DropoSettings,
    "droid": DroidSettings,
    "bayessim": BayesSimSettings,
    "simopt": SimOptSettings,
    "udr": UdrSettings,
    "laplace": LaplaceSettings,
}
#: Smallest value of a setting where it is not 1.
_LEAST = {"samples": 4, "population": 2, "simulations": 20, "horizon": 1, "box": 0}
_FEATURES = ("mdnn", "mdrff")


def method_options(method: str) -> tuple[str, ...]:
    """Return the names of a method's own options."""
    return tuple(f.name for f in fields(_OF[method]))


def method_settings(method: str, given: Mapping[str, Any]) -> Settings:
    """Return the settings of a config's ``method_options``.

    Raises:
        InputError: an unknown method or key, or a value that is no number of the kind.
    """
    if method not in _OF:
        raise InputError(f"method: unknown {method!r}" + choices(method, METHODS))
    known = {f.name: f.default for f in fields(_OF[method])}
    for key, value in given.items():
        if key not in known:
            raise InputError(f"method_options: {method} has no {key!r}" + choices(key, known))
        _check(key, value, known[key])
    settings = _OF[method](**given)
    if isinstance(settings, UdrSettings) and settings.box >= settings.boxes:
        raise InputError(
            f"method_options.box: {settings.box} given; expected one of the {settings.boxes} boxes, from 0"
        )
    if isinstance(settings, BayesSimSettings) and settings.horizon < 2:
        raise InputError(f"method_options.horizon: {settings.horizon} given; bayessim needs 2 logged steps or more")
    return settings


def _check(key: str, value: Any, default: Any) -> None:
    """Raise an :class:`InputError` unless ``value`` is of the default's kind and large enough."""
    if isinstance(default, str):
        if value not in _FEATURES:
            raise InputError(f"method_options.{key}: {value!r} given" + choices(value, _FEATURES))
        return
    whole = isinstance(default, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        raise InputError(f"method_options.{key}: {value!r} given; expected a {'whole ' if whole else ''}number")
    if key == "population" and value == 0:
        return
    least = _LEAST.get(key, 1)
    if (whole and value < least) or (not whole and not 0 < value < float("inf")):
        raise InputError(
            f"method_options.{key}: {value!r} given; expected {f'{least} or more' if whole else 'more than 0'}"
        )
