"""From parameter vectors to θ, differentiably: what MuJoCo derives from a model is derived here in PyTorch.

θ has the model's own numbers, then one set of contact parameters for each pair of geoms (mixed by priority and
``solmix`` as MuJoCo does), then the inverse weights that ``mj_setConst`` computes at ``qpos0``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import numpy as np
import torch

from dropo_torch.models.constants import slide_alone
from dropo_torch.models.contacts import mixing
from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.warp.couplings import equality_bodies, has_dofs, welds
from dropo_torch.simulators.warp.layout import ADDED, DIRECT, FRAMES, INERTIAL, MIXED, PAIR
from dropo_torch.simulators.warp.varied import Frames, Pose, Section, matrices, unit
from dropo_torch.support.threads import single_thread

_INERTIAL = frozenset({"body_mass", "body_inertia", "body_ipos", "dof_armature", "tendon_armature"})
#: The fields that are read: name of the section, field, columns kept of each row (0: all).
_READ = (*DIRECT, *((field, field, 0) for field in (*MIXED, *FRAMES, *ADDED, INERTIAL)))
#: Frames that the inverse weights depend on.
_POSED = frozenset({"body_pos", "body_quat", "jnt_axis", "jnt_pos"})
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_MINVAL = 1e-15
_MINMU = 1e-5


class Fields:
    """Maps parameter vectors ``(K, d)`` to θ ``(K, P)``.

    Args:
        model: the model, with everything ``mj_setConst`` derives up to date.
        space: the parameters.
        pairs: geoms that may touch, see :func:`candidate_pairs`.

    Attributes:
        sections: where θ's sections start, name → (offset, size).
        size: length of θ.
        wanted: columns of θ whose gradient is wanted.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]]) -> None:
        columns, start = {}, 0
        self._raw_sections = {}
        for name, field, keep in _READ:
            array = np.atleast_1d(read_field(model, field))
            kept = np.ones(array.shape, dtype=bool)
            if keep:
                kept[:, keep:] = False
            size = int(kept.sum())
            columns[field] = np.where(kept.ravel(), kept.cumsum() - 1 + start, -1)
            self._raw_sections[name] = (start, size, keep or int(np.prod(array.shape[1:], dtype=int)))
            start += size
        self._adding = _Adding(model, space, columns)
        self._own = torch.from_numpy(_raw(model))  # as it stands in the model, and with what actuators add
        self._raw = self._adding(self._own[None])[0]
        self.sections = {name: self._raw_sections[name][:2] for name, _f, _k in DIRECT}
        self._direct = self.size = sum(size for _, size in self.sections.values())
        self._frames = Frames(model, space)
        widths = {f"pair_{name}": width * len(pairs) for name, width in PAIR.items()}
        widths |= {"dof_invweight": model.nv, "weld_invweight": 2 * len(welds(model)), "ten_invweight": model.ntendon}
        rows = {kind: len(own) for kind, own in self._frames.rows.items()}
        widths["imat"] = 9 * model.nbody
        widths |= {"body_frame": 7 * rows["body"], "link_frame": 6 * rows["jnt"], "geom_frame": 10 * rows["geom"]}
        for name, width in widths.items():
            self.sections[name] = (self.size, width)
            self.size += width
        self._anchors = _Anchors(model, space, columns["eq_data"])
        self._targets(space, columns)
        posed = bool(_POSED & set(space.fields))
        self._derive: tuple[Callable[[Section], torch.Tensor], ...]
        self._derive = (_Mixing(model, pairs), _Weights(model, pairs, posed=posed), _principal_axes, self._frames)
        self._constant = self._derived(self._raw[None])

    def _targets(self, space: ParameterSpace, columns: dict[str, np.ndarray]) -> None:
        """Columns that the parameters write, and those of θ whose gradient is wanted."""
        targets = [(source, target) for source, p in enumerate(space.parameters) for target in p.targets]
        fields = {target.field for _, target in targets}
        self._written = torch.tensor([int(columns[t.field][t.index]) for _, t in targets], dtype=torch.long)
        self._factors = torch.tensor([t.factor for _, t in targets], dtype=torch.float64)
        self._sources = torch.tensor([source for source, _ in targets], dtype=torch.long)
        inertial = _INERTIAL | _POSED | ({"actuator_armature", "actuator_gear"} if len(self._adding.factors) else set())
        self._varies = tuple(bool(fields & set(causes)) for causes in (MIXED, inertial, (), FRAMES))
        derived = (
            [f"pair_{name}" for name in PAIR if name != "invweight"],
            ["pair_invweight", "dof_invweight", "weld_invweight", "ten_invweight"],
            ["imat"],
            ["body_frame", "link_frame", "geom_frame"],
        )
        own = [self.columns(n) for names, varies in zip(derived, self._varies, strict=True) if varies for n in names]
        direct = np.concatenate([self._written.numpy(), self._anchors.derived, self._adding.into.numpy()])
        direct = direct[direct < self._direct]
        self.wanted = np.unique(np.concatenate([direct, *own])).astype(np.int32)

    def columns(self, name: str) -> np.ndarray:
        """Return the columns of a section of θ."""
        start, size = self.sections[name]
        return np.arange(start, start + size)

    def with_derivative(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return θ ``(K, P)`` and the derivative of its wanted columns by each of the values ``(K, wanted, d)``."""
        leaf = values.detach().requires_grad_(True)
        with torch.enable_grad():
            theta = self(leaf)
            slopes = [torch.autograd.grad(theta[:, c].sum(), leaf, retain_graph=True)[0] for c in self.wanted.tolist()]
        return theta.detach(), torch.stack(slopes, 1)

    def constant(self) -> np.ndarray:
        """Return θ of the model itself, ``(1, P)``."""
        return torch.cat([self._raw[None, : self._direct], *self._constant], dim=1).numpy()

    def of(self, models: Sequence[mujoco.MjModel]) -> torch.Tensor:
        """Return θ ``(K, P)`` of models that differ from this one in fields of θ only."""
        raw = self._adding(torch.from_numpy(np.stack([_raw(model) for model in models])))
        return torch.cat([raw[:, : self._direct], *self._derived(raw)], dim=1)

    def _derived(self, raw: torch.Tensor) -> list[torch.Tensor]:
        with torch.no_grad(), single_thread():  # waking other threads for a few small matrices takes milliseconds
            return [derive(partial(self._section, raw)) for derive in self._derive]

    def _section(self, raw: torch.Tensor, name: str) -> torch.Tensor:
        start, size, width = self._raw_sections[name]
        return raw[:, start : start + size].reshape(len(raw), size // width, width)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return θ ``(K, P)`` of parameter vectors ``(K, d)``, differentiable."""
        raw = self._own.expand(len(values), -1)
        raw = self._adding(raw.index_copy(1, self._written, values[:, self._sources] * self._factors))
        raw = self._anchors(raw)
        derived = [
            derive(partial(self._section, raw)) if varies else constant.expand(len(values), -1)
            for derive, varies, constant in zip(self._derive, self._varies, self._constant, strict=True)
        ]
        return torch.cat([raw[:, : self._direct], *derived], dim=1)


def _raw(model: mujoco.MjModel) -> np.ndarray:
    """The model's own numbers, from which θ is made."""
    parts = []
    for _, field, keep in _READ:
        array = np.atleast_1d(read_field(model, field))
        parts.append((array[:, :keep] if keep else array).ravel())
    raw = np.concatenate(parts, dtype=np.float64)
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY):
        raw[:3] = 0.0
    return raw


class _Adding:
    """What actuators add to damping and armature of hinges and slides.

    Attributes:
        factors: columns of the gears.
        into: columns to which is added.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, columns: dict[str, np.ndarray]) -> None:
        written = {(t.field, t.index) for _, t in space.targets}
        found = []
        for i in range(model.nactuator):
            joint = model.actuator_trnid[i, 0]
            if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT or model.jnt_type[joint] < _SLIDE:
                continue
            for field, dofs in ADDED.items():
                own = np.atleast_1d(read_field(model, field)[i])
                for k in np.flatnonzero([x != 0 or (field, i * len(own) + k) in written for k, x in enumerate(own)]):
                    place = model.jnt_dofadr[joint] * len(own) + k
                    found.append(
                        (columns[field][i * len(own) + k], columns["actuator_gear"][6 * i], columns[dofs][place])
                    )
        self._from, self.factors, self.into = torch.tensor(found, dtype=torch.long).reshape(-1, 3).T

    def __call__(self, raw: torch.Tensor) -> torch.Tensor:
        """Return the model's own numbers ``(K, n)`` with what is added."""
        return raw.index_add(1, self.into, raw[:, self._from] * raw[:, self.factors] ** 2) if len(self.into) else raw


class _Mixing:
    """Contact parameters of geom pairs."""

    def __init__(self, model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> None:
        table = torch.tensor(pairs, dtype=torch.long).reshape(-1, 3)
        self.g1, self.g2, self.pair = table.T
        self.weight = torch.from_numpy(mixing(model, table[:, :2].numpy()))[:, None]
        priority = torch.from_numpy(model.geom_priority)
        self.rank = (priority[self.g1] - priority[self.g2])[:, None]

    def __call__(self, section: Section) -> torch.Tensor:
        """Return friction, solref, solreffriction, solimp and margin of the pairs, ``(K, 15 n)``."""
        # the geoms' numbers come first, then those same five as they are given for explicit pairs
        friction, solref, solimp, margin, *given = map(section, MIXED)
        f1, f2 = friction[:, self.g1], friction[:, self.g2]
        mu = torch.maximum(f1, f2)
        mu = torch.where(self.rank > 0, f1, torch.where(self.rank < 0, f2, mu))
        mu = mu[..., [0, 0, 1, 2, 2]]
        r1, r2 = solref[:, self.g1], solref[:, self.g2]
        blend = self.weight * r1 + (1 - self.weight) * r2
        standard = ((r1[..., :1] > 0) & (r2[..., :1] > 0)) | (self.rank != 0)
        ref = torch.where(standard, blend, torch.minimum(r1, r2))
        imp = self.weight * solimp[:, self.g1] + (1 - self.weight) * solimp[:, self.g2]
        parts = [mu, ref, torch.zeros_like(ref), imp, margin[:, self.g1] + margin[:, self.g2]]
        own = (self.pair >= 0)[:, None]
        if own.any():
            parts = [torch.where(own, g[:, self.pair], part) for g, part in zip(given, parts, strict=True)]
        parts[0] = parts[0].clamp(min=_MINMU)
        return torch.cat([p.flatten(1) for p in parts], dim=1)


def _principal_axes(section: Section) -> torch.Tensor:
    """Rotations of the inertial frames of bodies, ``(K, 9 nbody)``."""
    return matrices(unit(section(INERTIAL))).flatten(1)


class _Anchors:
    """What ``mj_setConst`` makes of a connect's data: the anchor in the second body, from that in the first.

    Attributes:
        derived: columns of θ that then depend on others.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, columns: np.ndarray) -> None:
        written = {t.index // mujoco.mjNEQDATA for p in space.parameters for t in p.targets if t.field == "eq_data"}
        self._maps, self.derived = [], np.array([], dtype=int)
        if not written:
            return
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        bodies = model.eq_objtype == int(mujoco.mjtObj.mjOBJ_BODY)
        for i in sorted(written):
            if bodies[i] and model.eq_type[i] == int(mujoco.mjtEq.mjEQ_CONNECT):
                own = torch.from_numpy(columns.reshape(model.neq, -1)[i]).long()
                b1, b2 = model.eq_obj1id[i], model.eq_obj2id[i]
                r1, r2 = (data.xmat[b].reshape(3, 3) for b in (b1, b2))
                offset = r2.T @ (data.xpos[b1] - data.xpos[b2])
                self._maps.append((own, torch.from_numpy(r2.T @ r1), torch.from_numpy(offset)))
        self.derived = np.array([c for own, _r, _o in self._maps for c in own[3:6].tolist()], dtype=int)

    def __call__(self, raw: torch.Tensor) -> torch.Tensor:
        """Return the model's numbers with what follows from others in its place."""
        for own, turn, offset in self._maps:
            raw = raw.index_copy(1, own[3:6], raw[:, own[:3]] @ turn.T + offset)
        return raw


class _Weights:
    """``body_invweight0`` and ``dof_invweight0`` as functions of the inertial parameters and of frames.

    ``posed`` says that frames of bodies or joints vary.
    """

    def __init__(self, model: mujoco.MjModel, pairs: list[tuple[int, int, int]], *, posed: bool) -> None:
        model, data = copy.copy(model), mujoco.MjData(model)
        model.body_mass[:], model.body_ipos[:] = 1.0, 0.0  # Jacobians go by centers of mass, and would round by them
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jac = np.zeros((2, model.nbody, 3, model.nv))
        for b in range(1, model.nbody):
            mujoco.mj_jac(model, data, jac[0, b], jac[1, b], data.xpos[b], b)
        self.pose = *torch.from_numpy(jac)[:, None], torch.tensor(data.xmat).reshape(1, -1, 3, 3)
        self.varying = Pose(model) if posed else None
        mujoco.mj_tendon(model, data)
        self.arms = torch.zeros(model.ntendon, model.nv, dtype=torch.float64)
        for k in range(model.ntendon):
            own = slice(model.ten_J_rowadr[k], model.ten_J_rowadr[k] + model.ten_J_rownnz[k])
            self.arms[k].index_add_(0, torch.tensor(model.ten_J_colind[own]).long(), torch.tensor(data.ten_J[own]))
        self.related = torch.from_numpy(_related(model))
        self.moving = torch.tensor([has_dofs(model, b) for b in range(model.nbody)])
        self.simple = torch.tensor((model.body_simple == 2) | slide_alone(model))
        self.dof_body = torch.tensor(model.dof_bodyid, dtype=torch.long)
        self.bodies = torch.tensor([[model.geom_bodyid[g] for g in pair[:2]] for pair in pairs]).long().reshape(-1, 2)
        self.welded = torch.from_numpy(equality_bodies(model, welds(model))).long()
        self.average = torch.eye(model.nv, dtype=torch.float64)
        for start, kind in zip(model.jnt_dofadr, model.jnt_type, strict=True):
            for g in range(start, start + {0: 6, 1: 3}.get(int(kind), 0), 3):  # of a free or a ball joint
                self.average[g : g + 3, g : g + 3] = 1 / 3

    def __call__(self, section: Section) -> torch.Tensor:
        """Return the weights of pairs, dofs, welds and tendons, ``(K, n + nv + 2 w + t)``.

        A pair's is the sum of its two bodies' for translations, a weld has that and the one for rotations.
        """
        mass, armature, inertia = section("mass")[..., 0], section("armature")[..., 0], section("inertia")
        linear, angular, rotation = self.varying(section) if self.varying else self.pose
        principal = rotation @ matrices(unit(section(INERTIAL)))
        arm = (rotation @ section("ipos")[..., None]).expand(len(mass), -1, -1, angular.shape[-1])
        angular = angular.expand_as(arm)
        linear = linear + torch.linalg.cross(angular, arm, dim=2)
        local = (principal.transpose(2, 3) @ angular).expand_as(arm)
        matrix = torch.einsum("kb,kbij,kbil->kjl", mass, linear, linear)
        matrix = matrix + torch.einsum("kbi,kbij,kbil->kjl", inertia, local, local) + torch.diag_embed(armature)
        if len(self.arms):
            tendons = torch.einsum("kt,ti,tj->kij", section("ten_armature")[..., 0], self.arms, self.arms)
            matrix = matrix + tendons * self.related
        inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix).L)
        body = torch.einsum("kbij,kjl,kbil->kb", linear, inverse, linear) / 3
        light = 1 / mass.clamp(min=_MINVAL)
        simple = self.simple & (section("ipos") == 0).all(-1)
        body = torch.where(self.moving, torch.where(simple, light, body), torch.zeros_like(body))
        turning = torch.einsum("kbij,kjl,kbil->kb", angular, inverse, angular) / 3
        turning = torch.where(self.moving & ~simple, turning, torch.zeros_like(turning))
        dof = torch.diagonal(inverse, dim1=1, dim2=2) @ self.average
        dof = torch.where(simple[:, self.dof_body], light[:, self.dof_body], dof)
        weld = torch.stack([weights[:, self.welded].sum(-1) for weights in (body, turning)], dim=-1)
        tendon = torch.einsum("ti,kij,tj->kt", self.arms, inverse, self.arms)
        return torch.cat([body[:, self.bodies].sum(-1), dof, weld.flatten(1), tendon], dim=1)


def _related(model: mujoco.MjModel) -> np.ndarray:
    """Return 1 for pairs of dofs for which MuJoCo's M has room, ``(nv, nv)``."""
    room = np.zeros((model.nv, model.nv))
    for i, (start, count) in enumerate(zip(model.M_rowadr, model.M_rownnz, strict=True)):
        own = model.M_colind[start : start + count]
        room[i, own] = room[own, i] = 1.0
    return room
