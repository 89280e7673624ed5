"""Independent tasks on a Ray cluster: the one of ``RAY_ADDRESS``, or one of this machine's processors."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from dropo_torch.errors import InputError
from dropo_torch.support.extras import extra
from dropo_torch.support.parallel import died, processors

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Bytes that a cluster of this machine keeps objects in: results are documents of some kilobytes.
STORE = 100_000_000
#: Seconds in which a cluster must answer.
SECONDS = 10
#: What Ray is told unless the user has said otherwise: nothing is sent to its makers, and tasks see all GPUs.
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


def by_ray(work: Callable[..., Result], tasks: Sequence[Task], retries: int) -> Iterator[tuple[Task, Result]]:
    """Yield each task with its result, as they come; as :func:`~dropo_torch.support.parallel.in_parallel`.

    A task takes as many processors of a node as let all run at once, and at least one. Nodes must have the same
    packages and see the same files as this process, in the same places.

    Args:
        work: called as ``work(task, threads=...)``.
        tasks: independent of each other.
        retries: how often a task is begun again whose process, or node, died.

    Raises:
        InputError: no cluster answers, a node sees other files, or processes die again and again.
        Exception: what ``work`` raised first.
    """
    ray = ready()
    if not tasks:
        return
    with _connected(ray):
        threads = threads_of_a_task([int(n["Resources"].get("CPU", 0)) for n in ray.nodes() if n["Alive"]], len(tasks))
        answer = ray.remote(_answer).options(num_cpus=threads, max_retries=retries, retry_exceptions=False)
        here = ([path or os.getcwd() for path in sys.path], os.getcwd())
        running = {answer.remote([ray.put((work, t))], *here, threads): n for n, t in enumerate(tasks)}
        try:
            while running:
                (done,), _ = ray.wait(list(running))
                task = tasks[running.pop(done)]
                yield task, _got(ray, done, task)
        finally:
            for waiting in running:  # nobody waits for the rest
                ray.cancel(waiting, force=True)


def ready() -> Any:
    """Return Ray's module.

    Raises:
        InputError: it is not installed, or nothing listens at ``RAY_ADDRESS``.
    """
    with extra("ray", "workers: ray"):
        import ray
    if not ray.is_initialized():
        with _told():
            _call_up(os.environ.get("RAY_ADDRESS", ""))
    return ray


def threads_of_a_task(nodes: Sequence[int], tasks: int) -> int:
    """Return the most processors that a task may take for all to run at once, and 1 where they cannot.

    Args:
        nodes: processors of each.
        tasks: how many.
    """
    return max((t for t in range(1, max(nodes, default=1) + 1) if sum(n // t for n in nodes) >= tasks), default=1)


@contextlib.contextmanager
def _connected(ray: Any) -> Iterator[None]:
    """Be connected to a cluster: the one that this process has already, that of ``RAY_ADDRESS``, or a new one."""
    if ray.is_initialized():
        yield
        return
    address = os.environ.get("RAY_ADDRESS", "")
    here = {"num_cpus": processors(), "object_store_memory": STORE, "include_dashboard": False}
    for key, value in _QUIET.items():
        os.environ.setdefault(key, value)
    with _told():
        ray.init(address or "local", logging_level=logging.ERROR, log_to_driver=False, **({} if address else here))
    try:
        yield
    finally:
        ray.shutdown()


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """Raise an :class:`InputError` where no cluster can be reached or begun."""
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        address = os.environ.get("RAY_ADDRESS")
        where = f"RAY_ADDRESS={address}" if address else "this machine"
        raise InputError(
            f"workers: ray: no cluster at {where} ({error}); begin one with `ray start --head`, or unset RAY_ADDRESS"
        ) from None


def _call_up(address: str) -> None:
    """Raise an :class:`OSError` unless something listens at ``host:port``, for which Ray itself would wait minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=SECONDS).close()


def _got(ray: Any, reference: Any, task: object) -> Any:
    """A task's result, or what it raised."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError, ray.exceptions.OutOfMemoryError):
        raise died(task) from None


def _answer(call: list[Any], path: list[str], folder: str, threads: int) -> Any:
    """Do a task where and as the process would that has it done.

    Args:
        call: a reference to work and task, in a list: Ray would otherwise load them before ``path`` tells from where.
        path: where that process finds modules.
        folder: where it runs.
        threads: of the task.
    """
    import ray
    import torch

    if not os.path.isdir(folder):
        raise InputError(f"workers: ray: {platform.node()} has no folder {folder}; all nodes must see the same files")
    os.chdir(folder)
    sys.path[:] = [*path, *(p for p in sys.path if p not in path)]
    torch.set_num_threads(threads)
    work, task = ray.get(call[0])
    return work(task, threads=threads)
