"""A few hundred damaged files of every kind; ``make fuzz`` reads ten thousand."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
import scipy.io
from arm import XML, Folder
from conftest import SLIDE_XML

from dropo_torch.commands.cli import main
from dropo_torch.config import load_config, make_config
from dropo_torch.data.readers import read_trajectories
from dropo_torch.errors import LONGEST, InputError, one_line
from dropo_torch.models.load import load_model
from dropo_torch.objective import LIMITS
from dropo_torch.support import child
from dropo_torch.support.yaml_text import MOST_ENTRIES, load_yaml

#: Readers that need no process of their own, which takes most of a second.
QUICK = (
    "csv", "npz", "npz_inside", "npy", "d4rl", "mat73", "flagged_parquet", "config_bytes", "config_values",
    "config_bombs", "options", "arm_xml", "checkpoint", "checkpoint_inside", "fit.json", "distribution.yaml",
)  # fmt: skip


def test_damaged_files_are_read_or_refused_in_one_line() -> None:
    """In processes of their own: one that dies is counted, and takes nothing along."""
    driver = Path(__file__).with_name("fuzz.py")
    only = [word for name in QUICK for word in ("--only", name)]
    command = [sys.executable, str(driver), "--mutations", "320", "--seed", "11", "--workers", "1", *only]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = [int(n) for n in done.stdout.splitlines()[-2].split()[1:]]
    assert counts[0] >= 300
    assert counts[1] > 50  # refused, and
    assert counts[2] > 10  # read all the same
    assert counts[3:] == [0, 0, 0, 0]


# --- text ------------------------------------------------------------------------------------------------------


def test_a_message_is_one_line_that_a_terminal_can_show() -> None:
    line = one_line("bounds is " + "x" * 100_000 + " at\x1b[2J\n\x00 \ud800 ü; expected [low, high]")
    assert len(line) < 1.1 * LONGEST
    assert line.isprintable()
    assert line.startswith("bounds is xxx")
    assert line.endswith(r"at\x1b[2J \x00 \ud800 ü; expected [low, high]")
    assert "characters left out" in line
    assert one_line("  plain   words ") == "plain words"
    assert len(one_line("\x00" * 100_000)) < 1.1 * LONGEST  # written out, it is four times as long


YAML_REFUSED = {
    "tag": ("a: !!python/object/apply:os.system [ls]", "tag 'tag:yaml.org,2002:python/object/apply:os.system'"),
    "set": ("a: !!set {b, c}", "tag 'tag:yaml.org,2002:set' is not understood at line 1, column 4"),
    "wrong tag": ("a: !!int x", "'x' does not fit its tag"),
    "twice": ("a: 1\nb: 2\na: 3", "key 'a' stands there twice at line 3, column 1"),
    "nesting": ("a: " + "[" * 60 + "]" * 60, "more than 50 levels of nesting"),
    "deep nesting": ("[" * 50_000, "more than 50 levels of nesting"),
    "itself": ("a: &a [*a]", "an entry contains itself"),
    "bomb": (
        "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
        + "".join(f"{n}: &{n} [{','.join([f'*{chr(ord(n) - 1)}'] * 10)}]\n" for n in "bcdefghi"),
        f"more than {MOST_ENTRIES:,} entries",
    ),
    "control": (r'a: "\0"', "control character '\\x00'"),
    "surrogate": (r'a: "\ud800"', "control character '\\ud800'"),
    "escape": (r'a: "\x1b[2J"', "control character"),
    "long key": ("x" * 1000 + ": 1", "a key has 1,000 characters; at most 200"),
    "key of a list": ("? [a]\n: b", "a key is a list or a mapping"),
    "digits": ("a: " + "1" * 5000, "does not fit its tag"),
    "half": ("a: [1, 2", "expected ',' or ']'"),
}


@pytest.mark.parametrize("name", YAML_REFUSED)
def test_yaml_is_plain_data_of_a_bounded_size(name: str) -> None:
    text, expected = YAML_REFUSED[name]
    with pytest.raises(InputError, match=r"^config: x is no valid YAML: ") as error:
        load_yaml(text, "config: x")
    assert one_line(expected) in str(error.value)


def test_yaml_means_what_people_write() -> None:
    text = "[2024-05-01, 2024-13-45, 1:30, 1e-5, 1.5, 010, 0x10, .inf, ~, yes, 'no', =, 12:30:00, 2024-05-01T10:00:00Z]"
    assert load_yaml(text, "x") == [
        "2024-05-01", "2024-13-45", "1:30", 1e-5, 1.5, "010", 16, float("inf"), None, True, "no", "=", "12:30:00",
        "2024-05-01T10:00:00Z",
    ]  # fmt: skip
    shared = load_yaml("a: &a {k: [1]}\nb: *a\nc: {<<: *a, m: 2}", "x")
    assert shared["c"] == {"k": [1], "m": 2}
    assert json.loads(json.dumps(shared))["b"] == {"k": [1]}


def test_a_config_that_is_no_file_of_text_or_too_large_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(b"a: " + b"x" * 10_000_001)
    with pytest.raises(InputError, match="more than 10,000,000 bytes"):
        load_config(path)
    with pytest.raises(InputError, match="there is no such home folder"):
        make_config({"model": "a"}).path("~nobody_has_this_name/x")
    with pytest.raises(InputError, match="an entry contains itself, or has a key that is no text"):
        make_config({"data": {(1, 2): 3}})
    with pytest.raises(InputError, match=r"seed is 1e\+30; expected a whole number"):
        make_config({"seed": 10**30})


EXTREMES = (
    {"epsilon": 1e-300}, {"epsilon": 1e300}, {"epsilon": 10**400}, {"noise": 1e200}, {"noise": [1e-3, 1e155, 0, 0]},
    {"entropy": 1e300}, {"lag": 10**30}, {"lag": 10**6}, {"budget": 10**12}, {"population": 10**9},
    {"chunk_size": 10**18}, {"adam": {"steps": 10**18}}, {"adam": {"samples": 10**9}}, {"adam": {"steps": 2.5}},
    {"adam": {"learning_rate": 1e300}},
    {"parameters": {"upper_mass": {"field": "body_mass", "name": "upper", "bounds": [1, 10**400]}}},
)  # fmt: skip


@pytest.mark.parametrize("changes", EXTREMES, ids=str)
def test_numbers_beyond_reason_are_refused_by_their_key(
    changes: dict, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """ε = 1e-300 was a traceback, a noise of 1e155 a fit without a likelihood, 1e18 steps a fit without an end."""
    if "adam" in changes:
        changes = {**changes, "optimizer": "adam", "backend": "warp"}
    config = Folder(tmp_path / "arm").config(**changes)
    assert main(["fit", str(config), "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert next(iter(changes)) in line


def test_epsilon_may_be_as_small_or_large_as_its_limits_say(tmp_path: Path) -> None:
    for epsilon in LIMITS["epsilon"]:
        config = Folder(tmp_path / "arm").config(epsilon=epsilon)
        assert main(["fit", str(config), "--out", str(tmp_path / str(epsilon))]) == 0
        assert json.loads((tmp_path / str(epsilon) / "fit.json").read_text())["log_likelihood"] is not None


def test_names_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Square brackets are no markup, and colons no pictures."""
    name = "[/bold] :smile: [red]m"
    entry = {"field": "body_mass", "name": "upper", "bounds": [0.5, 3.0], "unit": "[kg]"}
    config = Folder(tmp_path / "arm").config(parameters={name: entry})
    assert main(["fit", str(config), "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "[kg]" in shown
    assert "[/bold]" in shown
    assert ":smile:" in shown


# --- logs ------------------------------------------------------------------------------------------------------


def refused(path: Path, words: str, **options: object) -> None:
    with pytest.raises(InputError, match=words):
        read_trajectories(path, **options)  # type: ignore[arg-type]


COLUMNS = {"observations": ["q", "dq"], "actions": "u", "dt": 0.1}
CSV_REFUSED = {
    "twice": ("q,dq,u,q\n1,2,3,4\n1,2,3,4\n", "two columns are named 'q'"),
    "twice but for a blank": ("q,dq,u, q \n1,2,3,4\n1,2,3,4\n", "two columns are named 'q'"),
    "an open quotation mark": ('q,dq,u,note\n1,2,3,"a\n1,2,3,b\n1,2,3,c"\n4,5,6,d\n', "note has a line break at row 0"),
    "a mark that never closes": ('q,dq,u,note\n1,2,3,"a\n1,2,3,b\n', "cannot be read as a table of text"),
}


@pytest.mark.parametrize("name", CSV_REFUSED)
def test_text_tables_that_mislead_are_refused(name: str, tmp_path: Path) -> None:
    """The second of two columns was read, and the rows between two stray quotation marks left out."""
    text, words = CSV_REFUSED[name]
    (tmp_path / "log.csv").write_text(text)
    refused(tmp_path / "log.csv", words, **COLUMNS)


def test_columns_without_a_name_and_with_blanks_are_no_mistake(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(",q , dq,u,\n0,1,2,3,x\n1,2,3,4,y\n")
    log = read_trajectories(tmp_path / "log.csv", **COLUMNS)
    np.testing.assert_array_equal(log.observations, [[1, 2]])


def write_npz(folder: Path, shape: tuple[int, ...]) -> Path:
    """An archive that declares an array of zeros, compressed to next to nothing."""
    path = folder / "log.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("observations.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
        file.write(bytes(1_000_000))
    return path


def write_npy(folder: Path, shape: tuple[int, ...]) -> Path:
    path = folder / "x_observations.npy"
    for name in ("observations", "nextobservations", "actions"):
        with (folder / f"x_{name}.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return path


def write_sparse_hdf5(folder: Path, shape: tuple[int, ...]) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        file.create_dataset("observations", shape, "f8", chunks=True)
    return folder / "log.h5"


def write_long_parquet(folder: Path, shape: tuple[int, ...]) -> Path:
    from pyarrow import parquet, table

    with parquet.ParquetWriter(folder / "log.parquet", table({"q": [0.0]}).schema) as writer:
        for _ in range(4):
            writer.write_table(table({"q": np.zeros(1000)}))
    return folder / "log.parquet"


@pytest.mark.parametrize("write", [write_npz, write_npy, write_sparse_hdf5])
def test_a_small_file_that_declares_much_is_refused_before_memory_is_taken(
    write: Callable[[Path, tuple[int, ...]], Path], tmp_path: Path
) -> None:
    path = write(tmp_path, (100_000_000, 4))
    assert path.stat().st_size < 3_000_000
    columns = {"observations": "observations", "actions": "observations"}
    refused(path, r"declares 2\.98 GiB; at most 2 GiB of one array are read", **columns)


def test_a_parquet_file_that_declares_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dropo_torch.support.given.MOST_BYTES", 10_000)
    refused(write_long_parquet(tmp_path, ()), "at most .* GiB of one array are read", observations="q", dt=0.1)


# --- readers that a file can kill ------------------------------------------------------------------------------


def killer(path: str) -> bytes:
    """Die as a library does."""
    import os
    import signal

    os.kill(os.getpid(), signal.SIGSEGV)
    return path.encode()


def eater(path: str) -> bytes:
    """Take more memory than there may be."""
    return bytes(100 * 2**30)


def sleeper(path: str) -> bytes:
    """Take more time."""
    import time

    time.sleep(60)
    return b""


@pytest.mark.parametrize(
    ("name", "words"), [("killer", "the reader dies: SIGSEGV"), ("eater", "MemoryError"), ("sleeper", "not in 2 s")]
)
def test_a_reader_that_dies_eats_or_hangs_is_told_in_one_line(
    name: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "SECONDS", 2 if name == "sleeper" else 60)
    with pytest.raises(InputError, match=rf"^log\.mat: cannot be read as a MATLAB file .*{words}"):
        child.read_in_child(f"test_fuzz:{name}", "x", where="log.mat", kind="a MATLAB file")


def test_damaged_matlab_files_do_not_take_the_process_along(tmp_path: Path) -> None:
    """One of these killed scipy's reader, and the process with it, in 3,000."""
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"state": np.arange(20.0).reshape(10, 2), "u": np.zeros((10, 1)), "text": "abc"})
    whole, rng = path.read_bytes(), np.random.default_rng(5)
    for _ in range(4):
        content = bytearray(whole)
        for at in rng.integers(128, len(whole), 12):
            content[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        with contextlib.suppress(InputError):
            log = read_trajectories(path, observations="state", actions="u", dt=0.1, terminals=[])
            assert np.isfinite(log.observations).all()
    path.write_bytes(whole)
    assert len(read_trajectories(path, observations="state", actions="u", dt=0.1, terminals=[])) == 9


def test_a_model_with_names_that_are_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_bytes(b'<mujoco><worldbody><body name="a\xff"><joint/><geom size=".1"/></body></worldbody></mujoco>')
    with pytest.raises(InputError, match=r"^model: .*: a name in it is no text in UTF-8; save the file in UTF-8"):
        load_model(path)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_memory_is_limited_to_more_than_is_taken() -> None:
    code = (
        "import numpy as np; from dropo_torch.support.child import limit_memory; limit_memory(2**28); "
        "np.ones(2**20); print('little');\n"
        "try: np.ones(2**27)\nexcept MemoryError: print('much')"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["little", "much"]


@pytest.mark.parametrize(("field", "value"), [("bvh_nodeid", 738197505), ("bvh_nodeid", 2), ("bvh_child", 1 << 30)])
def test_a_binary_model_that_addresses_what_is_not_there_is_refused(field: str, value: int, tmp_path: Path) -> None:
    """MuJoCo loads and steps it; it dies later, in whichever process computes the model's constants again."""
    (tmp_path / "arm.xml").write_text(XML)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    mujoco.mj_saveModel(model, str(tmp_path / "whole.mjb"))
    assert load_model(tmp_path / "whole.mjb").nbody == model.nbody
    getattr(model, field).flat[-1] = value
    mujoco.mj_saveModel(model, str(tmp_path / "arm.mjb"))
    with pytest.raises(InputError, match=rf"arm\.mjb: cannot be read .*{field} has {value}, which addresses nothing"):
        load_model(tmp_path / "arm.mjb")


def test_damaged_binary_models_are_refused(tmp_path: Path) -> None:
    """Sizes that the file cannot hold made MuJoCo allocate until the machine stood still."""
    path, model = tmp_path / "model.mjb", mujoco.MjModel.from_xml_string(SLIDE_XML)
    mujoco.mj_saveModel(model, str(path))
    assert load_model(path).nq == 1
    whole = path.read_bytes()
    for at, value in ((23, 16), (79, 16), (40, 255)):
        path.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
        with pytest.raises(InputError, match=r"^model: .*cannot be read as a model of this MuJoCo"):
            load_model(path)
    at = whole.index(np.array([2.0]).tobytes())  # the block's mass
    path.write_bytes(whole[:at] + np.array([np.nan]).tobytes() + whole[at + 8 :])
    with pytest.raises(InputError, match="has a value that is not finite"):
        load_model(path)
