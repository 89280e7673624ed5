"""How many threads torch and linear algebra compute with."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator

import scipy.linalg  # noqa: F401  (its library of linear algebra is not NumPy's, and is to be found, too)
import threadpoolctl
import torch

_LOCK = threading.Lock()
#: How many are within :func:`single_thread`, in whatever threads, and what the first of them found.
_WITHIN: list[tuple[int, threadpoolctl.threadpool_limits]] = []


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Run torch, NumPy and SciPy on one thread, so that sums do not depend on how many there are.

    Nor does the time: threads that share the work on small matrices wait for each other most of it, and for minutes
    where other programs run besides. The number is one for the whole process: it is as before once the last of several
    that overlap has left. Also a decorator.
    """
    with _LOCK:
        _WITHIN.append(_WITHIN[0] if _WITHIN else (torch.get_num_threads(), _linear_algebra().limit(limits=1)))
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _LOCK:
            threads, limited = _WITHIN.pop()
            if not _WITHIN:
                torch.set_num_threads(threads)
                limited.restore_original_limits()


@functools.cache
def _linear_algebra() -> threadpoolctl.ThreadpoolController:
    """The libraries of linear algebra that NumPy and SciPy have loaded."""
    return threadpoolctl.ThreadpoolController().select(user_api="blas")
