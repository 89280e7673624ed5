"""Local Minari datasets, whose episodes have one observation more than actions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from dropo_torch.data.formats import flatten
from dropo_torch.data.tables import ColumnMap, Table
from dropo_torch.data.trajectory import Trajectories, check_values, concatenate
from dropo_torch.errors import InputError, choices
from dropo_torch.support.extras import extra
from dropo_torch.support.given import reading

PREFIX = "minari:"


def read_minari(
    dataset: str | Path, *, observations: ColumnMap | None, actions: ColumnMap | None, dt: float | None
) -> Trajectories:
    """Read a dataset.

    Args:
        dataset: its id, or its folder.
        observations, actions: what is taken of a dictionary, or of the columns; all columns by default.
        dt: seconds of a transition.

    Raises:
        InputError: no such dataset, or one that does not fit.
    """
    with extra("minari", "reading a Minari dataset"):
        import minari
    source = str(dataset)
    if isinstance(dataset, str):
        source, local = f"{PREFIX}{dataset}", list(minari.list_local_datasets())
        if dataset not in local:
            raise InputError(f"{source}: no such local dataset{choices(dataset, local)}; `minari download` fetches one")
    with reading(source, "a Minari dataset"):
        data = minari.load_dataset(dataset) if isinstance(dataset, str) else minari.MinariDataset(dataset)
        episodes = list(data.iterate_episodes())
    logs = []
    for i, episode in enumerate(episodes):
        where = f"{source}: episode {i}"
        seen, done = (_part(episode, *what, where) for what in (("observations", observations), ("actions", actions)))
        if len(seen) != len(done) + 1:
            raise InputError(f"{where}: {len(seen)} observations, {len(done)} actions; expected one observation more")
        logs.append(Trajectories.of_samples(seen, done, dt=dt, source=where))
    if not logs:
        raise InputError(f"{source}: the dataset has no episode")
    return replace(concatenate(logs), source=source)


def _part(episode: Any, what: str, chosen: ColumnMap | None, source: str) -> Any:
    """An episode's observations or actions, ``(samples, columns)``."""
    arrays = {name or what: array for name, array in flatten(getattr(episode, what), "/").items()}
    if chosen is None and what not in arrays:
        raise InputError(
            f"{source}: {what} are a dictionary; choose from it with {what}: [KEY, ...]{choices(what, arrays)}"
        )
    table = Table(source, tuple(arrays), arrays.__getitem__)
    values, names = table.matrix(what if chosen is None else chosen, what)
    check_values(values, names, source)
    return values
