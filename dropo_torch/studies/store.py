"""Results that an interrupted study does not compute again: those of a small study in one file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Generic, TypeVar

from dropo_torch.errors import InputError
from dropo_torch.support.files import write_atomically
from dropo_torch.support.given import reading

Result = TypeVar("Result")


class Store(Generic[Result]):
    """Results by key: dataclasses of plain data, or mappings.

    Args:
        path: the file, written whole after each result; ``None`` to keep nothing.
        fingerprint: identifies config, log and options.
        what: the study, for messages.
        kind: makes a result of what the file holds, from keyword arguments.

    Raises:
        InputError: a file of something else, or of a study with another fingerprint.
    """

    def __init__(self, path: Path | None, fingerprint: str, what: str, kind: Callable[..., Result]) -> None:
        self._path, self._fingerprint = path, fingerprint
        self._results: dict[str, Result] = {}
        if path is None or not path.is_file():
            return
        with reading(f"resume: {path}", f"the record of a {what}", "start again without --resume"):
            content = json.loads(path.read_text())
            owner = content["fingerprint"]
            self._results = {key: kind(**result) for key, result in content["results"].items()}
        if owner != fingerprint:
            raise InputError(
                f"resume: {path} belongs to another config or log, or to other options; start again without --resume"
            )

    def get(self, key: str, compute: Callable[[], Result]) -> Result:
        """Return the result of a key, computed and kept where there is none yet."""
        if key not in self._results:
            self._results[key] = compute()
            if self._path is not None:
                content = {"fingerprint": self._fingerprint, "results": self._results}
                write_atomically(self._path, json.dumps(content, default=asdict).encode())
        return self._results[key]
