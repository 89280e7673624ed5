"""Logs that are in memory already: data frames, dictionaries of arrays, time series of ``mujoco.sysid``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from dropo_torch.data import sysid
from dropo_torch.data.tables import Table, frame_table


def in_memory(source: Any) -> Table | None:
    """Return a log in memory as a table; ``None`` for anything else, such as a path or options with one.

    A dictionary is one of arrays if it has an array among its values and no ``path``; lists in it are columns then.
    """
    pandas = sys.modules.get("pandas")  # who has a data frame has imported it
    if pandas is not None and isinstance(source, pandas.DataFrame):
        return frame_table("data frame", source)
    series = sysid.in_memory(source)
    if series is not None:
        return sysid.sysid_table(type(source).__name__, series, series.__getitem__)
    if isinstance(source, Mapping) and "path" not in source and any(hasattr(v, "__array__") for v in source.values()):
        arrays = {str(name): np.asarray(values) for name, values in source.items()}
        return Table("arrays", tuple(arrays), arrays.__getitem__)
    return None
