"""Independent tasks, several at a time, by processes of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_parallel(work: Callable[..., Result], tasks: Sequence[Task], workers: int) -> Iterator[tuple[Task, Result]]:
    """Yield each task with its result, as they come; one worker takes them in turn, in this process.

    Worker processes share the processors evenly. They end at once when the iteration is left, by Ctrl-C or an error,
    and when this process is gone, however it ended: what a task writes must be whole or absent at any moment.

    Args:
        work: called as ``work(task, threads=...)``, 0 for all processors; of a module's top level, as it is pickled.
        tasks: independent of each other.
        workers: processes, 1 or more.

    Raises:
        Exception: what ``work`` raised first.
    """
    workers = min(workers, len(tasks))
    if workers <= 1:
        for task in tasks:
            yield task, work(task, threads=0)
        return
    threads = max(1, processors() // workers)
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_serve, initargs=(threads,))
    own: set[BaseProcess] | None = None
    try:
        running = {pool.submit(work, task, threads=threads): task for task in tasks}
        own = set(multiprocessing.active_children()) - others
        for done in as_completed(running):
            yield running[done], done.result()
    except BaseException:  # nobody waits for the rest
        for process in set(multiprocessing.active_children()) - others if own is None else own:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _serve(threads: int) -> None:
    """Leave Ctrl-C to the parent, and end when it is gone."""
    import torch  # the parent may have no use for it yet

    torch.set_num_threads(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent: Any = multiprocessing.parent_process()

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
