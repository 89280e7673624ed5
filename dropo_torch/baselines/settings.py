"""What each method can be told: the keys of a config's ``method_options``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic

from dropo_torch.config import explained
from dropo_torch.errors import InputError, choices
from dropo_torch.support.given import check_keys

Count = Annotated[int, pydantic.Field(ge=1)]
Positive = Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)]


class Settings(pydantic.BaseModel):
    """Nothing to set: what DROPO and the Laplace posterior read are keys of the config itself."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=True)


class DroidSettings(Settings):
    """DROID.

    Attributes:
        budget: parameter vectors to simulate the log under, at most.
        population: vectors per generation; 0 for pycma's choice.
    """

    budget: Count = 2000
    population: Literal[0] | Annotated[int, pydantic.Field(ge=2)] = 0


class SimOptSettings(Settings):
    """SimOpt, offline.

    Attributes:
        samples: parameter vectors an iteration.
        iterations: of relative-entropy policy search, at most.
        kl: bound on the relative entropy of a step, in nats.
        horizon: logged steps that are replayed open loop from a logged state.
        tolerance: standard deviation, as a share of the search width, below which it stops.
    """

    samples: Annotated[int, pydantic.Field(ge=4)] = 100
    iterations: Count = 30
    kl: Positive = 0.5
    horizon: Count = 50
    tolerance: Positive = 1e-4


class BayesSimSettings(Settings):
    """BayesSim.

    Attributes:
        features: ``mdnn``, a neural network, or ``mdrff``, quasi-random Fourier features.
        simulations: parameter vectors drawn from the search box.
        components: Gaussians of the mixture.
        horizon: logged steps that are replayed open loop from a logged state.
        hidden: width of the two hidden layers of ``mdnn``, or number of frequencies of ``mdrff``.
        epochs: passes over the simulations, at most.
    """

    features: Literal["mdnn", "mdrff"] = "mdnn"
    simulations: Annotated[int, pydantic.Field(ge=20)] = 1000
    components: Count = 5
    horizon: Annotated[int, pydantic.Field(ge=2)] = 50
    hidden: Count = 64
    epochs: Count = 600


class UdrSettings(Settings):
    """Uniform domain randomization.

    Attributes:
        boxes: random boxes to draw.
        box: which of them is the distribution, counted from 0; the others are listed in ``fit.json``.
    """

    boxes: Count = 10
    box: Annotated[int, pydantic.Field(ge=0)] = 0


_OF: dict[str, type[Settings]] = {
    "dropo": Settings,
    "droid": DroidSettings,
    "bayessim": BayesSimSettings,
    "simopt": SimOptSettings,
    "udr": UdrSettings,
    "laplace": Settings,
}
METHODS = tuple(_OF)


def method_options(method: str) -> tuple[str, ...]:
    """Return the names of a method's own options."""
    return tuple(_OF[method].model_fields)


def method_settings(method: str, given: Mapping[str, Any]) -> Settings:
    """Return the settings of a config's ``method_options``.

    Raises:
        InputError: an unknown method or key, or a value that does not fit.
    """
    if method not in _OF:
        raise InputError(f"method: unknown {method!r}" + choices(method, METHODS))
    check_keys(given, method_options(method), f"method_options of {method}")
    try:
        settings = _OF[method](**given)
    except pydantic.ValidationError as error:
        raise InputError(f"method_options.{explained(error, given)}") from None
    if isinstance(settings, UdrSettings) and settings.box >= settings.boxes:
        raise InputError(
            f"method_options.box: {settings.box} given; expected one of the {settings.boxes} boxes, from 0"
        )
    return settings
