"""Tables of the meshes that may touch something: their convex hulls' vertices, edges and flat faces.

A mesh is its convex hull, as in MuJoCo. Vertices are numbered within the hull, in the order of ``mesh_graph``; they
are in the frame of the geom (``geom_pos``, ``geom_mat``), into which the compiler moves them. Of the columns of a
geom, ``geom_hull`` is where its vertices start in ``hull_vert`` (-1 without a mesh) and ``geom_nhull`` is how many they
are; ``hull_edgeadr`` is where the neighbors of a vertex start in ``hull_edge``, a list of vertices that ends with -1.
``hull_polyadr`` is where in ``hull_poly`` the list of the polygons at a vertex starts; of a polygon, ``poly_vert`` has
``poly_num`` vertices from ``poly_adr`` on, counterclockwise from outside.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
#: Integer tables of all hulls together.
_INTS = (
    "hull_id", "hull_edgeadr", "hull_edge", "hull_polyadr", "hull_poly", "poly_adr", "poly_num", "poly_vert",
)  # fmt: skip
#: MuJoCo searches a mesh with fewer vertices from first to last, and larger ones along the edges of the hull.
_CLIMB = 10


def mesh_tables(model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Return the tables of the hulls of all geoms in ``pairs`` that are meshes."""
    touching = sorted({g for pair in pairs for g in pair[:2] if model.geom_type[g] == _MESH})
    geom_hull, geom_nhull = np.full(model.ngeom, -1), np.zeros(model.ngeom, dtype=int)
    climbs = np.zeros(model.ngeom, dtype=int)
    lists: dict[str, list[Any]] = {name: [] for name in (*_INTS, "hull_vert", "poly_normal")}
    placed: dict[int, tuple[int, int]] = {}
    for g in touching:
        mesh = int(model.geom_dataid[g])
        if mesh not in placed:
            placed[mesh] = len(lists["hull_id"]), _add_hull(model, mesh, lists)
        geom_hull[g], geom_nhull[g] = placed[mesh]
        climbs[g] = model.mesh_graphadr[mesh] >= 0 and model.mesh_vertnum[mesh] >= _CLIMB
    vectors = {name: np.array(lists[name], dtype=np.float64).reshape(-1, 3) for name in ("hull_vert", "poly_normal")}
    numbers = {name: np.array(lists[name], dtype=int) for name in _INTS}
    return {"geom_hull": geom_hull, "geom_nhull": geom_nhull, "geom_climbs": climbs, **vectors, **numbers}


def _add_hull(model: mujoco.MjModel, mesh: int, lists: dict[str, list[Any]]) -> int:
    """Append the hull of a mesh to the lists and return the number of its vertices."""
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    ids, edges = hull_graph(model, mesh)
    for neighbors in edges:
        lists["hull_edgeadr"].append(len(lists["hull_edge"]))
        lists["hull_edge"].extend([*neighbors, -1])
    lists["hull_id"].extend(ids)
    lists["hull_vert"].extend(vertices[ids])
    _add_polygons(model, mesh, ids, lists)
    return len(ids)


def _add_polygons(model: mujoco.MjModel, mesh: int, ids: np.ndarray, lists: dict[str, list[Any]]) -> None:
    """Append the flat faces of a hull to the lists, with its vertices ``ids`` numbered within it."""
    first, base = int(model.mesh_polyadr[mesh]), len(lists["poly_adr"])
    number = {int(vertex): i for i, vertex in enumerate(ids)}
    for p in range(first, first + int(model.mesh_polynum[mesh])):
        start, count = int(model.mesh_polyvertadr[p]), int(model.mesh_polyvertnum[p])
        lists["poly_adr"].append(len(lists["poly_vert"]))
        lists["poly_num"].append(count)
        lists["poly_vert"].extend(number[int(v)] for v in model.mesh_polyvert[start : start + count])
        lists["poly_normal"].append(model.mesh_polynormal[p])
    for vertex in ids:
        start, count = (
            int(table[model.mesh_vertadr[mesh] + vertex]) for table in (model.mesh_polymapadr, model.mesh_polymapnum)
        )
        lists["hull_polyadr"].append(len(lists["hull_poly"]))
        lists["hull_poly"].extend([*(base + int(p) for p in model.mesh_polymap[start : start + count]), -1])


def hull_graph(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, list[list[int]]]:
    """Return which vertices of a mesh are its hull's, and the neighbors of each of them within the hull.

    A mesh without a hull (too few vertices) has all its vertices and no neighbors.
    """
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        count = int(model.mesh_vertnum[mesh])
        return np.arange(count), [[] for _ in range(count)]
    count = int(model.mesh_graph[start])
    addresses, ids = model.mesh_graph[start + 2 : start + 2 + 2 * count].reshape(2, count)
    edges = model.mesh_graph[start + 2 + 2 * count :]
    neighbors = []
    for address in addresses.tolist():
        end = address + int(np.argmax(edges[address:] < 0))
        neighbors.append(edges[address:end].tolist())
    return ids.copy(), neighbors
