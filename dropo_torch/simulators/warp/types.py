"""Warp types that every kernel of the backend shares: float64 vectors, the model tables, the scratch memory.

A model is two things: integer tables and fixed geometry (:class:`Tables`, shared by all worlds), and one flat
vector θ of real parameters per world, whose sections start at the ``o_...`` offsets in the tables.
"""

# mypy: ignore-errors
# kernel code: Warp reads these functions with types of its own

from __future__ import annotations

from typing import Any

import warp as wp

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # no banner and no notice of each module

f64 = wp.float64
vec2 = wp.vec2d
vec3 = wp.vec3d
vec4 = wp.vec4d
mat33 = wp.mat33d
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
#: Squared sine of the angle below which MuJoCo 4 takes two capsules for parallel.
PARALLEL = wp.constant(wp.float64(1.0e-8))

#: Kinds of link: a joint, or one of the two halves of a free joint.
HINGE = wp.constant(0)
SLIDE = wp.constant(1)
TRANSLATION = wp.constant(2)
BALL = wp.constant(3)

#: Kinds of scalar constraint row.
ROW_EQUALITY = wp.constant(0)
ROW_FRICTION = wp.constant(1)
ROW_LIMIT = wp.constant(2)

#: Integrators.
EULER = wp.constant(0)
RK4 = wp.constant(1)
IMPLICITFAST = wp.constant(2)

Ints: Any = wp.array(dtype=wp.int32)
Ints2: Any = wp.array2d(dtype=wp.int32)
Reals: Any = wp.array(dtype=wp.float64)
Reals2: Any = wp.array2d(dtype=wp.float64)
Vec3s: Any = wp.array(dtype=vec3)
Mats: Any = wp.array(dtype=mat33)
Vec3s2: Any = wp.array2d(dtype=vec3)
Mats2: Any = wp.array2d(dtype=mat33)
Vec6s2: Any = wp.array2d(dtype=vec6)
Vec10s2: Any = wp.array2d(dtype=vec10)


@wp.struct
class Tables:
    """Structure of a model: sizes, trees, joints, actuators, constraint and contact candidates, θ offsets."""

    nb: wp.int32
    nv: wp.int32
    nq: wp.int32
    nu: wp.int32
    nlink: wp.int32
    npair: wp.int32
    nfriction: wp.int32
    nlimit: wp.int32
    neq: wp.int32
    norigin: wp.int32
    nh: wp.int32
    integrator: wp.int32
    nstage: wp.int32
    h: wp.float64
    impratio: wp.float64
    elliptic: wp.int32
    refsafe: wp.int32
    clampctrl: wp.int32
    implicit: wp.int32
    implicit_actuators: wp.int32
    has_ball: wp.int32
    has_spring: wp.int32
    has_damper: wp.int32
    always_dense: wp.int32
    has_gravcomp: wp.int32
    has_fluid: wp.int32
    has_frclimit: wp.int32
    want_inertial: wp.int32  # gradients wanted of mass, body_inertia or body_ipos; of the second; of the third
    want_inertia: wp.int32
    want_ipos: wp.int32
    want_soft: wp.int32  # gradients wanted of some solref or solimp
    maxcon: wp.int32
    maxrow: wp.int32
    # bodies
    body_parent: Ints
    body_link: Ints
    body_nlink: Ints
    body_dof: Ints
    body_ndof: Ints
    body_lastdof: Ints
    body_massive: Ints
    body_pos: Vec3s
    body_mat: Mats
    body_imat: Mats
    # links
    link_kind: Ints
    link_body: Ints
    link_dof: Ints
    link_qpos: Ints
    link_axis: Vec3s
    link_pos: Vec3s
    link_ref: Reals
    # origin of the sweep: q indices and world directions of the root's translations
    origin_qpos: Ints
    origin_axis: Vec3s
    origin_base: vec3
    # dofs: row 0 the parent in the tree, row 1 the previous dof (dense elimination)
    dof_parent: Ints2
    dof_body: Ints
    link_jnt: Ints
    link_frclimited: Ints
    # actuators
    act_dof: Ints
    act_qpos: Ints
    act_affine_gain: Ints
    act_affine_bias: Ints
    act_ctrllimited: Ints
    act_frclimited: Ints
    # scalar constraints
    friction_dof: Ints
    limit_link: Ints
    eq_id: Ints
    eq_dof: Ints  # two per equality, the second −1 where there is one joint only
    eq_qpos: Ints
    eq_ref: Reals
    # contact candidates: geom poses in their bodies
    pair_kind: Ints
    pair_body1: Ints
    pair_body2: Ints
    pair_geom1: Ints
    pair_geom2: Ints
    pair_dim: Ints
    pair_dense: Ints
    pair_bound: Reals
    geom_body: Ints
    geom_pos: Vec3s
    geom_mat: Mats
    geom_size: Vec3s
    # offsets of the sections of θ
    o_gravity: wp.int32
    o_density: wp.int32
    o_viscosity: wp.int32
    o_wind: wp.int32
    o_mass: wp.int32
    o_inertia: wp.int32
    o_ipos: wp.int32
    o_gravcomp: wp.int32
    o_stiffness: wp.int32
    o_stiffnesspoly: wp.int32
    o_spring: wp.int32
    o_range: wp.int32
    o_jnt_margin: wp.int32
    o_jnt_solref: wp.int32
    o_jnt_solimp: wp.int32
    o_actfrcrange: wp.int32
    o_damping: wp.int32
    o_dampingpoly: wp.int32
    o_armature: wp.int32
    o_frictionloss: wp.int32
    o_dof_invweight: wp.int32
    o_dof_solref: wp.int32
    o_dof_solimp: wp.int32
    o_gain: wp.int32
    o_bias: wp.int32
    o_gear: wp.int32
    o_forcerange: wp.int32
    o_ctrlrange: wp.int32
    o_eq_data: wp.int32
    o_eq_solref: wp.int32
    o_eq_solimp: wp.int32
    o_pair_friction: wp.int32
    o_pair_solref: wp.int32
    o_pair_solreffriction: wp.int32
    o_pair_solimp: wp.int32
    o_pair_margin: wp.int32
    o_pair_invweight: wp.int32


@wp.struct
class Scratch:
    """Working memory, one row per slot; a slot serves one world at a time."""

    xpos: Vec3s2
    xmat: Mats2
    motion: Vec6s2  # s: motion axis of each dof
    velocity: Vec6s2  # V
    bias: Vec6s2  # A with zero joint acceleration, gravity in the root
    inertia: Vec10s2  # I of each body
    composite: Vec10s2  # I of each subtree
    force: Vec6s2  # F: inertial force, then summed over the subtree
    mass: Reals2  # M, packed lower triangle
    load: Reals2  # c − τ
    step: Reals2  # Newton direction
    product: Reals2  # M·a + c − τ
    # scalar constraint rows
    row_kind: Ints2
    row_index: Ints2
    row_dof: Ints2  # three per row, −1 where unused
    row_coef: Vec3s2  # J at those dofs
    row_x: Reals2  # position less margin
    row_aref: Reals2
    row_d: Reals2  # D = 1/R
    row_loss: Reals2
    row_jar: Reals2  # J a − aref
    row_dir: Reals2  # J step
    # contacts
    con_pair: Ints2
    con_which: Ints2
    con_dist: Reals2
    con_point: Vec3s2
    con_frame: Mats2  # rows n, t1, t2
    con_hint: Vec3s2
    con_d: Reals2  # D of the normal (elliptic) or of every edge (pyramidal)
    con_aref: Vec6s2
    con_jar: Vec6s2  # J a − aref: along n, t1, t2, then about them
    con_dir: Vec6s2  # J step
    con_jac: Vec6s2  # columns of J, (contact, dof)
    # adjoint
    total: Vec6s2  # U: Σ s a
    dual: Vec6s2  # Λ: Σ s λ
    f_velocity: Vec6s2
    f_accel: Vec6s2
    f_total: Vec6s2
    f_dual: Vec6s2
    f_pose: Vec6s2
    lam: Reals2
    qacc: Reals2
    qd: Reals2
    tangent: Reals2  # adjoint of a stage's position, in the tangent space
    vel_bar: Reals2  # adjoint of a stage's velocity
    acc_bar: Reals2  # adjoint of a stage's acceleration
    work: Reals2
    stage_vel_bar: Reals2  # of all stages of a step
    stage_acc_bar: Reals2
    stage_rate_bar: Reals2
    pos_bar: Reals2  # adjoint of the state at the end of a step
    rate_bar: Reals2
    pos_bar0: Reals2  # adjoint of the state at its start
    grad: Reals2  # adjoint of θ of this world


@wp.struct
class Rows:
    """Memory of the trajectories, one row per stage of a step."""

    qpos: Reals2
    qvel: Reals2
    rate: Reals2  # RK4: rate of the position in the chart at the start of the step
    acc: Reals2
    soft: Reals2  # a' of the implicit integrators
    hess: Reals2  # factor of H
    soft_hess: Reals2  # factor of M + h B
    held: Ints  # of a stage: 1 if it has scalar rows, plus 2 if it has contacts
