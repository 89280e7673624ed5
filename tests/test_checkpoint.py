"""What a checkpoint gives back, what it refuses, and that nothing in the package unpickles."""

from __future__ import annotations

import ast
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import dropo_torch
from dropo_torch.effects import find_effect
from dropo_torch.effects.base import Effect, Placed
from dropo_torch.errors import InputError
from dropo_torch.support.checkpoint import Checkpoint, dumps, loads

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: (
        st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text() | st.integers(), inner, max_size=5)
    ),
    max_leaves=20,
)


@dataclass
class Inner:
    values: np.ndarray


@dataclass(frozen=True)
class Outer:
    inner: tuple[Inner, ...]
    name: str | None = None


def through(content: Any, **known: Any) -> Any:
    return loads(b"".join(dumps("fit", ("a",), content, **known)), **known)[2]


@given(PLAIN)
def test_plain_values_come_back_with_their_types(content: Any) -> None:
    found = through(content)
    assert found == content
    assert repr(found) == repr(content)


def test_numbers_that_are_not_finite_come_back() -> None:
    found = through([math.inf, -math.inf, math.nan, -0.0, np.float64("nan"), np.float32(0.1), np.int64(3)])
    assert found[:2] == [math.inf, -math.inf]
    assert math.isnan(found[2])
    assert math.copysign(1, found[3]) == -1
    assert type(found[4]) is np.float64
    assert type(found[5]) is np.float32
    assert type(found[6]) is np.int64


def test_arrays_come_back_to_the_bit_and_in_their_order_in_memory() -> None:
    """A product of matrices rounds by the order in which they lie: without it a resumed fit differs in a last digit."""
    rng = np.random.default_rng(0)
    whole = rng.standard_normal((4, 5, 6))
    arrays = [
        whole, np.asfortranarray(whole), whole.transpose(1, 0, 2), np.zeros((0, 3)), np.array(2.5),
        np.array([np.nan, -0.0, np.inf]), np.arange(3, dtype=np.uint8), np.array([True, False]),
    ]  # fmt: skip
    for array, found in zip(arrays, through(arrays), strict=True):
        assert found.dtype == array.dtype
        assert found.tobytes() == array.tobytes()
        assert (found.flags.c_contiguous, found.flags.f_contiguous) == (
            array.flags.c_contiguous, array.flags.f_contiguous,
        )  # fmt: skip
        assert found.flags.writeable
    matrix = torch.arange(6, dtype=torch.float32).reshape(2, 3).T
    found = through({1: matrix})[1]
    assert torch.equal(found, matrix)
    assert found.stride() == matrix.stride()


def test_dataclasses_and_effects_come_back() -> None:
    state = Outer((Inner(np.ones(2)), Inner(np.zeros(0))), "x")
    found = through(state, roots=(Outer,))
    assert isinstance(found, Outer)
    assert [i.values.tolist() for i in found.inner] == [[1.0, 1.0], []]
    placed = Placed(find_effect("joint_friction"), "hinge", (0.5,))
    assert through(placed, roots=(Placed,), named={Effect: find_effect}) == placed


@pytest.mark.parametrize("content", [object(), {1, 2}, b"x", np.array([object()]), Inner(np.ones(1)), lambda: 0])
def test_what_has_no_word_is_refused_when_it_is_kept(content: Any) -> None:
    with pytest.raises(TypeError, match="a checkpoint holds no"):
        dumps("fit", (), content)


@pytest.fixture
def file(tmp_path: Path) -> Checkpoint:
    kept = Checkpoint(tmp_path / "checkpoint.bin", "fit", ("mine",), (Outer,))
    kept.save({"state": Outer((Inner(np.linspace(0, 1, 50)),)), "told": [[0.1, 0.2]]})
    return kept


def test_no_damage_goes_unnoticed(file: Checkpoint) -> None:
    whole, rng = file.path.read_bytes(), np.random.default_rng(0)
    damaged = [whole[:end] for end in range(0, len(whole), 7)] + [whole + b"0"]
    for at in range(len(whole)):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    for content in damaged:
        file.path.write_bytes(content)
        with pytest.raises(InputError, match=r"checkpoint\.bin is no checkpoint of a fit .*start again without"):
            file.load()
    file.path.write_bytes(whole)
    assert file.load()["told"] == [[0.1, 0.2]]


def test_one_of_another_run_kind_or_version_is_refused(file: Checkpoint) -> None:
    with pytest.raises(InputError, match="belongs to another config, model, log or method; restore those"):
        Checkpoint(file.path, "fit", ("yours",), (Outer,)).load()
    with pytest.raises(InputError, match=r"no checkpoint of a gap \(it is that of a fit\)"):
        Checkpoint(file.path, "gap", ("mine",), (Outer,)).load()
    with pytest.raises(InputError, match=r"no checkpoint of a fit \(a Outer in it\)"):
        Checkpoint(file.path, "fit", ("mine",)).load()


def test_a_forged_one_runs_nothing_and_is_refused(file: Checkpoint) -> None:
    """With a checksum that fits, too."""
    honest = b"".join(dumps("fit", ("mine",), {"state": Outer((), "x")}, (Outer,)))
    line = honest.split(b"\n", 1)[1]
    forgeries = [
        line.replace(b'"Outer"', b'"os.system"'), line.replace(b'"name"', b'"nome"'), b"[" * 100_000 + b"\n", b"{}\n",
        b"\n", b"\xff\n", line.replace(b'"arrays":[]', b'"arrays":[["float64",[99999999999999],[0]]]'),
        line.replace(b'"arrays":[]', b'"arrays":[["object",[1],[0]]]'), line.replace(b'"arrays":[]', b'"arrays":[[]]'),
    ]  # fmt: skip
    for body in forgeries:
        file.path.write_bytes(b"dropo-torch/checkpoint/1 " + hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
        with pytest.raises(InputError, match=r"checkpoint\.bin is no checkpoint of a fit"):
            file.load()


def test_nothing_in_the_package_unpickles() -> None:
    """Neither by pickle itself nor by what loads pickles on the way."""
    root = Path(dropo_torch.__file__).parent
    for path in [*root.rglob("*.py"), *(root.parent / "sims").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {a.name for a in node.names} | {getattr(node, "module", None)}
                assert not names & {"pickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}, path
            if isinstance(node, ast.Call):
                given = {k.arg: k.value for k in node.keywords}
                called = ast.unparse(node.func)
                assert called != "torch.load" or ast.literal_eval(given["weights_only"]) is True, path
                assert called not in ("np.load", "numpy.load") or not ast.literal_eval(given["allow_pickle"]), path
                assert called not in ("pd.read_pickle", "pandas.read_pickle"), path
