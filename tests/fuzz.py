"""Damage files at random and read them: ``fuzz.py [--mutations N] [--seed N] [--only TARGET] [--workers N]``.

Every kind of file that the package reads is a target. A mutation is a pure function of the seed, the target and its
number, and is read in a process that may die: what became of each is counted. Right is an answer of finite numbers or
one line that says what is wrong. A traceback, a dead process, ten seconds without an answer, and an answer with a
number that is not finite are wrong, and shown with the number that repeats them (``--only TARGET --number N``).
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import multiprocessing
import multiprocessing.connection
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import bags
import mujoco
import numpy as np
import scipy.io
import test_bags
import test_readers
import torch
import yaml
from arm import CONFIG, XML, Folder

from dropo_torch.commands.options import Parser
from dropo_torch.config import load_config, parse_overrides
from dropo_torch.data.readers import read_trajectories
from dropo_torch.distribution import Distribution
from dropo_torch.errors import InputError, one_line
from dropo_torch.fit import HistoryEntry
from dropo_torch.models.load import load_model
from dropo_torch.optimizers.fisher import FisherOptimizer
from dropo_torch.parameters import ParameterSpace
from dropo_torch.problem import make_problem
from dropo_torch.support.checkpoint import FORMAT, Checkpoint

#: Seconds after which a reader hangs, bytes that it may take, and the longest line.
HANG, MEMORY, LONGEST = 10.0, 12 << 30, 2000
OUTCOMES = ("refused", "accepted", "traceback", "crash", "hang", "not finite")
#: Whole numbers on which lengths and offsets stumble.
NUMBERS = (0, 1, 2, 3, 7, 8, 16, 63, 64, 127, 128, 255, 256, 1 << 15, 1 << 16, (1 << 31) - 1, 1 << 31, (1 << 32) - 1,
           1 << 40, (1 << 63) - 1, (1 << 64) - 1)  # fmt: skip
#: Words on which text stumbles.
WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"1e-999", b"-0", b"1e308", b"9" * 400, b"0x10", b"1_000", b"1:30:00", b"~",
    b"", b"null", b"true", b"[]", b"{}", b"[[[[", b"}}", b"'", b'"', b"\\", b",", b",,", b"\n", b"\r\n", b"\r", b"\t",
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\x1b[31m", b"[bold]", b"[/]", b"[link=x]", b":smile:",
    b"<a>", b"&a ", b"*a", b"<<: ", b"? ", b"- ", b": ", b"# ", b"!!python/object/apply:os.system [ls]",
    b"!!binary aaaa", b"!!set {a, b}", b"!!timestamp 2024-01-01", b"2024-01-01", b"2024-01-01T10:00:00Z", b"!own x",
    b"---", b"...", b"%YAML 9.9\n", b"|\n", b"=", b"~root/x", b"~nobody_here/x", b"/dev/zero", b"/dev/null",
    b"/proc/self/mem", b"..", b".", b"/", b"*", b"**", b"%s", b"{0}", b"${HOME}", b"x" * 100_000, b'"\\ud800"',
    b'"\\0"', b'"\\x1b[2J"', b"\xc3\xa4", b"\xe2\x80\xae", b"1e-400", b"-1", b"0", b"1e18", b"18446744073709551616",
    b"0.5", b"include", b'file="/dev/zero"', b'nconmax="2000000000"', b'size="nan"', b'timestep="0"', b'mass="-1"',
    b'mass="1e300"', b'memory="1000G"', b'count="100000"',
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A kind of file: which files are damaged, and what reads them.

    Attributes:
        name: the kind.
        files: the files, in a folder of their own; one of them is damaged at a time.
        read: reads them; gives the numbers that must be finite.
        share: how many mutations it gets, relative to others.
        damage: what damages; gives the content of the file.
        repair: makes what would catch any damage, such as a checksum, right again.
    """

    name: str
    files: tuple[Path, ...]
    read: Callable[[], Iterable[Any]]
    share: float = 1.0
    damage: Callable[[bytes, random.Random], bytes] | None = None
    repair: Callable[[bytes], bytes] = bytes


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Return content with one to eight changes."""
    out = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(out) + 1) if rng.random() < 0.6 else rng.randrange(min(len(out), 600) + 1)
        kind = rng.randrange(9)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(out):
            out[at] = rng.randrange(256)
        elif kind == 2:
            width = rng.choice((1, 2, 4, 8))
            number = rng.choice(NUMBERS) % (1 << 8 * width)
            out[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
        elif kind == 3:
            del out[at : at + rng.choice((1, 2, 4, 8, 64, 1000))]
        elif kind == 4:
            del out[at:]
        elif kind == 5:
            part = out[at : at + rng.choice((1, 4, 16, 200))]
            out[at:at] = part * rng.choice((1, 2, 50))
        elif kind == 6:
            word = rng.choice(WORDS)
            out[at : at + rng.choice((0, 0, len(word)))] = word
        elif kind == 7:  # one token of text for another word
            out = bytearray(_other_token(bytes(out), rng))
        elif kind == 8:
            other = rng.randrange(len(out) + 1)
            out[at : at + 16] = out[other : other + 16]
    return bytes(out)


def _other_token(content: bytes, rng: random.Random) -> bytes:
    import re

    found = list(re.finditer(rb"[\w.+-]+", content[:20_000]))
    if not found:
        return content
    token = rng.choice(found)
    return content[: token.start()] + rng.choice(WORDS) + content[token.end() :]


#: Values that no key of a config expects everywhere.
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 10**30, 10**400, -(10**18), 0.5, -0.5, 1e-320, 1e-300, 1e-30, 1e30, 1e154, 1e300,
    math.inf, -math.inf, math.nan, "", " ", "x", "nan", "1e-5", "[bold]x[/]", "[/]", ":smile:", "a\nb", "x" * 100_000,
    "~nobody_here/x", "~", "/", "/dev/zero", "\x00", "a\x1b[2J", "\ud800", "\u202e", [], [[]], [1], ["a"], [None],
    [[1, 2], [3]], list(range(1000)), {}, {"a": 1}, {"a": {"b": {"c": []}}}, {1: 2}, {"x" * 300: 1}, {"[red]": 1},
    "minari:x", "file.py:Class", "os:system", "a:b", "qpos", "upper", "log.npz", "*.npz", "**",
    {"path": "log.npz", "time": "t"}, {"path": ["log.npz"]}, {"signal": "u", "scale": 1e300},
)  # fmt: skip


def other_values(content: bytes, rng: random.Random) -> bytes:
    """Return a config of which one or two entries are other, left out, or stand elsewhere."""
    document = yaml.safe_load(content)
    for _ in range(rng.choice((1, 1, 2))):
        places = list(_places(document))
        owner, key = rng.choice(places)
        kind = rng.randrange(10)
        if kind == 0:
            del owner[key]
        elif kind == 1:
            owner[key] = rng.choice([o[k] for o, k in places])
        elif kind == 2:
            owner[key] = [owner[key]] * rng.choice((1, 2, 100))
        elif kind == 3 and isinstance(owner, dict):
            owner[rng.choice([*VALUES[17:30], "more", key.upper() if isinstance(key, str) else key])] = rng.choice(
                VALUES
            )
        else:
            owner[key] = rng.choice(VALUES)
    try:
        text = yaml.safe_dump(document, sort_keys=False, allow_unicode=rng.random() < 0.5)
    except RecursionError:
        text = "a: &a [*a]"
    return text.encode("utf-8", "surrogatepass")


def _places(document: Any, depth: int = 0) -> Iterator[tuple[Any, Any]]:
    """Every entry of nested mappings and lists, as what holds it and its key; one may contain itself."""
    for key, value in list(document.items() if isinstance(document, dict) else enumerate(document)):
        yield document, key
        if isinstance(value, dict | list) and depth < 10:
            yield from _places(value, depth + 1)


LETTERS = "abcdefghij"
BOMBS = (
    "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in pairwise(LETTERS)),
    "a: &a {k: v}\n" + "".join(f"{b}: &{b} {{<<: [{','.join([f'*{a}'] * 9)}]}}\n" for a, b in pairwise(LETTERS[:8])),
    "[" * 20_000, "{a: " * 20_000, "- " * 20_000 + "x", "a: &a [*a]", "? " * 5000, "data: " + "'" * 50_000, "&a " * 3,
    "a: !!map [1]", "a: !!int x", "a: !!float y", "a: !!bool z", "a: !!null {}", "a: !!seq x", "a: !!timestamp x",
    "a: 2024-13-45", "? [a, b]\n: c", "{? {a: b} : c}", "a: 0b2", "a: 0o9", "a: 09:99:99", "a: " + "1" * 5000,
    "a: 1_0_0", "x: .nan", "a: =", "<<: 1", "<<: [1]", "a: b: c", "\ufeffa: 1", "a:\t1", "--- a\n--- b",
    "!!python/name:os.system", "a: 'x\\0'", 'a: "\\ud800"', 'a: "\\U0011ffff"', "a: 1e400", "parameters: [1]",
    "effects: {a: 1}", "effects: [[1]]", "effects: [{effect: [1]}]", "parameters: {m: {field: [a]}}", "a: !!binary x",
)  # fmt: skip


def bombs(content: bytes, rng: random.Random) -> bytes:
    """Return YAML that is meant to hurt, alone or in the middle of a config."""
    bomb = rng.choice(BOMBS).encode("utf-8", "surrogatepass")
    kind = rng.randrange(4)
    text = bomb if kind == 0 else content + b"\n" + bomb if kind == 1 else bomb + b"\n" + content
    return damaged(text, rng) if kind == 3 else text


# --- targets --------------------------------------------------------------------------------------------------------


def log_target(name: str, writer: Callable[[Path], tuple[Any, dict[str, Any]]], folder: Path, **given: Any) -> Target:
    source, options = writer(folder)
    files = tuple(sorted(p for p in folder.rglob("*") if p.is_file()))
    return Target(name, files, lambda: arrays_of(read_trajectories(source, **options)), **given)


def arrays_of(log: Any) -> list[Any]:
    """The numbers of a log."""
    return [log.observations, log.next_observations, log.actions, 0.0 if log.dt is None else log.dt]


def write_mat4(folder: Path) -> tuple[Path, dict[str, Any]]:
    content = {"state": test_readers.OBSERVATIONS, "u": test_readers.ACTIONS, "t": test_readers.TIME[:, None]}
    scipy.io.savemat(folder / "log.mat", {**content, "k": test_readers.EPISODE[:, None].astype(float)}, format="4")
    return folder / "log.mat", {"observations": "state", "actions": "u", "time": "t", "episode": "k"}


def write_compressed_mat(folder: Path) -> tuple[Path, dict[str, Any]]:
    content = {"log": {"state": test_readers.OBSERVATIONS, "text": "abc", "parts": [np.eye(2), "x"]}}
    content |= {"u": test_readers.ACTIONS, "t": test_readers.TIME[:, None], "k": test_readers.EPISODE}
    scipy.io.savemat(folder / "log.mat", content, do_compression=True)
    return folder / "log.mat", {"observations": "log.state", "actions": "u", "time": "t", "episode": "k"}


def bag_writer(kind: str) -> Callable[[Path], tuple[Path, dict[str, Any]]]:
    """What writes a bag of a third of a second."""

    def write(folder: Path) -> tuple[Path, dict[str, Any]]:
        made = bags.Messages(kind)
        sent = [*test_bags.joint_states(made), *test_bags.commands(made)]
        early = [one for one in sent if one[2] < bags.START + 0.3]
        return bags.write(folder / "run", early, kind=kind), test_bags.ASKED

    return write


def write_big_npz(folder: Path) -> tuple[Path, dict[str, Any]]:
    np.savez_compressed(folder / "log.npz", **test_readers.arrays(following=True))
    return folder / "log.npz", {}


def rezipped(content: bytes) -> bytes:
    """An archive whose array of observations is this, with the right checksums."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in test_readers.arrays(following=True).items():
            other = io.BytesIO()
            np.save(other, array)
            archive.writestr(f"{name}.npy", content if name == "observations" else other.getvalue())
    return buffer.getvalue()


def resummed(content: bytes) -> bytes:
    """A checkpoint with the right checksum."""
    body = content[len(FORMAT) + 65 :]
    return FORMAT + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def model_numbers(path: Path) -> list[Any]:
    """Load a model, find its parameters, simulate ten steps; return what it consists of."""
    model = load_model(path)
    ParameterSpace(model, {"m": {"field": "body_mass", "name": "*", "bounds": [0.5, 2.0]}})
    data = mujoco.MjData(model)
    for _ in range(10):
        mujoco.mj_step(model, data)
    return [model.body_mass, model.body_inertia, model.qpos0, model.opt.timestep, model.dof_damping, model.geom_size]


def problem_numbers(config: Any) -> list[Any]:
    """Make a config's problem and evaluate its objective once, where that takes no longer than a test may."""
    if config.samples > 1000 or (config.frame_skip or 1) > 1000:
        config = config.model_copy(
            update={"samples": min(config.samples, 100), "frame_skip": min(config.frame_skip or 1, 100)}
        )
    settings = config.fit_settings() if config.method == "dropo" else None
    problem = make_problem(config)
    space = problem.space
    box = problem.objective.box
    mean, std = torch.from_numpy(box.middle), torch.from_numpy(box.width / 10)
    found = problem.objective.evaluate_values(box.draw(torch.rand(8, len(space), dtype=torch.float64), mean, std)[None])
    return [problem.space.low, problem.space.high, problem.objective.epsilon, found[0].log_likelihood] + (
        [] if settings is None else [settings.entropy, settings.samples]
    )


def targets(folder: Path) -> dict[str, Target]:
    """Return every kind of file, whole, in folders below this one."""

    def fresh(name: str) -> Path:
        (folder / name).mkdir(parents=True)
        return folder / name

    found = [
        log_target(
            w.__name__.removeprefix("write_"), w, fresh(w.__name__), share=0.3 if w.__name__[6:] == "mat" else 0.8
        )
        for w in test_readers.WRITERS
    ]
    found += [
        log_target("mat4", write_mat4, fresh("mat4"), share=0.3),
        log_target("compressed_mat", write_compressed_mat, fresh("cmat"), share=0.3),
        log_target("npz_compressed", write_big_npz, fresh("znpz"), share=0.5),
        *(log_target(f"ros_{kind}", bag_writer(kind), fresh(f"ros_{kind}"), share=0.3) for kind in bags.KINDS),
    ]
    inner = fresh("inner")
    buffer = io.BytesIO()
    np.save(buffer, test_readers.arrays(following=True)["observations"])
    (inner / "log.npz").write_bytes(buffer.getvalue())
    found.append(
        Target(
            "npz_inside", (inner / "log.npz",), lambda: arrays_of(read_trajectories(inner / "log.npz")), repair=rezipped
        )
    )
    arm = Folder(fresh("arm"))
    config = arm.config(
        noise=[1e-3] * 4, epsilon=1e-4, observation=["qpos", "qvel"], mask=["elbow.velocity"], lag=2,
        covariance="diagonal",
        effects=[{"effect": "joint_friction", "target": "elbow", "friction": 0.1}], entropy=0.0, seed=1,
        data={"path": "log.npz", "terminals": "terminals"}, adam={"steps": 10}, trajectories=2,
    )  # fmt: skip
    make_problem(load_config(config))
    read = lambda: problem_numbers(load_config(config))  # noqa: E731
    found += [
        Target("config_bytes", (config,), read, share=2),
        Target("config_values", (config,), read, share=5, damage=other_values),
        Target("config_bombs", (config,), read, share=1, damage=bombs),
    ]
    options = folder / "options.txt"
    options.write_text("\n".join(f"--{k}={json.dumps(v)}" for k, v in CONFIG.items()))
    found.append(Target("options", (options,), lambda: _options(options), share=0.5))
    models = fresh("models")
    (models / "arm.xml").write_text(XML)
    (models / "hopper.xml").write_bytes(test_hopper().read_bytes())
    for name in ("arm", "hopper"):
        mujoco.mj_saveModel(mujoco.MjModel.from_xml_path(str(models / f"{name}.xml")), str(models / f"{name}.mjb"))
        for kind, share in (("xml", 2), ("mjb", 0.5)):
            path = models / f"{name}.{kind}"
            found.append(Target(f"{name}_{kind}", (path,), lambda path=path: model_numbers(path), share=share))
    kept = Checkpoint(folder / "checkpoint.bin", "fit", ("mine",), (HistoryEntry, *FisherOptimizer.KINDS))
    entry = HistoryEntry(1, 2, 3.0, -4.0, "x", np.zeros(2), np.ones(2))
    kept.save({"optimizer": {"a": np.eye(3), "b": (1, None)}, "history": [entry], "linearised": None})
    found.append(Target("checkpoint", (kept.path,), lambda: kept.load() and []))
    found.append(Target("checkpoint_inside", (kept.path,), lambda: kept.load() and [], repair=resummed))
    made = Distribution.over(make_problem(load_config(config)).space, np.array([1.0, 0.5]), np.array([0.1, 0.1]))
    for name in ("fit.json", "distribution.yaml"):
        path = folder / name
        made.save(path)
        found.append(Target(name, (path,), lambda path=path: _distribution(path)))
    found += list(_policies(folder))
    return {target.name: target for target in found}


def test_hopper() -> Path:
    """Gymnasium's Hopper."""
    from conftest import HOPPER

    return HOPPER


def _options(path: Path) -> list[Any]:
    lines = path.read_bytes().decode("utf-8", "replace").replace("\x00", "").splitlines()
    parser = Parser()
    parser.add_argument("--version", action="store_true")
    _, rest = parser.parse_known_args(lines)
    parse_overrides(rest)
    return []


def _distribution(path: Path) -> list[Any]:
    found = Distribution.load(path)
    return [found.mean, found.std, found.low, found.high, found.sample(4, torch.Generator().manual_seed(0))]


def _policies(folder: Path) -> Iterator[Target]:
    from dropo_torch.rl.policy import Policy, load_policy

    path = folder / "policy.pt"
    given = {"num_observations": 3, "num_actions": 1, "hidden": [4], "activation": "tanh", "head": "normal"}
    Policy({**given, "initial_std": 0.5}, config={}, distribution={}).save(path)
    yield Target("policy", (path,), lambda: [load_policy(path)(torch.zeros(3)).detach().numpy()], share=0.5)


# --- running --------------------------------------------------------------------------------------------------------


def attempt(target: Target, seed: int, number: int) -> tuple[str, str]:
    """Damage one of a target's files, read, and put it back; return what became of it, and its words."""
    rng = random.Random(f"{seed}/{target.name}/{number}")
    path = rng.choice(target.files)
    whole = path.read_bytes()
    try:
        path.write_bytes(target.repair((target.damage or damaged)(whole, rng)))
        values = list(target.read())
    except InputError as error:
        return _judged(str(error))
    except OSError as error:  # the command line says so in one line
        text = one_line(f"{error.filename or 'output'}: {error.strerror}")
        return ("traceback", repr(error)) if error.strerror is None else _judged(text)
    except BaseException:
        return "traceback", traceback.format_exc(limit=-4)
    finally:
        path.write_bytes(whole)
    bad = [v for v in values if not np.isfinite(np.asarray(v, dtype=float)).all()]
    return ("not finite", repr(bad)[:200]) if bad else ("accepted", "")


def _judged(line: str) -> tuple[str, str]:
    ok = len(line) <= LONGEST and line.isprintable() and line.strip()
    return ("refused", line) if ok else ("traceback", f"no line for people: {line[:300]!r} ({len(line)} characters)")


def serve(pipe: Any, seed: int, folder: str) -> None:
    """Read what comes through the pipe, until there is no more."""
    own = Path(tempfile.mkdtemp(dir=folder))
    os.chdir(own)
    os.environ["TMPDIR"] = str(own)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.RLIM_INFINITY))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    torch.set_num_threads(1)
    known = targets(own)
    pipe.send({name: (t.share, None) for name, t in known.items()})
    while True:
        name, number = pipe.recv()
        pipe.send(attempt(known[name], seed, number))


class Worker:
    """A process that reads, and is replaced when it dies."""

    def __init__(self, seed: int, folder: str) -> None:
        self.seed, self.folder = seed, folder
        self.start()

    def start(self) -> None:
        self.pipe, theirs = multiprocessing.Pipe()
        self.process = multiprocessing.get_context("fork").Process(
            target=serve, args=(theirs, self.seed, self.folder), daemon=True
        )
        self.process.start()
        theirs.close()
        self.shares = self.pipe.recv()

    def give(self, task: tuple[str, int]) -> None:
        self.task, self.begun = task, time.monotonic()
        self.pipe.send(task)

    def result(self) -> tuple[str, str] | None:
        """What became of the task; ``None`` while it is under way."""
        try:
            if self.pipe.poll():
                return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            code = self.process.exitcode
            self.start()
            return "crash", f"exit code {code}" + (f" ({signal.Signals(-code).name})" if code and code < 0 else "")
        if time.monotonic() - self.begun > HANG:
            self.process.kill()
            self.process.join()
            self.start()
            return "hang", f"more than {HANG:g} s"
        return None


def fuzz(
    mutations: int, seed: int, *, workers: int = 1, only: Sequence[str] = (), numbers: Sequence[int] = (),
    seconds: float = math.inf,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[dict[str, Counter[str]], list[tuple[str, int, str, str]]]:  # fmt: skip
    """Return how often each outcome came for each target, and every wrong one: target, number, outcome, words.

    After some seconds no more are begun, of whichever target.
    """
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        crew = [Worker(seed, folder) for _ in range(workers)]
        shares = {n: s for n, (s, _) in crew[0].shares.items() if not only or n in only}
        total = sum(shares.values())
        tasks = [(n, i) for n, s in shares.items() for i in (numbers or range(max(1, round(mutations * s / total))))]
        random.Random(seed).shuffle(tasks)
        end = time.monotonic() + seconds
        counts: dict[str, Counter[str]] = {name: Counter() for name in shares}
        wrong: list[tuple[str, int, str, str]] = []
        waiting, busy = iter(tasks), []
        idle = list(crew)
        while True:
            for worker in idle:
                task = next(waiting, None) if time.monotonic() < end else None
                if task is not None:
                    worker.give(task)
                    busy.append(worker)
            if not busy:
                break
            multiprocessing.connection.wait([w.pipe for w in busy], timeout=0.5)
            idle = []
            for worker in list(busy):
                found = worker.result()
                if found is None:
                    continue
                busy.remove(worker)
                idle.append(worker)
                outcome, words = found
                counts[worker.task[0]][outcome] += 1
                if outcome not in ("refused", "accepted"):
                    wrong.append((*worker.task, outcome, words))
                    log(f"{worker.task[0]} {worker.task[1]}: {outcome}: {words}")
        for worker in crew:
            worker.process.kill()
            worker.process.join()
    return counts, wrong


def table(counts: dict[str, Counter[str]]) -> str:
    """Return the counts as a table."""
    head = f"{'target':<24}{'mutations':>10}" + "".join(f"{o:>11}" for o in OUTCOMES)
    rows = [
        f"{name:<24}{sum(c.values()):>10}" + "".join(f"{c[o]:>11}" for o in OUTCOMES)
        for name, c in (*counts.items(), ("all", sum(counts.values(), Counter())))
    ]
    return "\n".join([head, *rows])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=math.inf, help="after which no more are begun")
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--number", type=int, action="append", default=[])
    given = parser.parse_args()
    begun = time.monotonic()
    counts, wrong = fuzz(
        given.mutations, given.seed, workers=given.workers, only=given.only, numbers=given.number,
        seconds=given.seconds,
        log=lambda line: print(line, flush=True),
    )  # fmt: skip
    print(table(counts))
    print(f"{time.monotonic() - begun:.0f} s, seed {given.seed}; wrong: {len(wrong)}")
    return min(len(wrong), 1)


if __name__ == "__main__":
    sys.exit(main())
