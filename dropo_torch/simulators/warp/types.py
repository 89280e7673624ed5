"""Warp types that every kernel of the backend shares: float64 vectors, the tables of a model, the memory of a world.

A model is two things: integer tables and fixed geometry (:data:`Tables`, shared by all worlds), and one flat
vector θ of real parameters per world, whose sections start at the ``o_...`` offsets in the tables. What a thread
works on is a :data:`World`. Their fields are listed here once: the structs and the memory are made from these lists.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from typing import Any

import mujoco
import warp as wp

from dropo_torch.simulators.warp.layout import SECTIONS

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # no banner and no notice of each module

f64 = wp.float64
vec2 = wp.vec2d
vec3 = wp.vec3d
vec4 = wp.vec4d
vec3i = wp.vec3i
mat33 = wp.mat33d
mat66 = wp.types.matrix((6, 6), wp.float64)
vec5 = wp.types.vector(5, wp.float64)
#: Spatial vectors (motions and forces): angular part first, about the world's origin of the sweep.
vec6 = wp.types.vector(6, wp.float64)
#: Spatial inertia about the origin: m, h = m·c, then Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the origin.
vec10 = wp.types.vector(10, wp.float64)

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))
THREE = wp.constant(wp.float64(3.0))
MINVAL = wp.constant(wp.float64(1.0e-15))  # mjMINVAL
EQ_WIDTH = wp.constant(mujoco.mjNEQDATA)  # numbers of an equality in eq_data

#: Kinds of link: a joint, or one of the two halves of a free joint.
HINGE = wp.constant(0)
SLIDE = wp.constant(1)
TRANSLATION = wp.constant(2)
BALL = wp.constant(3)

#: Integrators.
EULER = wp.constant(0)
RK4 = wp.constant(1)
IMPLICITFAST = wp.constant(2)

#: Dynamics of an activation.
INTEGRATOR = wp.constant(1)
FILTER = wp.constant(2)
FILTEREXACT = wp.constant(3)
MUSCLE = wp.constant(4)

Ints: Any = wp.array(dtype=wp.int32)
Ints2: Any = wp.array2d(dtype=wp.int32)
Reals: Any = wp.array(dtype=wp.float64)
Reals2: Any = wp.array2d(dtype=wp.float64)
Vec3s: Any = wp.array(dtype=vec3)
Vec3s2: Any = wp.array2d(dtype=vec3)
Vec6s2: Any = wp.array2d(dtype=vec6)
Mats: Any = wp.array(dtype=mat33)


def _struct(name: str, fields: dict[str, Any]) -> Any:
    """The Warp struct with these fields."""
    return wp.struct(type(name, (), {"__module__": __name__, "__annotations__": fields}))


def fill(struct: Any, fields: dict[str, Any]) -> Any:
    """A Warp struct with fields set."""
    for name, value in fields.items():
        setattr(struct, name, value)
    return struct


#: Numbers of things, switches of what a model has, and what gradients are wanted of.
_COUNTS = (
    "nb", "nv", "nq", "nu", "na", "nlink", "npair", "ntouching", "nfriction", "nlimit", "neq", "nweld", "nten",
    "nteneq", "norigin", "nh", "maxcon", "maxrow", "integrator", "nstage", "elliptic", "refsafe",
    "implicit", "implicit_actuators", "implicit_fluid", "symmetric_fluid", "has_turning", "full", "has_thrust",
    "has_ball", "has_spring", "has_damper", "has_gravcomp", "has_fluid", "has_frclimit", "always_dense", "quad_dense",
    "want_inertial", "want_inertia", "want_ipos", "want_soft", "want_frames", "want_geoms",
    "ccd_iterations", "nclip_normal",
)  # fmt: skip
#: Of bodies, links (the joints, a free joint as two), dofs, actuators, scalar constraints and pairs of geoms.
_INDICES = (
    "body_parent", "body_link", "body_nlink", "body_dof", "body_ndof", "body_lastdof", "body_massive", "body_pose",
    "link_kind", "link_body", "link_dof", "link_ndof", "link_qpos", "link_jnt", "link_frclimited", "origin_qpos",
    "dof_body", "dof_ndof", "dof_alone",
    "act_dof", "act_ndof", "act_tendon", "act_body", "act_qpos", "act_affine_gain", "act_affine_bias",
    "act_ctrllimited", "act_frclimited", "act_state", "act_dyn", "act_early", "act_statelimited", "state_act",
    "friction_dof", "limit_link", "eq_id", "eq_dof", "eq_qpos",
    "weld_id", "weld_body", "weld_turns", "weld_sites", "weld_dense",
    "ten_spatial", "ten_start", "ten_dof", "ten_qpos", "ten_column", "ten_segment", "seg_body",
    "ten_sprung", "ten_damped", "ten_frictional", "ten_limited", "ten_frclimited", "teneq_id", "teneq_tendon",
    "pair_kind", "pair_points", "pair_body1", "pair_body2", "pair_geom1", "pair_geom2", "pair_dim", "pair_dense",
    "pair_most", "pair_dofadr", "pair_dof", "pair_sign",
    "geom_body", "geom_kind", "touching",
    "geom_hull", "geom_nhull", "geom_climbs", "hull_id", "hull_edgeadr", "hull_edge", "hull_polyadr", "hull_poly",
    "poly_adr", "poly_num", "poly_vert",
    "body_fluid", "body_nfluid", "fluid_geom", "body_turning",
    "body_frame", "link_frame", "geom_frame",
)  # fmt: skip
_VECTORS = (
    "body_pos", "link_axis", "link_pos", "origin_axis", "geom_pos", "geom_size", "geom_mid", "geom_half", "hull_vert",
    "poly_normal", "weld_pos", "seg_pos", "act_pos", "fluid_size", "fluid_drag", "fluid_lift", "fluid_mass",
    "fluid_inertia",
)  # fmt: skip
_ROTATIONS = ("body_mat", "geom_mat", "weld_mat", "act_mat")

#: Structure of a model: sizes, trees, joints, actuators, constraint and contact candidates, offsets in θ.
Tables: Any = _struct(
    "Tables",
    {
        **dict.fromkeys((*_COUNTS, *(f"o_{name}" for name in SECTIONS)), wp.int32),
        **dict.fromkeys(_INDICES, Ints),
        **dict.fromkeys(_VECTORS, Vec3s),
        **dict.fromkeys(_ROTATIONS, Mats),
        "dof_parent": Ints2,  # row 0 the parent in the tree, row 1 the previous dof (dense elimination)
        "origin_base": vec3,  # of the sweep; the origin travels along origin_axis with the root's translations
        **dict.fromkeys(("link_ref", "eq_ref", "pair_bound", "pair_gap", "ten_coef", "seg_scale", "ten_ref"), Reals),
        **dict.fromkeys(("h", "impratio", "ccd_tolerance"), wp.float64),
    },
)

#: One :data:`Tables` in memory of the device, which all threads read in place.
OneTables: Any = wp.array(dtype=Tables)

#: Memory of a trajectory, one row per stage of a step: name → (type, numbers in a row).
TRAJECTORY: dict[str, tuple[Any, str]] = {
    "qpos": (f64, "qpos"), "qvel": (f64, "dof"), "acc": (f64, "dof"),
    "act": (f64, "activation"),
    "rate": (f64, "dof"),  # RK4: rate of the position in the chart at the start of the step
    "hess": (f64, "triangle"),  # factor of H
}  # fmt: skip
#: What the implicit integrators add: a', and the factor of M + h B.
IMPLICIT: dict[str, tuple[Any, str]] = {"soft": (f64, "dof"), "soft_hess": (f64, "soft")}
#: Working memory, one row per slot; a slot serves one world at a time.
SCRATCH: dict[str, tuple[Any, str]] = {
    "xpos": (vec3, "body"), "xmat": (mat33, "body"),
    "motion": (vec6, "dof"),  # s: motion axis of each dof
    "velocity": (vec6, "body"),  # V
    "bias": (vec6, "body"),  # A with zero joint acceleration, gravity in the root
    "inertia": (vec10, "body"), "composite": (vec10, "body"),  # I of each body, and of each subtree
    "force": (vec6, "body"),  # F: inertial force, then summed over the subtree
    "mass": (f64, "triangle"),  # M, packed lower triangle
    "quad": (f64, "triangle"),  # M and what always acts with a quadratic cost
    "weld_jac": (vec6, "dof"),
    "load": (f64, "dof"),  # c − τ, less Jᵀ D aref of what always acts
    "step": (f64, "dof"),  # Newton direction
    "product": (f64, "dof"),  # quad · a + load
    "work": (f64, "dof"),
    "ten_length": (f64, "tendon"), "ten_rate": (f64, "tendon"),
    # of all actuators Σ gear f, and Σ f, which has a range; in the adjoint their adjoints
    "ten_force": (f64, "tendon"), "ten_sum": (f64, "tendon"),
    "ten_jac": (f64, "arm"),  # moment arms
    # of a full B: operators of subtrees, and slopes of accelerations in each velocity
    "slope": (mat66, "full_body"), "swing": (vec6, "full_dof"),
    # scalar constraint rows
    "row_kind": (wp.int32, "row"), "row_index": (wp.int32, "row"),
    "row_dof": (vec3i, "row"), "row_coef": (vec3, "row"),  # dofs, −1 where unused, and J at them; or tendons
    "row_tendon": (wp.int32, "row"),  # whether J is a combination of tendons'
    "row_x": (f64, "row"),  # position less margin
    "row_aref": (f64, "row"), "row_d": (f64, "row"), "row_loss": (f64, "row"),  # D = 1/R
    "row_jar": (f64, "row"), "row_dir": (f64, "row"),  # J a − aref, J step
    "center": (vec3, "geom"), "near": (wp.int32, "pair"),  # of the geoms that may touch; pairs that are close
    # contacts; the frame has rows n, t1, t2, and what is along J stands along these, then about them
    "con_pair": (wp.int32, "contact"), "con_which": (wp.int32, "contact"), "con_dist": (f64, "contact"),
    "con_point": (vec3, "contact"), "con_frame": (mat33, "contact"), "con_hint": (vec3, "contact"),
    "con_d": (f64, "contact"),  # D of the normal (elliptic) or of every edge (pyramidal)
    "con_aref": (vec6, "contact"), "con_jar": (vec6, "contact"), "con_dir": (vec6, "contact"),
    "con_jac": (vec6, "jacobian"),  # columns of J, (contact, dof of the pair)
    # of contacts of convex geoms: what their adjoints hang on, see clip.py and convex_touch.py
    "con_how": (wp.int32, "convex"), "con_height": (f64, "convex"), "con_planes": (mat33, "convex"),
    "con_corner": (vec3, "convex"), "con_facing": (vec3, "convex"),
    "con_single": (vec3, "convex3"), "con_curve": (vec6, "convex2"),
    # the polytope of EPA
    "epa_state": (wp.int32, "convex_few"), "epa_center": (vec3, "convex_few"),
    "epa_point": (vec3, "epa_vertex"), "epa_one": (vec3, "epa_vertex"), "epa_two": (vec3, "epa_vertex"),
    "epa_vertex1": (wp.int32, "epa_vertex"), "epa_vertex2": (wp.int32, "epa_vertex"),
    "epa_corners": (vec3i, "epa_face"), "epa_beside": (vec3i, "epa_face"), "epa_near": (vec3, "epa_face"),
    "epa_dist": (f64, "epa_face"), "epa_place": (wp.int32, "epa_face"), "epa_list": (wp.int32, "epa_face"),
    "epa_walk": (vec3i, "epa_face"), "epa_edge": (vec3i, "epa_face"),
    # a pair's contacts, and the polygons whose corners they are
    "clip_dist": (f64, "convex_few"), "clip_height": (f64, "convex_few"), "clip_mid": (vec3, "convex_few"),
    "clip_corner": (vec3, "convex_few"), "clip_planes": (mat33, "convex_few"), "clip_how": (wp.int32, "convex_few"),
    "clip_normal": (vec3, "convex_few"), "clip_single": (vec3, "convex_few"), "clip_curve": (vec6, "convex_few"),
    "clip_normal1": (vec3, "clip_normals"), "clip_normal2": (vec3, "clip_normals"),
    "clip_end": (vec3, "clip_normals"),
    "clip_index1": (wp.int32, "clip_normals"), "clip_index2": (wp.int32, "clip_normals"),
    "clip_face1": (vec3, "clip_corners"), "clip_face2": (vec3, "clip_corners"),
    "clip_point": (vec3, "clip_polygon"), "clip_line": (wp.int32, "clip_polygon"),
    "clip_before": (wp.int32, "clip_polygon"),
}  # fmt: skip
#: Working memory of the adjoint.
ADJOINT: dict[str, tuple[Any, str]] = {
    "total": (vec6, "body"), "dual": (vec6, "body"),  # U: Σ s a, Λ: Σ s λ
    "f_velocity": (vec6, "body"), "f_accel": (vec6, "body"), "f_total": (vec6, "body"), "f_dual": (vec6, "body"),
    "f_pose": (vec6, "body"),
    "lam": (f64, "dof"), "qacc": (f64, "dof"), "qd": (f64, "dof"),
    "ten_length_bar": (f64, "tendon"), "ten_jac_bar": (f64, "arm"),
    "tangent": (f64, "dof"),  # adjoint of a stage's position, in the tangent space; of its velocity and acceleration
    "vel_bar": (f64, "dof"), "acc_bar": (f64, "dof"),
    "stage_vel_bar": (f64, "dof"), "stage_acc_bar": (f64, "stage"), "stage_rate_bar": (f64, "stage"),  # of all stages
    "pos_bar": (f64, "dof"), "rate_bar": (f64, "dof"),  # adjoint of the state at the end of a step
    "kept": (f64, "dof"),  # a velocity while another stands in its place
    "pos_bar0": (f64, "dof"),  # and of the position at its start
    # activations: of a stage and its rate, of the state at the end and at the start of a step, of all stages' rates
    "act_bar": (f64, "activation"), "act_rate_bar": (f64, "activation"), "act_end_bar": (f64, "activation"),
    "act_bar0": (f64, "activation"), "stage_act_rate_bar": (f64, "stage_activation"),
    "grad": (f64, "theta"),
}  # fmt: skip

#: What a thread works on: the memory, the world's θ and controls, its slot and the rows of its controls.
World: Any = _struct(
    "World",
    {
        **{name: wp.array2d(dtype=dtype) for name, (dtype, _) in (TRAJECTORY | IMPLICIT | SCRATCH | ADJOINT).items()},
        "held": Ints,  # of a stage: 1 if it has scalar rows, plus 2 if it has contacts
        "full": Ints,  # of a slot: 1 once a world had more contacts than there is memory for
        "th": Reals,
        "ctrl": Reals2,
        "ctrl_bar": Reals2,
        **dict.fromkeys(("t", "rc", "rb"), wp.int32),
        "applied": wp.int32,  # whether the last nv controls are generalized forces
        "wrenched": wp.int32,  # whether wrenches on the bodies stand before them
    },
)

#: Which worlds a launch simulates: ``first + i`` in row ``local + i``, with transition ``world // each``, initial state
#: ``world // start_each`` and parameter vector ``world % nparam``; all stages are kept, or the last two steps of
#: ``period``. ``applied``, ``wrenched``: see the world's.
Chunk: Any = _struct(
    "Chunk",
    dict.fromkeys(
        (
            "first",
            "local",
            "nparam",
            "each",
            "start_each",
            "lag",
            "skip",
            "period",
            "slot",
            "slot_stride",
            "keep",
            "applied",
            "wrenched",
        ),
        wp.int32,
    ),
)
