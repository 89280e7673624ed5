"""One run at a time in a folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from dropo_torch.errors import InputError

try:
    import fcntl
except ImportError:  # Windows has no such locks: there two runs in one folder are not noticed
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other processes' runs out of a folder, which is made, until this one ends, however it ends.

    A folder made in vain is taken away again; one that cannot be made or locked (as on NFS) is left to whoever writes
    there.

    Raises:
        InputError: another run is using it.
    """
    made: list[Path] = []
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            made = [p for p in (folder, *folder.parents) if not p.exists()]
            folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # Windows opens no folders
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            _lock(handle, folder)
        stack.callback(_remove_empty, made)
        yield


def _lock(handle: int, folder: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"--out: another run is using {folder}; wait for it, or name another folder") from None


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
