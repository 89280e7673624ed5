"""What θ consists of: the fields of a model that stand in it, and the numbers that are derived from them."""

from __future__ import annotations

#: Sections of θ that are fields of MjModel: name in the tables, field, columns kept of each row (0: all).
DIRECT = (
    ("gravity", "opt.gravity", 0), ("density", "opt.density", 0), ("viscosity", "opt.viscosity", 0),
    ("wind", "opt.wind", 0), ("mass", "body_mass", 0), ("inertia", "body_inertia", 0), ("ipos", "body_ipos", 0),
    ("gravcomp", "body_gravcomp", 0), ("stiffness", "jnt_stiffness", 0), ("stiffnesspoly", "jnt_stiffnesspoly", 0),
    ("spring", "qpos_spring", 0), ("range", "jnt_range", 0), ("jnt_margin", "jnt_margin", 0),
    ("jnt_solref", "jnt_solref", 0), ("jnt_solimp", "jnt_solimp", 0), ("actfrcrange", "jnt_actfrcrange", 0),
    ("damping", "dof_damping", 0), ("dampingpoly", "dof_dampingpoly", 0), ("armature", "dof_armature", 0),
    ("frictionloss", "dof_frictionloss", 0), ("dof_solref", "dof_solref", 0), ("dof_solimp", "dof_solimp", 0),
    ("gain", "actuator_gainprm", 3), ("bias", "actuator_biasprm", 3), ("gear", "actuator_gear", 0),
    ("forcerange", "actuator_forcerange", 0), ("ctrlrange", "actuator_ctrlrange", 0),
    ("dynprm", "actuator_dynprm", 3), ("actrange", "actuator_actrange", 0), ("eq_data", "eq_data", 0),
    ("eq_solref", "eq_solref", 0), ("eq_solimp", "eq_solimp", 0),
    ("ten_stiffness", "tendon_stiffness", 0), ("ten_stiffnesspoly", "tendon_stiffnesspoly", 0),
    ("ten_damping", "tendon_damping", 0), ("ten_dampingpoly", "tendon_dampingpoly", 0),
    ("ten_armature", "tendon_armature", 0), ("ten_frictionloss", "tendon_frictionloss", 0),
    ("ten_range", "tendon_range", 0), ("ten_margin", "tendon_margin", 0),
    ("ten_lengthspring", "tendon_lengthspring", 0), ("ten_actfrcrange", "tendon_actfrcrange", 0),
    ("ten_solref_lim", "tendon_solref_lim", 0), ("ten_solimp_lim", "tendon_solimp_lim", 0),
    ("ten_solref_fri", "tendon_solref_fri", 0), ("ten_solimp_fri", "tendon_solimp_fri", 0),
)  # fmt: skip
#: Fields from which the contact parameters of a pair are mixed.
MIXED = (
    "geom_friction", "geom_solref", "geom_solimp", "geom_margin", "pair_friction", "pair_solref",
    "pair_solreffriction", "pair_solimp", "pair_margin",
)  # fmt: skip
#: What actuators add to their joints, times the gear's square: field of the actuators → that of the dofs.
ADDED = {
    "actuator_damping": "dof_damping", "actuator_dampingpoly": "dof_dampingpoly", "actuator_armature": "dof_armature",
}  # fmt: skip
#: Frames of the inertias, that no parameter writes: they stand in θ as rotations.
INERTIAL = "body_iquat"
#: Fields of frames, those of bodies, joints and geoms: in θ stand those that vary.
FRAMES = ("body_pos", "body_quat", "jnt_axis", "jnt_pos", "geom_pos", "geom_quat", "geom_size")
#: Numbers of a pair of geoms: what is mixed, and the sum of the two bodies' inverse weights.
PAIR = {"friction": 5, "solref": 2, "solreffriction": 2, "solimp": 5, "margin": 1, "invweight": 1}
#: Fields that θ is made of: those that a parameter may write and the adjoint differentiates.
FIELDS = (*(field for _, field, _ in DIRECT), *MIXED, *FRAMES, *ADDED)
#: All sections of θ, in order.
SECTIONS = (
    *(name for name, _, _ in DIRECT), *(f"pair_{name}" for name in PAIR), "dof_invweight", "weld_invweight",
    "ten_invweight", "imat", "body_frame", "link_frame", "geom_frame",
)  # fmt: skip
