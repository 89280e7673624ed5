"""Tasks on several processes, of this machine or of a cluster: results, errors, deaths, and an end if nobody waits."""

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from arm import Folder

from dropo_torch.commands.cli import main
from dropo_torch.errors import InputError
from dropo_torch.support.cluster import threads_of_a_task
from dropo_torch.support.parallel import RETRIES, Workers, in_parallel, processors

#: A small cluster that ends with its standard input.
HEAD = """
import sys
import ray

quiet = {"include_dashboard": False, "logging_level": "ERROR"}
print(ray.init("local", num_cpus=2, object_store_memory=80_000_000, **quiet).address_info["gcs_address"], flush=True)
sys.stdin.read()
"""
#: A parent whose workers write their process numbers into a folder and sleep.
PARENT = """
import sys
from test_parallel import sleep_long
from dropo_torch.support.parallel import in_parallel

if __name__ == "__main__":
    try:
        list(in_parallel(sleep_long, [sys.argv[1]] * 4, "ray" if sys.argv[2] == "ray" else 2))
    except KeyboardInterrupt:
        sys.exit(130)
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Where a cluster of two processes listens, which another process has begun."""
    pytest.importorskip("ray")
    head = subprocess.Popen(
        [sys.executable, "-c", HEAD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "RAY_raylet_start_wait_time_s": "120"},
    )  # fmt: skip
    assert head.stdout is not None
    found = head.stdout.readline().strip()
    if not found:
        head.communicate()
        pytest.skip("no cluster of Ray comes up on this machine")
    yield found
    head.communicate()


@pytest.fixture(params=[1, 2, "ray"])
def workers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Workers:
    """In this process, in two others, or by two of a cluster."""
    if request.param == "ray":
        monkeypatch.setenv("RAY_ADDRESS", request.getfixturevalue("address"))
    return request.param


@pytest.fixture
def others(workers: Workers) -> Workers:
    """In other processes."""
    if workers == 1:
        pytest.skip("this process takes tasks in turn")
    return workers


def die_once(task: tuple[int, Path], threads: int) -> int:
    """The first to come to the second task is killed."""
    number, folder = task
    if number == 1 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(folder: Path, threads: int) -> None:
    (folder / str(os.getpid())).touch()
    os.kill(os.getpid(), signal.SIGKILL)


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


def test_every_task_comes_back_with_its_result(workers: Workers) -> None:
    found = dict(in_parallel(double, range(5), workers))
    assert {task: result[0] for task, result in found.items()} == {n: 2 * n for n in range(5)}
    threads = {1: 0, 2: max(1, processors() // 2), "ray": 1}[workers]
    assert {result[1] for result in found.values()} == {threads}


def test_an_error_ends_the_others_at_once(others: Workers, tmp_path: Path) -> None:
    before = time.monotonic()
    with pytest.raises(ValueError, match="this one") as caught:
        list(in_parallel(fail_beside, [tmp_path, None], others))
    assert type(caught.value) is ValueError
    assert time.monotonic() - before < 120
    assert_gone(begun(tmp_path, 0))


def test_leaving_the_iteration_ends_the_workers(others: Workers, tmp_path: Path) -> None:
    tasks = in_parallel(sleep_if_there, [None, tmp_path, tmp_path], others)
    assert next(tasks)[0] is None
    workers = begun(tmp_path, 1)
    tasks.close()
    assert_gone(workers)


def test_a_worker_that_is_killed_costs_its_task_not_the_run(others: Workers, tmp_path: Path) -> None:
    found = in_parallel(die_once, [(number, tmp_path) for number in range(4)], others)
    assert sorted(result for _, result in found) == [0, 1, 2, 3]
    assert (tmp_path / "died").exists()


def test_a_task_that_kills_every_worker_is_told(others: Workers, tmp_path: Path) -> None:
    tasks = [tmp_path / "one", tmp_path / "two"]
    for folder in tasks:
        folder.mkdir()
    with pytest.raises(InputError, match=f"died {RETRIES + 1} times; often it is memory"):
        list(in_parallel(die, tasks, others))
    assert max(len(begun(folder, 0)) for folder in tasks) == RETRIES + 1


@pytest.mark.parametrize(
    ("nodes", "tasks", "threads"),
    [((1, 1), 5, 1), ((8,), 2, 4), ((4, 4), 3, 2), ((5, 5), 3, 2), ((8, 2), 1, 8), ((), 3, 1)],
)
def test_tasks_take_the_processors_that_let_all_run_at_once(nodes: tuple[int, ...], tasks: int, threads: int) -> None:
    assert threads_of_a_task(nodes, tasks) == threads


def test_a_cluster_that_does_not_answer_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(InputError, match=r"no cluster at RAY_ADDRESS=127\.0\.0\.1:1"):
        list(in_parallel(double, [1, 2], "ray"))


def test_a_node_that_sees_other_files_is_told(address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    monkeypatch.setattr(os, "getcwd", lambda: str(tmp_path / "elsewhere"))
    with pytest.raises(InputError, match=r"has no folder .*elsewhere; all nodes must see the same files"):
        list(in_parallel(double, [1, 2], "ray"))


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("kind", ["processes", "ray"])
def test_workers_end_with_their_parent(
    sent: signal.Signals, group: bool, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in a terminal reaches the whole group; a kill, the parent alone. The cluster is the parent's own."""
    if kind == "ray":
        pytest.importorskip("ray")
        monkeypatch.delenv("RAY_ADDRESS", raising=False)
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    listen = functools.partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # ignored where tests run in the background
    parent = subprocess.Popen(
        [sys.executable, script, tmp_path, kind], env={**os.environ, "PYTHONPATH": here}, start_new_session=True,
        preexec_fn=listen, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        workers = begun(tmp_path, 2 if kind == "processes" else min(2, processors()))
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


@pytest.mark.parametrize("workers", [1, 2])
def test_no_task_needs_no_worker(workers: int) -> None:
    assert list(in_parallel(double, [], workers)) == []


@pytest.mark.parametrize(
    "command", ["sweep-epsilon --epsilons 1e-4,1e-6,1e-5", "compare --seeds 2 --methods fisher-mujoco,cma-mujoco"]
)
def test_a_study_finds_the_same_whatever_works(
    command: str, others: Workers, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Folder(tmp_path).config(budget=20)
    verb, *options = command.split()
    for name, kind in (("serial", 1), ("others", others)):
        given = [verb, str(config), "--out", str(tmp_path / name), *options, "--workers", str(kind)]
        assert main(given) == 0, capsys.readouterr().err
    file = {"sweep-epsilon": "sweep.json", "compare": "compare.json"}[verb]
    serial, found = (
        json.loads((tmp_path / name / file).read_text(), object_hook=timeless) for name in ("serial", "others")
    )
    assert serial == found


def timeless(document: dict[str, Any]) -> dict[str, Any]:
    """A document without what the clock says."""
    return {key: value for key, value in document.items() if key != "seconds"}


@pytest.mark.parametrize("given", ["0", "-1", "1.5", "two", "[1]"])
@pytest.mark.parametrize("command", ["sweep-epsilon CONFIG --out OUT", "reproduce hopper --out OUT"])
def test_so_many_workers_there_cannot_be(
    given: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Folder(tmp_path).config()
    words = command.replace("CONFIG", str(config)).replace("OUT", str(tmp_path / "out")).split()
    assert main([*words, f"--workers={given}"]) == 2
    error = capsys.readouterr().err
    assert "workers" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["fit", "gap", "train"])
def test_work_that_is_not_divided_takes_no_workers(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Folder(tmp_path).config()
    assert main([command, str(config), "--out", str(tmp_path / "out"), "--workers", "ray"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"dropo: {command}: --workers is not understood, as its work is not divided; sweep-epsilon")
    assert not (tmp_path / "out").exists()
