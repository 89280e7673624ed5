"""A model with effects in it as MJCF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from dropo_torch.effects.base import Placed, applied
from dropo_torch.errors import InputError
from dropo_torch.models.constants import derive
from dropo_torch.models.export import read_spec, write_inertials
from dropo_torch.models.load import quiet_mujoco, unsimplify
from dropo_torch.parameters import ParameterSpace
from dropo_torch.support.files import write_atomically

#: MJCF is written with six digits; accelerations may differ by so much of the largest.
TOLERANCE = 1e-4
#: States at which they are compared.
STATES = 21


def write_model(
    source: str | Path, placed: Sequence[Placed], path: str | Path, space: ParameterSpace | None = None,
    values: np.ndarray | None = None,
) -> list[Placed]:  # fmt: skip
    """Write a model with the effects that MJCF can express as a self-contained MJCF file.

    It is read back, and must accelerate as the model in memory does.

    Args:
        source: the model's path.
        placed: effects with values.
        path: where to write.
        space: parameters of the model that are written first, if any.
        values: their values, in units, ``(d,)``.

    Returns:
        The effects that are not in the file, since MJCF cannot express them.

    Raises:
        InputError: a source that is no XML file, or numbers that MuJoCo refuses.
    """
    spec, path = read_spec(source), Path(path)
    unsimplify(spec)
    write_inertials(spec)
    model = spec.compile()
    frames = model.body_sameframe.copy()
    if space is not None and values is not None:
        space.write_into(model, values)
    model = applied(model, [p for p in placed if p.effect.in_mjcf])
    try:
        with quiet_mujoco():
            derive(model)
            spec.copy_back(model)
            _copy_rest(spec, model)
            _simplify(spec, model.body_sameframe == frames)
            text = spec.to_xml()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(f"export: MJCF cannot express these effects: {' '.join(str(error).split())}") from None
    write_atomically(path, text.encode())
    _compare(path, model)
    return [p for p in placed if not p.effect.in_mjcf]


def _copy_rest(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Copy what MuJoCo does not copy back by itself."""
    for geom in spec.geoms:
        geom.priority, geom.condim = int(model.geom_priority[geom.id]), int(model.geom_condim[geom.id])
        geom.fluid_ellipsoid = float(model.geom_fluid[geom.id, 0])
        if geom.fluid_ellipsoid:
            geom.fluid_coefs = model.geom_fluid[geom.id, 1:6]
    for joint in spec.joints:
        if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            joint.limited = int(model.jnt_limited[joint.id])
    for actuator in spec.actuators:
        actuator.biastype = mujoco.mjtBias(int(model.actuator_biastype[actuator.id]))


def _simplify(spec: mujoco.MjSpec, kept: np.ndarray) -> None:
    """Let MuJoCo compile bodies whose frames of inertia are where they were as it does by itself."""
    for body in spec.bodies[1:]:
        body.simple = int(kept[body.id])


def _compare(path: Path, model: mujoco.MjModel) -> None:
    """Raise an :class:`InputError` unless the written model accelerates as the one in memory."""
    try:
        written = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        path.unlink()
        raise InputError(f"export: MuJoCo refuses the model with these effects: {error}") from None
    rng, errors = np.random.default_rng(0), []
    for _ in range(STATES):
        state, velocity = model.qpos0.copy(), rng.normal(0, 1.0, model.nv)
        mujoco.mj_integratePos(model, state, rng.normal(0, 0.3, model.nv), 1.0)
        control = rng.uniform(-1, 1, model.nu)
        ours, theirs = (_moved(m, state, velocity, control) for m in (model, written))
        errors.append(np.abs(ours - theirs).max(initial=0.0) / max(np.abs(ours).max(initial=0.0), 1e-6))
    if not np.median(errors) <= TOLERANCE:  # the median, for a contact may open at the seventh digit
        path.unlink()
        raise InputError(f"export: the written model differs from the one in memory by {np.median(errors):.1g}")


def _moved(model: mujoco.MjModel, state: np.ndarray, velocity: np.ndarray, control: np.ndarray) -> np.ndarray:
    """Mean acceleration of one step, ``(nv,)``."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state, velocity, control
    with quiet_mujoco():
        mujoco.mj_step(model, data)
    return np.asarray((data.qvel - velocity) / model.opt.timestep)
