"""Files of tensors, whole or absent and read without running code in them, and states that are kept in them."""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from dropo_torch.support.files import write_atomically


class Stateful:
    """Something whose state can be kept, and gone on from.

    Attributes:
        kept: names of the attributes that belong to the state: tensors on the CPU, numbers, and what holds them.
        parts: name → what has ``state_dict`` and ``load_state_dict`` of its own.
    """

    kept: tuple[str, ...]
    parts: dict[str, Any]

    def state_dict(self) -> dict[str, Any]:
        """Return everything that what follows depends on."""
        own = {name: copy.deepcopy(getattr(self, name)) for name in self.kept}
        return {"kept": own, **{name: part.state_dict() for name, part in self.parts.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that :meth:`state_dict` returned."""
        for name, part in self.parts.items():
            part.load_state_dict(state[name])
        for name, value in state["kept"].items():
            setattr(self, name, copy.deepcopy(value))


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors, numbers and text in mappings and lists, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    write_atomically(path, buffer.getvalue())


def load_tensors(path: Path) -> dict[str, Any]:
    """Return what :func:`save_tensors` has written, on the CPU; no code in the file is run."""
    return dict(torch.load(path, map_location="cpu", weights_only=True))
