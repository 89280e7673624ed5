"""Tasks on several processes: results, errors, and an end when nobody waits any more."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dropo_torch.support.parallel import in_parallel, processors

#: A parent whose workers write their process numbers into a folder and sleep.
PARENT = """
import sys
from test_parallel import sleep_long
from dropo_torch.support.parallel import in_parallel

if __name__ == "__main__":
    try:
        list(in_parallel(sleep_long, [sys.argv[1]] * 4, 2))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def double(value: int, threads: int) -> tuple[int, int]:
    return 2 * value, threads


def fail_beside(folder: Path | None, threads: int) -> None:
    if folder is None:
        raise ValueError("this one")
    sleep_long(folder, threads)


def sleep_if_there(folder: Path | None, threads: int) -> None:
    if folder is not None:
        sleep_long(folder, threads)


def sleep_long(folder: str | Path, threads: int) -> None:
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(300)


def begun(folder: Path, count: int) -> list[int]:
    """The workers that have begun, once there are so many."""
    deadline = time.monotonic() + 120
    while len(found := [int(p.name) for p in folder.iterdir() if p.name.isdigit()]) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def state(process: int) -> str:
    """The first letter of a process's state, as ``ps`` has it; none where it is gone."""
    return subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True).stdout[:1]


def assert_gone(workers: list[int]) -> None:
    deadline = time.monotonic() + 20
    while any(state(w) not in ("", "Z") for w in workers):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_comes_back_with_its_result(workers: int) -> None:
    found = dict(in_parallel(double, range(5), workers))
    assert {task: result[0] for task, result in found.items()} == {n: 2 * n for n in range(5)}
    threads = 0 if workers == 1 else max(1, processors() // workers)
    assert {result[1] for result in found.values()} == {threads}


def test_an_error_ends_the_others_at_once(tmp_path: Path) -> None:
    before = time.monotonic()
    with pytest.raises(ValueError, match="this one"):
        list(in_parallel(fail_beside, [tmp_path, None], 2))
    assert time.monotonic() - before < 120
    assert_gone(begun(tmp_path, 0))


def test_leaving_the_iteration_ends_the_workers(tmp_path: Path) -> None:
    tasks = in_parallel(sleep_if_there, [None, tmp_path, tmp_path], 2)
    assert next(tasks)[0] is None
    workers = begun(tmp_path, 1)
    tasks.close()
    assert_gone(workers)


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("group", [False, True])
def test_workers_end_with_their_parent(sent: signal.Signals, group: bool, tmp_path: Path) -> None:
    """Ctrl-C in a terminal reaches the whole group; a kill, the parent alone."""
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    listen = functools.partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # ignored where tests run in the background
    parent = subprocess.Popen(
        [sys.executable, script, tmp_path], env={**os.environ, "PYTHONPATH": here}, start_new_session=True,
        preexec_fn=listen, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        workers = begun(tmp_path, 2)
        (os.killpg if group else os.kill)(parent.pid, sent)
        errors = parent.communicate(timeout=60)[1]
    finally:
        parent.kill()
    assert parent.returncode == (130 if sent == signal.SIGINT else -signal.SIGKILL)
    assert "Traceback" not in errors
    assert_gone(workers)


def test_the_end_of_one_iteration_is_not_that_of_another() -> None:
    first, second = in_parallel(double, range(4), 2), in_parallel(double, range(6), 2)
    next(first), next(second)
    first.close()
    assert len(list(second)) == 5


def test_no_task_needs_no_worker() -> None:
    assert list(in_parallel(double, [], 2)) == []
