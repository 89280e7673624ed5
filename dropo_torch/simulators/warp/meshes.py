"""Tables of the meshes that may touch something: their convex hulls' vertices, edges and flat faces.

A mesh is its convex hull, as in MuJoCo. Vertices are numbered within the hull, in the order of ``mesh_graph``; they
are in the frame of the geom (``geom_pos``, ``geom_mat``), into which the compiler moves them. Of the columns of a
geom, ``geom_hull`` is where its vertices start in ``hull_vert`` (-1 without a mesh) and ``geom_nhull`` is how many they
are; ``hull_edgeadr`` is where the neighbours of a vertex start in ``hull_edge``, a list of vertices that ends with -1.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
#: Integer tables of all hulls together.
_INTS = ("hull_id", "hull_edgeadr", "hull_edge")


def mesh_tables(model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Return the tables of the hulls of all geoms in ``pairs`` that are meshes."""
    touching = sorted({g for pair in pairs for g in pair[:2] if model.geom_type[g] == _MESH})
    geom_hull, geom_nhull = np.full(model.ngeom, -1), np.zeros(model.ngeom, dtype=int)
    lists: dict[str, list[Any]] = {name: [] for name in (*_INTS, "hull_vert")}
    placed: dict[int, tuple[int, int]] = {}
    for g in touching:
        mesh = int(model.geom_dataid[g])
        if mesh not in placed:
            placed[mesh] = len(lists["hull_id"]), _add_hull(model, mesh, lists)
        geom_hull[g], geom_nhull[g] = placed[mesh]
    vertices = np.array(lists["hull_vert"], dtype=np.float64).reshape(-1, 3)
    return {"geom_hull": geom_hull, "geom_nhull": geom_nhull, "hull_vert": vertices} | {
        name: np.array(lists[name], dtype=int) for name in _INTS
    }


def _add_hull(model: mujoco.MjModel, mesh: int, lists: dict[str, list[Any]]) -> int:
    """Append the hull of a mesh to the lists and return the number of its vertices."""
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    ids, edges = hull_graph(model, mesh)
    for neighbours in edges:
        lists["hull_edgeadr"].append(len(lists["hull_edge"]))
        lists["hull_edge"].extend([*neighbours, -1])
    lists["hull_id"].extend(ids)
    lists["hull_vert"].extend(vertices[ids])
    return len(ids)


def hull_graph(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, list[list[int]]]:
    """Return which vertices of a mesh are its hull's, and the neighbours of each of them within the hull.

    A mesh without a hull (too few vertices) has all its vertices and no neighbours.
    """
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        count = int(model.mesh_vertnum[mesh])
        return np.arange(count), [[] for _ in range(count)]
    count = int(model.mesh_graph[start])
    addresses, ids = model.mesh_graph[start + 2 : start + 2 + 2 * count].reshape(2, count)
    edges = model.mesh_graph[start + 2 + 2 * count :]
    neighbours = []
    for address in addresses.tolist():
        end = address + int(np.argmax(edges[address:] < 0))
        neighbours.append(edges[address:end].tolist())
    return ids.copy(), neighbours
