"""From parameter vectors to θ, differentiably: what MuJoCo derives from a model is derived here in PyTorch.

θ has the model's own numbers, then one set of contact parameters for each pair of geoms (mixed by priority and
``solmix`` as MuJoCo does), then the inverse weights that ``mj_setConst`` computes at ``qpos0``.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from dropo_torch.parameters import ParameterSpace, read_field
from dropo_torch.simulators.warp.layout import DIRECT, MIXED, PAIR, Layout
from dropo_torch.simulators.warp.pairs import mixing

_INERTIAL = frozenset({"body_mass", "body_inertia", "body_ipos", "dof_armature"})
_MINVAL = 1e-15
_MINMU = 1e-5


class Fields:
    """Maps parameter vectors ``(K, d)`` to θ ``(K, P)``.

    Args:
        model: the model, with everything ``mj_setConst`` derives up to date.
        space: the parameters.
        pairs: geoms that may touch, see :func:`candidate_pairs`.
    """

    def __init__(self, model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]]) -> None:
        self.pairs = pairs
        base, sections, columns, start = [], {}, {}, 0
        for name, field, keep in (*DIRECT, *((f, f, 0) for f in MIXED)):
            array, column = _numbers(model, field, keep)
            base.append(array)
            columns[field] = np.where(column >= 0, column + start, -1)
            sections[name] = (start, array.size)
            start += array.size
        self._raw_sections = sections
        self._raw = torch.from_numpy(np.concatenate(base))
        self._direct = sum(sections[name][1] for name, _f, _k in DIRECT)
        self._mixing = _Mixing(model, pairs)
        self._weights = _Weights(model)
        if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY):
            self._raw[:3] = 0.0
        own = {name: sections[name] for name, _f, _k in DIRECT}
        start = self._direct
        for name, width in PAIR.items():
            own[f"pair_{name}"] = (start, width * len(pairs))
            start += width * len(pairs)
        own["dof_invweight"] = (start, model.nv)
        self.layout = Layout(own, start + model.nv)
        self._targets(space, columns)

    def _targets(self, space: ParameterSpace, columns: dict[str, np.ndarray]) -> None:
        """Columns that the parameters write, and those of θ whose gradient is wanted."""
        targets = [(source, target) for source, p in enumerate(space.parameters) for target in p.targets]
        fields = {target.field for _, target in targets}
        self._written = torch.tensor([int(columns[t.field][t.index]) for _, t in targets], dtype=torch.long)
        self._factors = torch.tensor([t.factor for _, t in targets], dtype=torch.float64)
        self._sources = torch.tensor([source for source, _ in targets], dtype=torch.long)
        self._mixes = bool(fields & set(MIXED))
        self._weighs = bool(fields & _INERTIAL)
        derived = [f"pair_{name}" for name in PAIR if name != "invweight"] if self._mixes else []
        derived += ["pair_invweight", "dof_invweight"] if self._weighs else []
        direct = self._written[self._written < self._direct].numpy()
        wanted = np.concatenate([direct, *(self.layout.columns(name) for name in derived)])
        self.wanted = np.unique(wanted).astype(np.int32)
        with torch.no_grad():
            self._constant = self._mix(self._raw[None]), self._weigh(self._raw[None])

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

    def _section(self, raw: torch.Tensor, name: str, width: int) -> torch.Tensor:
        start, size = self._raw_sections[name]
        return raw[:, start : start + size].reshape(len(raw), -1, width)

    def _mix(self, raw: torch.Tensor) -> torch.Tensor:
        widths = (3, 2, 5, 1, 5, 2, 2, 5, 1)
        return self._mixing(*(self._section(raw, n, w) for n, w in zip(MIXED, widths, strict=True)))

    def _weigh(self, raw: torch.Tensor) -> torch.Tensor:
        body, dof = self._weights(
            self._section(raw, "mass", 1)[..., 0], self._section(raw, "inertia", 3), self._section(raw, "ipos", 3),
            self._section(raw, "armature", 1)[..., 0],
        )  # fmt: skip
        pair = body[:, self._mixing.body1] + body[:, self._mixing.body2]
        return torch.cat([pair, dof], dim=1)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Return θ ``(K, P)`` of parameter vectors ``(K, d)``, differentiable."""
        count = len(values)
        raw = self._raw.expand(count, -1)
        raw = raw.index_copy(1, self._written, values[:, self._sources] * self._factors)
        mixed = self._mix(raw) if self._mixes else self._constant[0].expand(count, -1)
        weighed = self._weigh(raw) if self._weighs else self._constant[1].expand(count, -1)
        return torch.cat([raw[:, : self._direct], mixed, weighed], dim=1)


def _numbers(model: mujoco.MjModel, field: str, keep: int) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of a field that are kept, flat, and the place of each of its numbers among them (or −1)."""
    array = np.atleast_1d(read_field(model, field)).astype(np.float64)
    place = np.arange(array.size).reshape(array.shape)
    if keep:
        array = array[:, :keep]
        kept = np.full(place.shape, -1)
        kept[:, :keep] = np.arange(array.size).reshape(array.shape)
        place = kept
    return array.reshape(-1).copy(), place.reshape(-1)


class _Mixing:
    """Contact parameters of geom pairs."""

    def __init__(self, model: mujoco.MjModel, pairs: list[tuple[int, int, int]]) -> None:
        table = np.array(pairs, dtype=np.int64).reshape(-1, 3)
        self.g1, self.g2, pair = (torch.from_numpy(table[:, i].copy()) for i in range(3))
        self.explicit = pair >= 0
        self.pair = pair.clamp(min=0)
        body = torch.from_numpy(model.geom_bodyid.astype(np.int64))
        self.body1, self.body2 = body[self.g1], body[self.g2]
        self.weight = torch.from_numpy(mixing(model, pairs))[:, None]
        priority = torch.from_numpy(model.geom_priority.astype(np.int64))
        self.first, self.second = priority[self.g1] > priority[self.g2], priority[self.g1] < priority[self.g2]

    def __call__(
        self, friction: torch.Tensor, solref: torch.Tensor, solimp: torch.Tensor, margin: torch.Tensor,
        *given: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Return friction, solref, solreffriction, solimp and margin of the pairs, ``(K, 15 n)``.

        The geoms' numbers come first, then those same five as they are ``given`` for explicit pairs.
        """
        f1, f2 = friction[:, self.g1], friction[:, self.g2]
        mu = torch.maximum(f1, f2)
        mu = torch.where(self.first[:, None], f1, torch.where(self.second[:, None], f2, mu))
        mu = mu[..., [0, 0, 1, 2, 2]]
        r1, r2 = solref[:, self.g1], solref[:, self.g2]
        blend = self.weight * r1 + (1 - self.weight) * r2
        standard = ((r1[..., :1] > 0) & (r2[..., :1] > 0)) | (self.first | self.second)[:, None]
        ref = torch.where(standard, blend, torch.minimum(r1, r2))
        imp = self.weight * solimp[:, self.g1] + (1 - self.weight) * solimp[:, self.g2]
        inflation = margin[:, self.g1] + margin[:, self.g2]
        parts = [mu, ref, torch.zeros_like(ref), imp, inflation]
        if self.explicit.any():
            own = self.explicit[:, None]
            parts = [torch.where(own, g[:, self.pair], part) for g, part in zip(given, parts, strict=True)]
        parts[0] = parts[0].clamp(min=_MINMU)
        return torch.cat([p.flatten(1) for p in parts], dim=1)


class _Weights:
    """``body_invweight0`` (translation) and ``dof_invweight0`` as functions of the inertial parameters."""

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        nv, nb = model.nv, model.nbody
        jac = np.zeros((nb, 2, 3, nv))
        for b in range(1, nb):
            mujoco.mj_jac(model, data, jac[b, 0], jac[b, 1], data.xpos[b], b)
        self.linear, self.angular = torch.from_numpy(jac[:, 0].copy()), torch.from_numpy(jac[:, 1].copy())
        self.rotation = torch.from_numpy(data.xmat.reshape(-1, 3, 3).copy())
        self.principal = torch.from_numpy(data.ximat.reshape(-1, 3, 3).copy())
        self.moving = torch.from_numpy(model.body_weldid != 0)
        self.simple = torch.from_numpy(model.body_simple == 2)
        self.dof_simple = self.simple[torch.from_numpy(model.dof_bodyid.astype(np.int64))]
        self.dof_body = torch.from_numpy(model.dof_bodyid.astype(np.int64))
        average = np.eye(nv)
        for j in range(model.njnt):
            start = model.jnt_dofadr[j]
            groups = {0: (start, start + 3), 1: (start,)}.get(int(model.jnt_type[j]), ())
            for g in groups:
                average[g : g + 3, g : g + 3] = 1 / 3
        self.average = torch.from_numpy(average)

    def __call__(
        self, mass: torch.Tensor, inertia: torch.Tensor, ipos: torch.Tensor, armature: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the weights of bodies ``(K, nbody)`` and dofs ``(K, nv)`` of inertial parameters ``(K, ...)``."""
        arm = torch.einsum("bij,kbj->kbi", self.rotation, ipos)
        linear = self.linear + torch.linalg.cross(self.angular.expand(len(arm), -1, -1, -1), arm[..., None], dim=2)
        local = self.principal.transpose(1, 2) @ self.angular
        matrix = torch.einsum("kb,kbij,kbil->kjl", mass, linear, linear)
        matrix = matrix + torch.einsum("kbi,bij,bil->kjl", inertia, local, local) + torch.diag_embed(armature)
        if matrix.shape[-1] == 0:
            return mass.new_zeros(mass.shape), armature
        inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix).L)
        body = torch.einsum("kbij,kjl,kbil->kb", linear, inverse, linear) / 3
        light = 1 / mass.clamp(min=_MINVAL)
        body = torch.where(self.moving, torch.where(self.simple, light, body), torch.zeros_like(body))
        dof = torch.diagonal(inverse, dim1=1, dim2=2) @ self.average
        return body, torch.where(self.dof_simple, light[:, self.dof_body], dof)
