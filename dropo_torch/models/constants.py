"""What MuJoCo derives from a model's numbers, as a fresh compilation of them would have it.

Of a body that hangs on nothing and only slides, MuJoCo takes the inverse of its mass for the weight of its contacts,
equality constraints and limits. It marks such bodies when it compiles a model, and their center can then not move. A
model that is compiled so that any center may move has no such marks, and ``mj_setConst`` would derive other weights, a
third of these or two thirds: the functions here put in those of plain MuJoCo.
"""

from __future__ import annotations

import mujoco
import mujoco.batch
import numpy as np

#: Least mass that MuJoCo divides by; an axis' largest component that counts as none.
_MINVAL, _NONE = 1e-15, 1e-14


def slide_alone(model: mujoco.MjModel) -> np.ndarray:
    """Return which bodies MuJoCo compiles as ones that only slide, whether or not it was let, ``(nbody,)`` bool.

    They have no bodies of their own, the world or what is fixed to it for a parent, their center and axes where the
    frame is, and slides along the frame's axes.
    """
    parent = model.body_parentid
    still = (parent[parent] == 0) & (model.body_dofnum[parent] == 0)
    alone = (model.body_sameframe == int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY)) & (model.body_dofnum > 0)
    alone &= (parent == 0) | still
    alone[parent[1:]] = False
    plain = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)) & (np.abs(model.jnt_pos) <= _NONE).all(1)
    plain &= (np.abs(model.jnt_axis) > _NONE).sum(1) == 1
    alone[model.jnt_bodyid[~plain]] = False
    return np.asarray(alone)


def velocity_lead(model: mujoco.MjModel) -> float:
    """Return by how many seconds a simulation's velocities are those of before its positions: half a step, but of RK4.

    All other integrators are semi-implicit: they move positions with the velocities after each step.
    """
    return 0.0 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 0.5 * float(model.opt.timestep)


def derive(model: mujoco.MjModel, data: mujoco.MjData | None = None) -> None:
    """Compute everything that follows from a model's numbers, in place.

    Args:
        model: the model.
        data: data of it, which are overwritten.

    Raises:
        mujoco.FatalError: numbers that MuJoCo refuses.
    """
    mujoco.mj_setConst(model, mujoco.MjData(model) if data is None else data)
    put_weights(model)


def put_weights(model: mujoco.MjModel) -> None:
    """Give the bodies that only slide the weights of plain MuJoCo, in place."""
    bodies, dofs = _of(model)
    light = 1 / np.maximum(model.body_mass, _MINVAL)
    model.body_invweight0[bodies] = np.stack([light[bodies], np.zeros(len(bodies))], axis=1)
    model.dof_invweight0[dofs] = light[model.dof_bodyid[dofs]]


def derive_all(batch: mujoco.batch.Batch, model: mujoco.MjModel, ids: np.ndarray | None = None) -> None:
    """Compute what follows from the numbers of simulations in a batch.

    Args:
        batch: the simulations.
        model: theirs, in which frames that move are marked so.
        ids: the simulations that are meant, ``(k,)``; all by default.

    Raises:
        mujoco.batch.SimulationError: simulations with numbers that MuJoCo refuses; the others have theirs.
    """
    try:
        if ids is None:
            batch.set_const()
        else:
            batch.set_const(ids.astype(np.int32))
    finally:
        bodies, dofs = _of(model)
        if bodies.size:
            rows = np.arange(batch.nsim)[:, None] if ids is None else ids[:, None]
            own = batch.expanded("body_mass")
            light = 1 / np.maximum(model.body_mass[None] if own is None else own[rows[:, 0]], _MINVAL)
            weights = batch.expand("body_invweight0").reshape(batch.nsim, -1, 2)
            weights[rows, bodies, 0], weights[rows, bodies, 1] = light[:, bodies], 0.0
            batch.expand("dof_invweight0").reshape(batch.nsim, -1)[rows, dofs] = light[:, model.dof_bodyid[dofs]]


def _of(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """The bodies that only slide, and their degrees of freedom."""
    alone = slide_alone(model)
    return np.flatnonzero(alone), np.flatnonzero(alone[model.dof_bodyid])
