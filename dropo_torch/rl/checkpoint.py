"""Files of tensors: whole or absent, and read without running code in them. A training's state between iterations."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically
from dropo_torch.support.given import reading

SCHEMA = "dropo-torch/training/1"
#: A checkpoint may take this share of the time since the last.
SHARE = 0.05


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors, numbers and text in mappings and lists, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    write_atomically(path, buffer.getvalue())


def load_tensors(path: Path) -> dict[str, Any]:
    """Return what :func:`save_tensors` has written, on the CPU; no code in the file is run."""
    found: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    return found


class Checkpoints:
    """Writes a training's state now and then, whole or not at all.

    Args:
        path: the file, or ``None`` to keep nothing.
        fingerprint: identifies the training.
        seconds: least time between two; more where writing takes long.
    """

    def __init__(self, path: Path | None, fingerprint: str, seconds: float) -> None:
        self._path, self._fingerprint, self._seconds = path, fingerprint, seconds
        self._next = 0.0

    def due(self) -> bool:
        """Whether it is time for the next."""
        return self._path is not None and time.monotonic() >= self._next

    def save(self, state: Mapping[str, Any]) -> None:
        """Write a state: tensors, numbers and text in mappings and lists."""
        if self._path is None:
            return
        begun = time.monotonic()
        save_tensors(self._path, {"schema": SCHEMA, "fingerprint": self._fingerprint, "state": dict(state)})
        ended = time.monotonic()
        self._next = ended + max(self._seconds, (ended - begun) / SHARE)

    def load(self) -> dict[str, Any] | None:
        """Return the state that was kept last; ``None`` where there is none.

        Raises:
            InputError: a file that is no checkpoint, or that of another training.
        """
        if self._path is None or not self._path.is_file():
            return None
        with reading(f"resume: {self._path}", "the checkpoint of a training", "start again without --resume"):
            content = load_tensors(self._path)
            schema, owner, state = content["schema"], content["fingerprint"], content["state"]
        if schema != SCHEMA or owner != self._fingerprint:
            raise InputError(
                f"resume: {self._path} belongs to another task, config, distribution or algorithm; restore those, "
                "or start again without --resume"
            )
        return state
