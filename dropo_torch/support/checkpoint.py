"""Checkpoints: plain values and arrays under a checksum, in a file that runs no code when it is read.

A file is three parts: the line ``dropo-torch/checkpoint/1 SHA256`` with the checksum of all that follows, a line of
JSON, and the bytes of the arrays, one after another. The JSON holds ``kind`` (whose state it is), ``owner`` (of which
run), ``arrays`` (type, shape and order of axes of each) and ``content``, in which an object with the key ``$`` stands
for what JSON has no word for: an array, a tensor, a tuple, a mapping with other keys than text, a dataclass.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically

FORMAT = b"dropo-torch/checkpoint/1 "
_MARK = "$"
_DTYPES = ("bool", "uint8", "int32", "int64", "uint64", "float32", "float64")


@dataclass(frozen=True)
class Checkpoint:
    """The file of a run's state.

    Attributes:
        path: the file.
        kind: whose state it is, for messages: fit, gap, plan or training.
        owner: identifies the run: one of another is refused.
        roots: the dataclasses in the state; those in their fields are known by these.
        named: classes of which an object is kept by its ``name``, each with what finds it again.
    """

    path: Path
    kind: str
    owner: tuple[str, ...]
    roots: tuple[type, ...] = ()
    named: Mapping[type, Callable[[str], Any]] = field(default_factory=dict)

    def save(self, content: Any) -> None:
        """Write the state, whole or not at all.

        Raises:
            TypeError: something in it that is no plain value, array, tensor or known dataclass.
        """
        write_atomically(self.path, *dumps(self.kind, self.owner, content, self.roots, self.named))

    def load(self) -> Any:
        """Return what :meth:`save` has written, equal to the last bit; no code in the file is run.

        Raises:
            InputError: a file that is damaged or no checkpoint of this kind, or that of another run.
        """
        try:
            head, arrays = _opened(self.path.read_bytes())
            if head["kind"] != self.kind:
                raise ValueError(f"it is that of a {head['kind']}")
            is_own = tuple(head["owner"]) == self.owner
            content = _content(head, arrays, self.roots, self.named) if is_own else None
        except (ValueError, TypeError, LookupError, OverflowError, RecursionError, MemoryError) as error:
            what = f"{self.path} is no checkpoint of a {self.kind} ({error})"
            raise InputError(f"resume: {what}; start again without --resume") from None
        if not is_own:
            what = f"{self.path} belongs to another config, model, log or method"
            raise InputError(f"resume: {what}; restore those, or start again without --resume")
        return content


def dumps(
    kind: str, owner: tuple[str, ...], content: Any, roots: Iterable[type] = (),
    named: Mapping[type, Callable[[str], Any]] | None = None,
) -> tuple[bytes, ...]:  # fmt: skip
    """Return the parts of a file, in their order; see :class:`Checkpoint`."""
    writer = _Writer(tuple(_dataclasses(roots)), tuple(named or ()))
    plain = writer.plain(content)
    head = {"kind": kind, "owner": list(owner), "arrays": writer.kinds, "content": plain}
    line = json.dumps(head, separators=(",", ":")).encode() + b"\n"
    digest = hashlib.sha256(line)
    for part in writer.parts:
        digest.update(part)
    return (FORMAT + digest.hexdigest().encode() + b"\n", line, *writer.parts)


def loads(
    data: bytes, roots: Iterable[type] = (), named: Mapping[type, Callable[[str], Any]] | None = None
) -> tuple[str, tuple[str, ...], Any]:
    """Return kind, owner and content of a file.

    Raises:
        ValueError, TypeError, LookupError: a file that :func:`dumps` has not written like this.
    """
    head, arrays = _opened(data)
    return head["kind"], tuple(head["owner"]), _content(head, arrays, roots, named or {})


def _opened(data: bytes) -> tuple[dict[str, Any], memoryview]:
    """The JSON of a file whose checksum is right, and the bytes of its arrays."""
    first = len(FORMAT) + 64 + 1
    if not data.startswith(FORMAT):
        raise ValueError("it does not begin as one")
    if data[len(FORMAT) : first] != hashlib.sha256(data[first:]).hexdigest().encode() + b"\n":
        raise ValueError("it is damaged: its checksum differs")
    end = data.index(b"\n", first)
    return json.loads(data[first:end]), memoryview(data)[end + 1 :]


def _content(
    head: dict[str, Any], arrays: memoryview, roots: Iterable[type], named: Mapping[type, Callable[[str], Any]]
) -> Any:
    """The state that JSON and arrays stand for."""
    reader = _Reader({c.__name__: c for c in _dataclasses(roots)}, {c.__name__: f for c, f in named.items()})
    reader.take(head["arrays"], arrays)
    return reader.value(head["content"])


class _Writer:
    """Makes JSON of a state and gathers its arrays."""

    def __init__(self, known: tuple[type, ...], named: tuple[Any, ...]) -> None:
        self._known, self._named = known, named
        self.kinds: list[list[Any]] = []
        self.parts: list[bytes] = []

    def plain(self, value: Any) -> Any:
        """Return a value as JSON knows it."""
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, list):
            return [self.plain(v) for v in value]
        if isinstance(value, tuple):
            return {_MARK: "tuple", "of": [self.plain(v) for v in value]}
        if isinstance(value, dict):
            if all(isinstance(k, str) for k in value) and _MARK not in value:
                return {k: self.plain(v) for k, v in value.items()}
            return {_MARK: "mapping", "of": [[self.plain(k), self.plain(v)] for k, v in value.items()]}
        if isinstance(value, np.ndarray | np.generic):
            return {_MARK: "array" if isinstance(value, np.ndarray) else "number", "of": self._keep(np.asarray(value))}
        if _is_tensor(value):
            return {_MARK: "tensor", "of": self._keep(value.detach().cpu().numpy())}
        if isinstance(value, self._named):
            return {_MARK: next(c.__name__ for c in self._named if isinstance(value, c)), "name": value.name}
        if type(value) in self._known:
            of = {f.name: self.plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
            return {_MARK: type(value).__name__, "of": of}
        raise TypeError(f"a checkpoint holds no {type(value).__module__}.{type(value).__qualname__}")

    def _keep(self, array: np.ndarray) -> int:
        """Keep the bytes of an array in the order in which its memory runs; return its number."""
        if array.dtype.name not in _DTYPES:
            raise TypeError(f"a checkpoint holds no arrays of {array.dtype}")
        axes = sorted(range(array.ndim), key=lambda axis: -abs(array.strides[axis]))
        self.kinds.append([array.dtype.name, list(array.shape), axes])
        self.parts.append(array.transpose(axes).astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
        return len(self.parts) - 1


class _Reader:
    """Makes a state of JSON and arrays."""

    def __init__(self, known: Mapping[str, type], named: Mapping[str, Callable[[str], Any]]) -> None:
        self._known, self._named = known, named
        self._arrays: list[np.ndarray] = []

    def take(self, kinds: Iterable[Any], data: memoryview) -> None:
        """Cut the bytes into arrays."""
        begin = 0
        for name, shape, axes in kinds:
            if name not in _DTYPES:
                raise ValueError(f"an array of {name}")
            dtype = np.dtype(name).newbyteorder("<")
            end = begin + dtype.itemsize * math.prod(shape)
            flat = np.frombuffer(data[begin:end], dtype).astype(name)  # a copy, as arrays of a state are written to
            self._arrays.append(flat.reshape([shape[axis] for axis in axes]).transpose(np.argsort(axes).astype(int)))
            begin = end
        if begin != len(data):
            raise ValueError("its arrays end elsewhere")

    def value(self, plain: Any) -> Any:
        """Return the value that JSON stands for."""
        if isinstance(plain, list):
            return [self.value(v) for v in plain]
        if not isinstance(plain, dict):
            return plain
        kind = plain.get(_MARK)
        if kind is None:
            return {k: self.value(v) for k, v in plain.items()}
        if kind in self._named:
            return self._named[kind](plain["name"])
        of = plain["of"]
        if kind == "tuple":
            return tuple(self.value(v) for v in of)
        if kind == "mapping":
            return {self.value(k): self.value(v) for k, v in of}
        if kind in ("array", "number", "tensor"):
            array = self._arrays[of]
            return array if kind == "array" else array[()] if kind == "number" else _tensor(array)
        if kind not in self._known:
            raise ValueError(f"a {kind} in it")
        return self._known[kind](**{k: self.value(v) for k, v in of.items()})


def _dataclasses(roots: Iterable[type]) -> Iterator[type]:
    """The dataclasses among these classes and in the types of their fields."""
    waiting, seen = list(roots), set[Any]()
    while waiting:
        found = waiting.pop()
        if found in seen:
            continue
        seen.add(found)
        if isinstance(found, type) and dataclasses.is_dataclass(found):
            yield found
            hints = typing.get_type_hints(found)
            waiting += [hints[f.name] for f in dataclasses.fields(found)]
        waiting += typing.get_args(found)


def _is_tensor(value: Any) -> bool:
    """Whether this is a tensor of torch; without torch there is none."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _tensor(array: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(array)
