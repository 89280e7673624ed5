"""Frames that vary, differentiably: the numbers of them that stand in θ, and the model's pose at ``qpos0``."""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np
import torch

from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.warp.layout import FRAMES

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
#: The numbers of a section by its name, ``(K, n, width)``.
Section = Callable[[str], torch.Tensor]


def varied(space: ParameterSpace, model: mujoco.MjModel) -> dict[str, list[int]]:
    """Return the bodies, joints and geoms (``body``, ``jnt``, ``geom``) whose frames some parameter writes."""
    rows: dict[str, set[int]] = {"body": set(), "jnt": set(), "geom": set()}
    for _, target in space.targets:
        if target.field in FRAMES:
            rows[target.field.split("_")[0]].add(target.index // getattr(model, target.field).shape[1])
    return {kind: sorted(own) for kind, own in rows.items()}


def coinciding(model: mujoco.MjModel, space: ParameterSpace) -> mujoco.MjModel:
    """Return a copy with frames that MuJoCo takes as coinciding (``geom_sameframe`` and the like) where it takes them.

    The compiler marks frames that differ by less than 1e-6, and MuJoCo then copies the other one. The marks of what the
    parameters move do not count: see :func:`~dropo_torch.parameters.unmark_frames`.
    """
    model = copy.copy(model)
    same = mujoco.mjtSameFrame
    of_body = {int(same.mjSAMEFRAME_BODY), int(same.mjSAMEFRAME_BODYROT)}
    whole = {int(same.mjSAMEFRAME_BODY), int(same.mjSAMEFRAME_INERTIA)}
    fields = ("body_ipos", "geom_pos", "geom_quat")
    rows = {(t.field, t.index // read_field(model, t.field).shape[1]) for _c, t in space.targets if t.field in fields}
    moved = {row for field, row in rows if field == "body_ipos"}
    for kind, bodies in (("body_i", range(model.nbody)), ("geom_", model.geom_bodyid), ("site_", model.site_bodyid)):
        marks, pos, quat = (
            getattr(model, name) for name in (kind.split("_")[0] + "_sameframe", kind + "pos", kind + "quat")
        )
        for i, body in enumerate(bodies):
            own = {(kind + "pos", i), (kind + "quat", i)}
            if not marks[i] or body in moved or rows & own:
                continue
            inertial = int(marks[i]) not in of_body
            quat[i] = model.body_iquat[body] if inertial else (1.0, 0.0, 0.0, 0.0)
            if int(marks[i]) in whole:
                pos[i] = model.body_ipos[body] if inertial else 0.0
    return model


def inertial_frames(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and quaternions of the inertial frames that geoms or sites are taken to coincide with."""
    same = mujoco.mjtSameFrame
    inertial = (int(same.mjSAMEFRAME_INERTIA), int(same.mjSAMEFRAME_INERTIAROT))
    marked = np.concatenate([
        model.geom_bodyid[np.isin(model.geom_sameframe, inertial)],
        model.site_bodyid[np.isin(model.site_sameframe, inertial)],
    ])  # fmt: skip
    return model.body_ipos[marked], model.body_iquat[marked]


class Frames:
    """Frames of the bodies, joints and geoms of which some number varies, as they stand in θ."""

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace) -> None:
        self.rows = {kind: torch.tensor(own, dtype=torch.long) for kind, own in varied(space, model).items()}
        self.acting = torch.ones(len(self.rows["geom"]), 3, dtype=torch.float64)
        round_ = model.geom_type[self.rows["geom"].numpy()] == mujoco.mjtGeom.mjGEOM_SPHERE
        self.acting[torch.from_numpy(np.atleast_1d(round_)), 1:] = 0.0  # a sphere has one size

    def __call__(self, section: Section) -> torch.Tensor:
        """Return bodies' positions and quaternions, joints' axes and positions, geoms' like bodies' and sizes."""
        body, jnt, geom = (self.rows[kind] for kind in ("body", "jnt", "geom"))
        parts = [
            [section("body_pos")[:, body], unit(section("body_quat")[:, body])],
            [unit(section("jnt_axis")[:, jnt]), section("jnt_pos")[:, jnt]],
            [section("geom_pos")[:, geom], unit(section("geom_quat")[:, geom])],
        ]
        parts[2].append(section("geom_size")[:, geom] * self.acting)
        return torch.cat([torch.cat(part, -1).flatten(1) for part in parts], 1)


class Pose:
    """Pose of the bodies and motion axes of the dofs at ``qpos0``, as functions of the frames."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, (nb, nv) = model, (model.nbody, model.nv)
        self.carries = torch.zeros(nb, nv, dtype=torch.bool)  # dofs that move a body
        for b in range(1, nb):
            own = slice(model.body_dofadr[b], model.body_dofadr[b] + model.body_dofnum[b])
            self.carries[b] = self.carries[model.body_parentid[b]]
            if model.body_dofnum[b]:
                self.carries[b, own] = True

    def __call__(self, section: Section) -> tuple[torch.Tensor, ...]:
        """Return Jacobians of the bodies' origins and rotations, ``(K, nbody, 3, nv)``, and rotations."""
        model, place, turn = self.model, section("body_pos"), matrices(unit(section("body_quat")))
        axes, anchors = unit(section("jnt_axis")), section("jnt_pos")
        pos, rot = [torch.zeros_like(place[:, 0])], [torch.eye(3, dtype=torch.float64).expand(len(place), 3, 3)]
        spin: list[torch.Tensor] = []  # motion axes of the dofs: angular, and linear at the origin
        shift: list[torch.Tensor] = []
        for b in range(1, model.nbody):
            parent = model.body_parentid[b]
            p = pos[parent] + (rot[parent] @ place[:, b, :, None])[..., 0]
            r = rot[parent] @ turn[:, b]
            for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
                kind, q = model.jnt_type[j], model.qpos0[model.jnt_qposadr[j] :]
                if kind == _FREE:
                    p = torch.from_numpy(q[:3].copy()).expand_as(p)
                    r = matrices(torch.from_numpy(q[3:7].copy())).expand_as(r)
                    spin += [torch.zeros_like(p)] * 3
                    shift += [e.expand_as(p) for e in torch.eye(3, dtype=torch.float64)]
                arm = 0.0 * anchors[:, j] if kind == _FREE else anchors[:, j]
                anchor = p + (r @ arm[..., None])[..., 0]
                if kind == _BALL:
                    r = r @ matrices(torch.from_numpy(q[:4].copy()))
                    p = anchor - (r @ arm[..., None])[..., 0]
                if kind in (_FREE, _BALL):
                    spin += list(r.unbind(-1))
                    shift += [torch.linalg.cross(anchor, axis) for axis in r.unbind(-1)]
                else:
                    axis = (r @ axes[:, j, :, None])[..., 0]
                    spin.append(torch.zeros_like(axis) if kind == _SLIDE else axis)
                    shift.append(axis if kind == _SLIDE else torch.linalg.cross(anchor, axis))
            pos.append(p)
            rot.append(r)
        angular = torch.stack(spin, -1)[:, None] * self.carries[:, None]
        origins, rotation = torch.stack(pos, 1), torch.stack(rot, 1)
        linear = torch.stack(shift, -1)[:, None] * self.carries[:, None]
        linear = linear + torch.linalg.cross(angular, origins[..., None].expand_as(angular), dim=2)
        return linear, angular, rotation


def unit(x: torch.Tensor) -> torch.Tensor:
    """Return vectors ``(..., n)`` of length 1."""
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)


def matrices(quaternions: torch.Tensor) -> torch.Tensor:
    """Return the rotations ``(..., 3, 3)`` of unit quaternions ``(..., 4)``."""
    w, x, y, z = quaternions.unbind(-1)
    rows = (
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
