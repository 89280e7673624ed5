"""What of a model this backend simulates, as one strict check: whatever is not listed here is refused by name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from dropo_torch.errors import UnsupportedModel
from dropo_torch.parameters import ParameterSpace, object_names, read_field
from dropo_torch.simulators.warp import collide
from dropo_torch.simulators.warp.couplings import acting_tendons, is_spatial
from dropo_torch.simulators.warp.layout import ADDED, DIRECT, FIELDS, FRAMES
from dropo_torch.simulators.warp.tables import KINDS, joint_dofs, link_table, turning_bodies
from dropo_torch.simulators.warp.types import BALL

#: Fields of which only the first columns act, and how many.
_KEPT = {field: keep for _, field, keep in DIRECT if keep}
#: Dynamics of activations, as numbered in ``types``.
_ACTIVE = ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")
# compared with numpy integers, which do not equal MuJoCo's enumerations from the right
_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
INTEGRATORS = (
    int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST), int(mujoco.mjtIntegrator.mjINT_IMPLICIT),
)  # fmt: skip
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_IMPLICIT = (int(mujoco.mjtIntegrator.mjINT_IMPLICIT), int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST))
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
#: How many sizes of a geom may vary.
_SIZES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2, mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_BOX: 3, mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
}  # fmt: skip
#: Kinds of contacts that give gradients of sizes.
_SIZED = frozenset((
    collide.PLANE_SPHERE, collide.PLANE_CAPSULE, collide.PLANE_BOX, collide.PLANE_CYLINDER, collide.PLANE_ELLIPSOID,
    collide.ROUND, collide.CAPSULE_BOX, collide.SPHERE_CYLINDER,
))  # fmt: skip
_DYNAMICS = tuple(int(getattr(mujoco.mjtDyn, f"mjDYN_{name}")) for name in _ACTIVE)
#: How many constants the dynamics have.
_CONSTANTS = dict(zip(_DYNAMICS, (0, 0, 1, 1, 3), strict=True))
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_COUPLED = (int(mujoco.mjtEq.mjEQ_TENDON),)
_WRAPS = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
_HELD = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


_DISABLE, _ENABLE = mujoco.mjtDisableBit, mujoco.mjtEnableBit
#: Flags that may be disabled, and those that may be enabled.
HARMLESS = int(
    _DISABLE.mjDSBL_CONSTRAINT | _DISABLE.mjDSBL_EQUALITY | _DISABLE.mjDSBL_FRICTIONLOSS | _DISABLE.mjDSBL_LIMIT
    | _DISABLE.mjDSBL_CONTACT | _DISABLE.mjDSBL_SPRING | _DISABLE.mjDSBL_DAMPER | _DISABLE.mjDSBL_GRAVITY
    | _DISABLE.mjDSBL_CLAMPCTRL | _DISABLE.mjDSBL_WARMSTART | _DISABLE.mjDSBL_FILTERPARENT
    | _DISABLE.mjDSBL_ACTUATION | _DISABLE.mjDSBL_REFSAFE | _DISABLE.mjDSBL_SENSOR | _DISABLE.mjDSBL_MIDPHASE
    | _DISABLE.mjDSBL_EULERDAMP | _DISABLE.mjDSBL_AUTORESET | _DISABLE.mjDSBL_NATIVECCD | _DISABLE.mjDSBL_ISLAND
    | _DISABLE.mjDSBL_MULTICCD
)  # fmt: skip
INERT = int(_ENABLE.mjENBL_ENERGY | _ENABLE.mjENBL_FWDINV | _ENABLE.mjENBL_INVDISCRETE | _ENABLE.mjENBL_SLEEP)
#: Names that a refusal gives of those that lack the same.
SHOWN = 3
#: Iterations in which Newton's method converges but for rare states.
ENOUGH = 10


class Missing(NamedTuple):
    """Something that the backend does not simulate, and an element that needs it; an empty name for a whole model."""

    what: str
    where: str = ""


def check_support(model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]]) -> None:
    """Raise one error that names everything in ``model`` and ``space`` that the backend does not simulate.

    Args:
        model: the model.
        space: the parameters that will vary.
        pairs: geoms that may touch, ``(geom1, geom2, pair or -1)``, the smaller geom type first.

    Raises:
        UnsupportedModel: what is missing, how many elements need it, and the first of them.
    """
    found = missing(model, space, pairs)
    if found:
        raise UnsupportedModel(f"backend warp does not simulate: {summary(found)}. Use backend mujoco")


def missing(model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]]) -> list[Missing]:
    """Return everything that the backend lacks for ``model`` and ``space``; see :func:`check_support`."""
    return [
        *_options(model), *_structure(model), *_joints(model), *_tendons(model, space), *_actuators(model, space),
        *_equalities(model), *_contacts(model, space, pairs), *_parameters(model, space),
    ]  # fmt: skip


def summary(found: Iterable[Missing]) -> str:
    """Return what is missing in one line: each thing once, with the number of elements and the first few names."""
    groups: dict[str, list[str]] = {}
    for what, where in found:
        groups.setdefault(what, []).append(where)
    return "; ".join(what + _named(names) for what, names in groups.items())


def remarks(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return how a model that is taken is simulated otherwise than its options say, in sentences."""
    opt, said = model.opt, []
    if opt.solver != mujoco.mjtSolver.mjSOL_NEWTON:
        name = mujoco.mjtSolver(opt.solver).name[6:]
        said.append(f"Constraints are solved to convergence by Newton's method; solver {name} has the same optimum.")
    if opt.iterations < ENOUGH:
        said.append(f"Constraints are solved to convergence, not for {opt.iterations} iterations.")
    if opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP):
        said.append("Bodies do not fall asleep.")
    return tuple(said)


def _named(names: list[str]) -> str:
    """`` (5: 'a', 'b', 'c', ...)``, or nothing for a whole model."""
    if not any(names):
        return ""
    return f" ({len(names)}: {', '.join(names[:SHOWN])}{', ...' if len(names) > SHOWN else ''})"


def _options(model: mujoco.MjModel) -> Iterator[Missing]:
    opt = model.opt
    disable, enable = _DISABLE, _ENABLE
    if opt.integrator not in INTEGRATORS:
        name = mujoco.mjtIntegrator(opt.integrator).name[6:].lower()
        yield Missing(f"option integrator={name} (use implicitfast, implicit, Euler or RK4)")
    if opt.noslip_iterations > 0:
        yield Missing("option noslip_iterations")
    for kind, flags in ((disable, opt.disableflags & ~HARMLESS), (enable, opt.enableflags & ~INERT)):
        for bit in kind.__members__.values():
            if flags & int(bit) and not bit.name.startswith("mjN"):
                yield Missing(f"flag {bit.name[7:].lower()} {'disabled' if kind is disable else 'enabled'}")
    if opt.disableactuator:
        yield Missing("option actuatorgroupdisable")


def _structure(model: mujoco.MjModel) -> Iterator[Missing]:
    counts = {"nplugin": "plugins", "nhistory": "delays or history buffers", "nplastic": "plastic springs"}
    yield from (Missing(what) for number, what in counts.items() if getattr(model, number, 0))
    yield from (
        Missing("flex", repr(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, i) or i)) for i in range(model.nflex)
    )
    if not (model.nu == model.nactuator == model.nout):
        yield Missing("actuators with several controls or outputs")
    flags = {"flg_surfacevel": "surface velocity", "flg_adhesion": "adhesion"}
    yield from (Missing(f"geom {what}") for flag, what in flags.items() if getattr(model, flag, False))
    if model.ngravcomp:
        yield from _compensated(model)


def _compensated(model: mujoco.MjModel) -> Iterator[Missing]:
    """Gravity compensation through actuators where that is more than another name of the force."""
    disable, names = mujoco.mjtDisableBit, object_names(model, "jnt")
    apart = disable.mjDSBL_ACTUATION | disable.mjDSBL_SPRING | disable.mjDSBL_DAMPER
    for j in np.flatnonzero(model.jnt_actgravcomp):
        if model.jnt_actfrclimited[j]:
            yield Missing("actuatorgravcomp within actuatorfrcrange", repr(names[j]))
        elif not model.nactuator or model.opt.disableflags & int(apart):
            yield Missing("actuatorgravcomp without actuators or passive forces", repr(names[j]))


def _joints(model: mujoco.MjModel) -> Iterator[Missing]:
    names = object_names(model, "jnt")
    for j in range(model.njnt):
        kind = model.jnt_type[j]
        if kind in (_FREE, _BALL) and model.jnt_actfrclimited[j]:
            yield Missing("actuatorfrcrange of free or ball joint", repr(names[j]))
    for i in range(model.nv):
        if model.dof_frictionloss[i] < 0:
            yield Missing("negative frictionloss of dof", str(i))


def _actuators(model: mujoco.MjModel, space: ParameterSpace) -> Iterator[Missing]:
    if model.nu != model.nactuator:
        return
    varied = {(t.field, t.index) for p in space.parameters for t in p.targets}
    names = object_names(model, "actuator")
    for i in range(model.nu):
        where = repr(names[i])
        if model.actuator_trntype[i] == _TENDON:
            pass
        elif model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_SITE:
            yield from (Missing(f"actuator at a site with {what}", where) for what in _beyond_thrust(model, i, varied))
        elif model.actuator_trntype[i] not in _TRANSMISSIONS:
            yield Missing(f"actuator transmission {mujoco.mjtTrn(model.actuator_trntype[i]).name[6:].lower()}", where)
        elif model.jnt_type[model.actuator_trnid[i, 0]] in (_FREE, _BALL):
            yield from (
                Missing(f"actuator of a free or ball joint with {what}", where)
                for what in _beyond_moments(model, i, varied)
            )
        if model.actuator_dyntype[i] not in _DYNAMICS:
            yield Missing(f"actuator dynamics {mujoco.mjtDyn(model.actuator_dyntype[i]).name[6:].lower()}", where)
        if model.actuator_actnum[i] > 1:
            yield Missing("actuator with several activations", where)
        if model.actuator_gaintype[i] not in _GAINS:
            yield Missing(f"actuator gain {mujoco.mjtGain(model.actuator_gaintype[i]).name[7:].lower()}", where)
        if model.actuator_biastype[i] not in _BIASES:
            yield Missing(f"actuator bias {mujoco.mjtBias(model.actuator_biastype[i]).name[7:].lower()}", where)
        if any(np.any(read_field(model, field)[i]) for field in ADDED) and not _adds(model, i):
            yield Missing("actuator damping or armature of anything but a hinge or a slide", where)


def _adds(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether damping and armature of an actuator go to a hinge or a slide."""
    on_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    return bool(on_joint and model.jnt_type[model.actuator_trnid[actuator, 0]] >= _SLIDE)


def _beyond_thrust(model: mujoco.MjModel, actuator: int, varied: set[tuple[str, int]]) -> Iterator[str]:
    """What of an actuator at a site is more than a force and a torque by its drive."""
    if model.actuator_trnid[actuator, 1] >= 0:
        yield "a reference site"
    if model.jnt_actfrclimited.any():
        yield "joints of an actuatorfrcrange"
    for field, types in (("actuator_gainprm", model.actuator_gaintype), ("actuator_biasprm", model.actuator_biastype)):
        width = read_field(model, field).shape[1]
        acts = read_field(model, field)[actuator, 2] != 0 or (field, actuator * width + 2) in varied
        if types[actuator] == mujoco.mjtGain.mjGAIN_AFFINE and acts:
            yield "a force by the velocity"


def _beyond_moments(model: mujoco.MjModel, actuator: int, varied: set[tuple[str, int]]) -> Iterator[str]:
    """What of an actuator on a free or ball joint is more than a force by constant moments, its gears."""
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINTINPARENT:
        yield "its transmission in the parent's frame"
    affine = {"actuator_gainprm": model.actuator_gaintype, "actuator_biasprm": model.actuator_biastype}
    kinds = {"actuator_gainprm": mujoco.mjtGain.mjGAIN_AFFINE, "actuator_biasprm": mujoco.mjtBias.mjBIAS_AFFINE}
    ball = model.jnt_type[model.actuator_trnid[actuator, 0]] == _BALL
    implicit = model.opt.integrator in INTEGRATORS[2:]
    for field, types in affine.items():
        if types[actuator] != kinds[field]:
            continue
        own = read_field(model, field)[actuator]
        by_length, by_velocity = (own[k] != 0 or (field, actuator * len(own) + k) in varied for k in (1, 2))
        if ball and by_length:
            yield "a force by the length"
        if implicit and by_velocity:
            yield "a force by the velocity under implicit or implicitfast"


def _tendons(model: mujoco.MjModel, space: ParameterSpace) -> Iterator[Missing]:
    varied = {t.field for p in space.parameters for t in p.targets}
    acts, spatial = acting_tendons(model, varied), is_spatial(model)
    implicit = model.opt.integrator in _IMPLICIT
    medium = model.opt.density or model.opt.viscosity or {"opt.density", "opt.viscosity"} & varied
    full = bool(turning_bodies(model).any() or (implicit and medium))
    for k in np.flatnonzero(acts):
        where = repr(model.tendon(k).name or int(k))
        if full:
            yield Missing("tendon under implicit, or under implicitfast with a lone free body or a medium", where)
        path = slice(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k])
        if np.isin(model.wrap_type[path], _WRAPS).any():
            yield Missing("tendon that wraps around a geom", where)
        if spatial[k] and (model.tendon_armature[k] or "tendon_armature" in varied):
            yield Missing("armature of a spatial tendon", where)
        if model.tendon_actfrclimited[k] and implicit:
            yield Missing("actuatorfrcrange of a tendon under implicit or implicitfast", where)


def _equalities(model: mujoco.MjModel) -> Iterator[Missing]:
    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        name = model.equality(i).name or i
        if model.eq_type[i] in _HELD + _COUPLED:
            continue
        if model.eq_type[i] != mujoco.mjtEq.mjEQ_JOINT:
            yield Missing(f"{mujoco.mjtEq(model.eq_type[i]).name[5:].lower()} equality", repr(name))
            continue
        for j in (model.eq_obj1id[i], model.eq_obj2id[i]):
            if j >= 0 and model.jnt_type[j] in (_FREE, _BALL):
                yield Missing("equality of a free or ball joint", repr(name))


def _contacts(model: mujoco.MjModel, space: ParameterSpace, pairs: list[tuple[int, int, int]]) -> Iterator[Missing]:
    names, sized = object_names(model, "geom"), {t.index // 3 for _, t in space.targets if t.field == "geom_size"}
    native = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    for g1, g2, _pair in pairs:
        kinds = tuple(mujoco.mjtGeom(model.geom_type[g]) for g in (g1, g2))
        if kinds not in KINDS or (KINDS[kinds][0] == collide.CONVEX and not native):
            a, b = (kind.name[7:].lower() for kind in kinds)
            why = " without the flag nativeccd" if kinds in KINDS else ""
            yield Missing(f"contacts of {a} with {b}{why}", f"{names[g1]!r} with {names[g2]!r}")
        elif sized & {g1, g2} and KINDS[kinds][0] not in _SIZED:
            yield Missing("gradients of geom_size in contacts", f"{names[g1]!r} with {names[g2]!r}")


def _parameters(model: mujoco.MjModel, space: ParameterSpace) -> Iterator[Missing]:
    for parameter in space.parameters:
        for field in {t.field for t in parameter.targets}:
            if field not in FIELDS:
                yield Missing(f"gradients of {field}", f"parameter {parameter.name!r}")
        for target in parameter.targets:
            reason = _dead(model, target.field, target.index)
            if reason:
                yield Missing(reason, f"parameter {parameter.name!r}")
                break


def _moored(model: mujoco.MjModel) -> bool:
    """Whether there is something whose constants ``mj_setConst`` takes from where bodies are in ``qpos0``."""
    ties = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    tied = bool((model.eq_active0.astype(bool) & np.isin(model.eq_type, ties)).any())
    return tied or bool((model.wrap_type == int(mujoco.mjtWrap.mjWRAP_SITE)).any())


def _dead(model: mujoco.MjModel, field: str, index: int) -> str:
    """Why the number cannot reach the dynamics here, or an empty string."""
    if field not in FIELDS:
        return ""
    width = max(1, int(np.prod(read_field(model, field).shape[1:], dtype=int)))
    column = index % width
    if column >= _KEPT.get(field, width):
        return f"effects of {field}[{column}], only of " + ", ".join(f"{field}[{i}]" for i in range(_KEPT[field]))
    if field == "eq_data":
        return _dead_data(model, index // width, column)
    if field == "actuator_gear" and model.actuator_trntype[index // width] == _TENDON and column:
        return f"effects of {field}[{column}], only of {field}[0]"
    if field == "actuator_gear" and model.actuator_trntype[index // width] in _TRANSMISSIONS:
        dofs = int(joint_dofs(model)[model.actuator_trnid[index // width, 0]])
        if column >= dofs:
            return f"effects of {field}[{column}], only of " + ", ".join(f"{field}[{i}]" for i in range(dofs))
    if field == "body_gravcomp" and (model.body_gravcomp < 0).any():
        return "gradients of body_gravcomp beside a negative one"
    if field in ADDED and not _adds(model, index // width):
        return f"{field} on anything but a hinge or a slide"
    if field in FRAMES:
        return _fixed(model, field, index // width, column)
    if field in ("actuator_dynprm", "actuator_actrange"):
        actuator = index // width
        if field == "actuator_actrange" and not model.actuator_actlimited[actuator]:
            return f"effects of {field} where activation is not limited"
        if field == "actuator_dynprm" and column >= _CONSTANTS[int(model.actuator_dyntype[actuator])]:
            return f"effects of {field}[{column}] in these dynamics"
    if field == "qpos_spring":
        kinds, _joints, _dofs, starts = link_table(model)
        if ((kinds == BALL) & (starts <= index) & (index < starts + 4)).any():
            return "gradients of qpos_spring of a quaternion"
    return ""


def _dead_data(model: mujoco.MjModel, equality: int, column: int) -> str:
    """Why a number of an equality's data does not act, or an empty string."""
    kind = mujoco.mjtEq(model.eq_type[equality])
    of_sites = model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE)
    acting = {
        mujoco.mjtEq.mjEQ_JOINT: range(5), mujoco.mjtEq.mjEQ_TENDON: range(5),
        mujoco.mjtEq.mjEQ_CONNECT: range(0 if of_sites else 3),
        mujoco.mjtEq.mjEQ_WELD: range(10 if of_sites else 0, 11),
    }.get(kind, range(0))  # fmt: skip
    if column in acting:
        return ""
    return f"effects of eq_data[{column}], only of " + (", ".join(f"eq_data[{i}]" for i in acting) or "none")


def _fixed(model: mujoco.MjModel, field: str, row: int, column: int) -> str:
    """Why a number of a frame does nothing here, or an empty string."""
    kind = field.split("_")[0]
    if kind == "body":
        first = model.body_jntadr[row]
        free = model.body_jntnum[row] and model.jnt_type[first] == _FREE
        if row == 0 or free or model.body_mocapid[row] >= 0:
            return f"effects of {field} of a free or mocap body, or of the world"
        if _moored(model):
            return f"gradients of {field} beside connect and weld equalities, or spatial tendons"
    elif kind == "jnt":
        joint = model.jnt_type[row]
        if joint == _FREE or (joint == _BALL and field == "jnt_axis") or (joint == _SLIDE and field == "jnt_pos"):
            return f"effects of {field} of a {mujoco.mjtJoint(joint).name[6:].lower()} joint"
        if model.body_simple[model.jnt_bodyid[row]]:
            return f"{field} of a body that MuJoCo has compiled as simple"
        if _moored(model):
            return f"gradients of {field} beside connect and weld equalities, or spatial tendons"
    elif model.geom_fluid[row, 0] > 0:
        return f"gradients of {field} of a geom that a medium acts on as an ellipsoid"
    elif field == "geom_size" and column >= _SIZES.get(mujoco.mjtGeom(model.geom_type[row]), 0):
        return f"gradients of {field}[{column}] of a {mujoco.mjtGeom(model.geom_type[row]).name[7:].lower()}"
    return ""
