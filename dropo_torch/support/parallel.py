"""Independent tasks, several at a time, by processes of their own: of this machine, or of a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal, TypeVar

from dropo_torch.errors import InputError

Task = TypeVar("Task")
Result = TypeVar("Result")

#: How many processes work side by side, or what lends them.
Workers = int | Literal["ray"]
#: How often a task is begun again whose process died, as one does that takes too much memory.
RETRIES = 3


def in_parallel(work: Callable[..., Result], tasks: Sequence[Task], workers: Workers) -> Iterator[tuple[Task, Result]]:
    """Yield each task with its result, as they come; one worker takes them in turn, in this process.

    Worker processes share the processors evenly. They end at once when the iteration is left, by Ctrl-C or an error,
    and when this process is gone, however it ended: what a task writes must be whole or absent at any moment. Tasks
    whose process dies are begun again.

    Args:
        work: called as ``work(task, threads=...)``, 0 for all processors; of a module's top level, as it is pickled.
        tasks: independent of each other.
        workers: processes, 1 or more, or ``"ray"`` for those of a cluster (:mod:`dropo_torch.support.cluster`).

    Raises:
        InputError: processes that die again and again; a cluster that cannot be reached.
        Exception: what ``work`` raised first.
    """
    if workers == "ray":
        from dropo_torch.support.cluster import by_ray

        yield from by_ray(work, tasks, RETRIES)
        return
    count = min(workers, len(tasks))
    if count <= 1:
        for task in tasks:
            yield task, work(task, threads=0)
        return
    waiting, left = dict(enumerate(tasks)), RETRIES
    while waiting:
        before = len(waiting)
        for number, result in _by_processes(work, dict(waiting), count):
            yield waiting.pop(number), result
        left = RETRIES if len(waiting) < before else left - 1
        if left < 0:
            raise died(tasks[next(iter(waiting))])


def check_workers(workers: Workers) -> None:
    """Refuse a cluster that is not there, before anything is written.

    Raises:
        InputError: Ray is not installed, or nothing listens at ``RAY_ADDRESS``.
    """
    if workers == "ray":
        from dropo_torch.support.cluster import ready

        ready()


def died(task: object) -> InputError:
    """Return what is raised where a task's process dies again and again."""
    return InputError(
        f"workers: the process that works on {task} died {RETRIES + 1} times; often it is memory that is short: "
        "give fewer workers"
    )


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _by_processes(work: Callable[..., Result], tasks: dict[int, Any], workers: int) -> Iterator[tuple[int, Result]]:
    """Yield results by their tasks' numbers, until all are done or a process dies, which takes the others along."""
    threads = max(1, processors() // workers)
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_serve, initargs=(threads,))
    own: set[BaseProcess] | None = None
    try:
        running = {pool.submit(work, task, threads=threads): number for number, task in tasks.items()}
        own = set(multiprocessing.active_children()) - others
        for done in as_completed(running):
            if not isinstance(done.exception(), BrokenProcessPool):
                yield running[done], done.result()
    except BaseException:  # nobody waits for the rest
        for process in set(multiprocessing.active_children()) - others if own is None else own:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


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
