"""How many threads torch computes with."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import torch

_LOCK = threading.Lock()
#: How many are within :func:`single_thread`, in whatever threads, and what the first of them found.
_WITHIN: list[int] = []


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Run torch on one thread, so that sums do not depend on how many there are.

    The number is one for the whole process: it is as before once the last of several that overlap has left.
    """
    with _LOCK:
        _WITHIN.append(_WITHIN[0] if _WITHIN else torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _LOCK:
            before = _WITHIN.pop()
            if not _WITHIN:
                torch.set_num_threads(before)
