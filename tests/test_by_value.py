"""Frozen data that holds arrays is compared by its values."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import dropo_torch as dropo
from dropo_torch.data.trajectory import Trajectories
from dropo_torch.distribution import Distribution
from dropo_torch.support.by_value import ByValue


@dataclass(frozen=True, eq=False)
class Pair(ByValue):
    name: str
    values: np.ndarray
    more: np.ndarray | None = None


def test_values_decide_and_not_the_arrays_that_hold_them() -> None:
    one = Pair("a", np.array([1.0, np.nan]))
    assert one == Pair("a", np.array([1.0, np.nan]))
    assert one != Pair("b", one.values)
    assert one != Pair("a", np.array([1.0, 2.0]))
    assert one != Pair("a", np.array([1.0]))
    assert one != replace(one, more=np.zeros(2))
    assert replace(one, more=np.array(["x"])) == replace(one, more=np.array(["x"]))
    assert one != "a"


def test_public_data_that_holds_arrays_can_be_compared(tmp_path: Path) -> None:
    for name in dropo.__all__:
        kind = getattr(dropo, name)
        if isinstance(kind, type) and is_dataclass(kind) and name not in ("Problem", "Proposal"):  # these hold models
            arrays = [f.name for f in fields(kind) if "ndarray" in str(f.type)]
            assert not arrays or issubclass(kind, ByValue), name
    ends = np.array([0.0, 1.0])
    box = ends, ends + 3, np.stack([ends, ends + 3], 1), ends > 2, ("", "kg")
    fitted = Distribution(("a", "b"), ends, ends + 1, *box)
    fitted.save(tmp_path / "d.yaml")
    assert Distribution.load(tmp_path / "d.yaml") == fitted
    assert replace(fitted, mean=ends + 0.5) != fitted
    log = Trajectories.of_samples(np.arange(6.0).reshape(3, 2), np.zeros((2, 1)), dt=0.1, source="log")
    assert log == Trajectories.of_samples(np.arange(6.0).reshape(3, 2), np.zeros((2, 1)), dt=0.1, source="log")
    with pytest.raises(TypeError, match="unhashable"):
        hash(log)
