"""The config of a run: its keys, their defaults, and reading one with overrides from the command line."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pydantic
from pydantic import Field

from dropo_torch.errors import InputError, choices
from dropo_torch.support.given import check_keys, read_text, user_path
from dropo_torch.support.yaml_text import load_yaml

if TYPE_CHECKING:
    from dropo_torch.optimizers.settings import FitSettings


#: An entry that is keys and values itself.
Entries = dict[str, Any]


#: What the config's keys are about, as the command line groups them.
GROUPS = ("model and log", "fit", "policy", "plan", "machine")


def _key(default: Any, description: str, about: str = "fit", **limits: Any) -> Any:
    """A key's default, what it is, which of :data:`GROUPS` it is of, and which numbers it takes."""
    return Field(default, description=description, json_schema_extra={"about": about}, **limits)


class Config(pydantic.BaseModel):
    """What a run is made of. Paths are relative to the config file."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    model: str | None = _key(None, "path of the MJCF, URDF or .mjb model", "model and log")
    sim: str | None = _key(None, "a bundled simulation instead of a model", "model and log")
    environment: str | None = _key(
        None,
        "with backend gymnasium: an environment id, or file.py:function (module:function) of an adapter",
        "model and log",
    )
    data: Any = _key(None, "path of the log, a list of paths, or path and reading options", "model and log")
    trajectories: int | Annotated[list[int], Field(min_length=1)] | None = _key(
        None, "how many of the log's episodes to use (the first ones), or which, counted from 0", "model and log"
    )
    leave_out: list[tuple[int, float, float]] = _key(
        [], "spans of these that are not used: [episode, begin, end], in seconds since it began", "model and log"
    )
    frame_skip: int | None = _key(None, "physics steps per logged transition", "model and log", ge=1, le=1_000_000)
    observation: list[str] | None = _key(
        None, "what the log's columns are, such as ['qpos[1:]', qvel]", "model and log"
    )
    parameters: dict[str, Entries] | None = _key(
        None, "name: field, name, index, bounds, unit, limits, scale, relative, scale_inertia", "model and log"
    )
    as_given: bool = _key(
        False, "gap first takes the model as given, and fits its parameters only if that has no answer", "model and log"
    )
    effects: list[Entries] = _key(
        [], "physical effects that the model lacks: effect, target and its numbers", "model and log"
    )
    own_effects: list[str] = _key(
        [], "file.py:Class (module:Class) of effects of one's own, which join the vocabulary", "model and log"
    )
    backend: Literal["mujoco", "warp", "gymnasium"] = _key("mujoco", "the simulator", "machine")
    method: Literal["dropo", "droid", "bayessim", "simopt", "udr", "laplace"] = _key(
        "dropo", "what finds the distribution"
    )
    method_options: Entries = _key({}, "options of a method other than dropo; see docs/methods.md")
    optimizer: Literal["fisher", "cma", "adam"] = _key("fisher", "how φ is searched")
    entropy: float = _key(0.0, "weight of the entropy of the distribution in the fit", ge=0, le=1e6)
    covariance: Literal["diagonal", "full"] = _key("diagonal", "whether parameters vary together")
    epsilon: float | list[float] = _key(1e-5, "ε, variance added to every column, or one each")
    noise: float | list[float] | None = _key(
        None,
        "standard deviation of the measurement, or one per column; initial states are then uncertain",
        "model and log",
    )
    samples: int = _key(100, "K, parameter vectors per transition", ge=2, le=1_000_000)
    lag: int = _key(1, "λ, logged steps per window", ge=1, le=1_000_000)
    seed: int = _key(0, "seed of everything that is random", "machine", ge=0, lt=2**63)
    mask: list[str | int] = _key([], "observed columns which the likelihood leaves out", "model and log")
    scaling: bool = _key(False, "divide each column by its standard deviation over the log")
    orientation: Literal["rotation_vector", "angle"] = _key(
        "rotation_vector", "how orientations are compared: as rotation vectors, or by the angle as in the paper"
    )
    budget: int = _key(1000, "with cma: evaluations of the objective", ge=1, le=10**9)
    population: int | None = _key(None, "with cma: φ per generation", ge=2, le=100_000)
    common_random_numbers: bool = _key(False, "with cma: the same samples in every generation")
    adam: Entries = _key({}, "with adam: steps, batch, samples, learning_rate, refresh, clip, common_random_numbers")
    device: str = _key("cpu", "with warp: cpu, or a GPU such as cuda:0", "machine")
    task: str | None = _key(
        None, "what a policy learns: a bundled task, or file.py:Class (module:Class); the sim's by default", "policy"
    )
    algorithm: Literal["ppo", "sac"] | None = _key(None, "how a policy is trained: ppo (the default) or sac", "policy")
    distribution: str | Entries | None = _key(
        None,
        "of the parameters in training: path of a fit.json, uniform, nominal, or name: value; "
        "fit.json beside the config by default, uniform where there is none",
        "policy",
    )
    train: Entries = _key({}, "how: steps, num_envs, hidden, learning_rate, gamma ...: docs/policies.md", "policy")
    target: Entries = _key(
        {}, "name: value, the model on which a trained policy is evaluated beside the nominal one", "policy"
    )
    plan: Entries = _key(
        {}, "limits of a planned motion: velocity, acceleration, position, force, workspace ...: docs/plan.md", "plan"
    )
    threads: int = _key(0, "threads of the simulator, 0 for all processors", "machine", ge=0, le=4096)
    workers: Annotated[int, Field(ge=1, le=4096)] | Literal["ray"] = _key(
        1, "processes that fit side by side in a sweep or comparison, or ray for those of a cluster", "machine"
    )
    chunk_size: int = _key(10_000, "simulations held in memory at once", "machine", ge=1, le=10**9)

    #: Folder that relative paths start from; not a key of the file.
    base: Path = Field(Path(), exclude=True)

    def path(self, given: str) -> Path:
        """Return a path of the config as one that can be opened."""
        return user_path(self.base, given)

    def fit_settings(self) -> FitSettings:
        """Return what a fit is told.

        Raises:
            InputError: settings that do not go together.
        """
        from dropo_torch.optimizers.settings import FitSettings, adam_settings  # imports torch

        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(FitSettings)}
        return FitSettings(**given | {"adam": adam_settings(self.adam)})

    @property
    def has_effects(self) -> bool:
        """Whether effects are named, or numbers of them are parameters."""
        return bool(self.effects) or any("effect" in p for p in (self.parameters or {}).values())

    @property
    def derives_velocities(self) -> bool:
        """Whether all velocities of the log are derived from its positions, by ``data: preprocess``."""
        options = self._preprocessing
        if options is None:
            return False
        measured = options.get("velocities")
        return measured is None or (len(measured) == 0 and bool(options.get("derive")))

    @property
    def keeps_noise(self) -> bool:
        """Whether positions stay as they were measured, and only velocities are derived through a filter."""
        return bool((self._preprocessing or {}).get("derive"))

    @property
    def _preprocessing(self) -> dict[str, Any] | None:
        """What ``data: preprocess`` says, ``None`` without one."""
        options = self.data.get("preprocess") if isinstance(self.data, dict) else None
        return options if isinstance(options, dict) else None

    @property
    def moves_centres(self) -> bool:
        """Whether bodies' centers of mass or their axes may move: by effects, or as parameters."""
        from dropo_torch.models.load import CENTERS  # imports MuJoCo

        fields = (str(p.get("field", "")) for p in (self.parameters or {}).values())
        return self.has_effects or any(field.startswith(CENTERS) for field in fields)

    def document(self) -> dict[str, Any]:
        """Return the config as plain data, as it would stand in a file."""
        return {k: v for k, v in self.model_dump(mode="json").items() if v is not None and v != [] and v != {}}

    def portable(self) -> dict[str, Any]:
        """Return the config as :meth:`document` does, with absolute paths: it means the same in any folder."""
        document = self.document()
        absolute: dict[str, Callable[[Any], Any]] = dict.fromkeys(("model", "data"), self._absolute)
        absolute |= dict.fromkeys(("environment", "task", "own_effects"), self._absolute_code)
        if self.distribution not in ("uniform", "nominal"):
            absolute["distribution"] = self._absolute
        return document | {key: make(document[key]) for key, make in absolute.items() if key in document}

    def _absolute_code(self, name: Any) -> Any:
        """``file.py:function``, or a list of such, with an absolute path; other names as they are."""
        if isinstance(name, list):
            return [self._absolute_code(entry) for entry in name]
        where, _, function = name.rpartition(":")
        return f"{self.path(where).resolve()}:{function}" if where.endswith(".py") else name

    def _absolute(self, source: Any) -> Any:
        if isinstance(source, list):
            return [self._absolute(entry) for entry in source]
        if isinstance(source, dict):
            return {k: self._absolute(v) if k == "path" else v for k, v in source.items()}
        if not isinstance(source, str) or source.startswith("minari:"):
            return source
        return str(self.path(source).resolve())

    def fingerprint(self, *ignored: str) -> str:
        """Return a digest of everything that decides a run's result; threads, workers and chunks do not."""
        left_out = {"threads", "workers", "chunk_size", *ignored}
        document = {k: v for k, v in self.document().items() if k not in left_out}
        return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:16]


KEYS = tuple(k for k in Config.model_fields if k != "base")
#: Keys that only training reads, and that only a plan does.
TRAINING_KEYS = ("task", "algorithm", "distribution", "train", "target")
PLANNING_KEYS = ("plan",)


def load_config(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Config:
    """Read a YAML config, with dotted overrides such as ``{"parameters.mass.bounds": [1, 2]}``.

    Raises:
        InputError: a missing or unreadable file, an unknown key, a value that does not fit.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"config: no file {path}; expected a YAML file with keys such as model, data and parameters")
    document = load_yaml(read_text(path, "config"), f"config: {path}")
    if not isinstance(document, Mapping):
        raise InputError(f"config: {path} holds no keys; expected model, data, parameters, ...")
    return make_config(document, overrides, base=path.parent, source=str(path))


def make_config(
    document: Mapping[str, Any],
    overrides: Mapping[str, Any] | None = None,
    *,
    base: Path = Path(),
    source: str = "config",
) -> Config:
    """Return the config of a mapping, with dotted overrides; errors are those of :func:`load_config`."""
    merged = _plain(dict(document), source)
    for dotted, value in (overrides or {}).items():
        _override(merged, dotted, _plain(value, f"--{dotted}"))
    check_keys(merged, KEYS, source)
    for key, value in merged.items():
        known = Config.model_fields[key]
        if isinstance(value, bool) and known.annotation is not bool:
            raise InputError(f"{source}: {key} is {str(value).lower()}; expected {known.description}")
    try:
        return Config(**merged, base=base)
    except pydantic.ValidationError as error:
        raise InputError(f"{source}: {explained(error, merged)}") from None


def _plain(document: Any, where: str) -> Any:
    """A copy as JSON knows it: text for what is neither number nor list nor mapping, no whole number without end."""
    try:
        text = json.dumps(document, default=str)
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 20 else float(digits))
    except (TypeError, ValueError, RecursionError):
        why = "an entry contains itself, or has a key that is no text"
        raise InputError(f"{where}: {why}; expected plain keys and values") from None


def explained(error: pydantic.ValidationError, document: Mapping[str, Any]) -> str:
    """Return which entry is wrong, what it is, and what it should be."""
    found = error.errors()
    deepest = max(len(e["loc"]) for e in found)  # of a union's alternatives, the one that fits furthest
    first = next(e for e in found if len(e["loc"]) == deepest)
    alternatives = [e for e in found if len(e["loc"]) == deepest and e["loc"][0] == first["loc"][0]]
    expected = list(dict.fromkeys(_expectation(e) for e in alternatives))
    place: Any = dict(document)
    key = []
    for part in first["loc"]:  # pydantic also names the alternative of a union, which is no entry
        if isinstance(place, dict | list) and part in (place if isinstance(place, dict) else range(len(place))):
            place = place[part]  # type: ignore[index]
            key.append(str(part))
    near = ""
    if first["type"] == "literal_error":
        near = choices(place, first["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", "))
    return f"{'.'.join(key)} is {place!r}; expected {' or '.join(expected)}{near}"


def _expectation(error: Any) -> str:
    """One of pydantic's messages, as what is expected."""
    for bound, words in {"ge": "{} or more", "le": "{} or less", "gt": "more than {:g}"}.items():
        if bound in error.get("ctx", ()):
            return words.format(error["ctx"][bound])
    text = error["msg"].removeprefix("Input should be ").replace("a valid ", "a ").split(",")[0]
    whole = dict.fromkeys(("a integer", "Unable to parse input string as an integer"), "a whole number")
    return (whole | {"a dictionary": "keys and values"}).get(text, text)


def parse_overrides(arguments: Sequence[str]) -> dict[str, Any]:
    """Read ``--key value`` and ``--key=value`` pairs; values are YAML.

    Raises:
        InputError: an argument that is no such pair, or an unknown key.
    """
    found: dict[str, Any] = {}
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        if not argument.startswith("--"):
            raise InputError(f"argument {argument!r} is not understood; expected --key value, such as --epsilon 1e-4")
        key, equals, value = argument[2:].partition("=")
        first, dot, rest = key.partition(".")
        key = first.replace("-", "_") + dot + rest
        if key.split(".")[0] not in KEYS:
            raise InputError(f"unknown option --{key}" + choices(key, KEYS))
        if not equals:
            if not waiting or waiting[0].startswith("--"):
                raise InputError(f"--{key}: no value given; expected --{key} VALUE")
            value = waiting.pop(0)
        found[key] = load_yaml(value, f"--{key}: {value!r}")
    return found


def _override(document: dict[str, Any], dotted: str, value: Any) -> None:
    """Set a nested entry in place."""
    *parents, last = dotted.split(".")
    place = document
    for depth, parent in enumerate(parents):
        if depth == 0 and parent in Config.model_fields and Config.model_fields[parent].default == {}:
            place.setdefault(parent, {})
        if parent not in place:
            raise InputError(f"--{dotted}: the config has no {parent!r} to change" + choices(parent, place))
        if not isinstance(place[parent], dict):
            raise InputError(f"--{dotted}: {parent} is {place[parent]!r}, which has no keys; expected --{parent} VALUE")
        place = place[parent]
    place[last] = value
