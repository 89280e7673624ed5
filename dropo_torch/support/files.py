"""Files that are whole or absent, and JSON that every reader takes."""

from __future__ import annotations

import contextlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np


def write_atomically(path: Path, *parts: bytes) -> None:
    """Write a file of some parts whole or not at all, whatever interrupts it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as stream:
            stream.writelines(parts)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def write_json(path: Path, document: Any) -> None:
    """Write plain data as JSON, whole or not at all; numbers that are not finite become ``null``."""
    text = json.dumps(plain_numbers(document), indent=2, allow_nan=False)
    write_atomically(path, text.encode() + b"\n")


def plain_numbers(document: Any) -> Any:
    """Return plain data in which numbers that are not finite are ``None``, as JSON has none."""
    if isinstance(document, dict):
        return {k: plain_numbers(v) for k, v in document.items()}
    if isinstance(document, (list, tuple)):
        return [plain_numbers(v) for v in document]
    if isinstance(document, float) and not math.isfinite(document):
        return None
    return float(document) if isinstance(document, np.floating) else document
