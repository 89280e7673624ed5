"""A puck that an arm hits: eighteen parameters of puck, contact and servos, as in the paper's experiments."""

from pathlib import Path

from dropo_torch.models.bundled import BundledSim

_HERE = Path(__file__).parent
_FEET = ["board_foot1", "board_foot2", "board_foot3"]
#: Gains of the model's servos: position, N m/rad, and velocity, N m s/rad.
KP, KD = (2000, 2000, 1500, 1500, 1000, 500, 300), (200, 200, 100, 100, 50, 20, 10)
#: How the recorded arm's gains differ from the model's.
_FACTORS = ((0.9, 1.2, 1.1, 0.8, 1.25, 0.85, 1.15), (1.1, 0.85, 0.9, 1.2, 0.8, 1.15, 0.9))


def _gains(field: str, name: str, values: tuple[int, ...], unit: str) -> dict[str, dict[str, object]]:
    """Parameters for the gains of all servos, from half to twice the model's."""
    return {
        f"{name}{i}": {"field": field, "name": f"servo{i}", "bounds": [0.5 * value, 2.0 * value], "unit": unit}
        for i, value in enumerate(values, 1)
    }


#: The board's frame has its first direction of friction along y, and its second one along x.
SIM = BundledSim(
    name="puck",
    model=_HERE / "puck.xml",
    frame_skip=10,
    observation=("qpos", "qvel"),
    parameters={
        "mass": {"field": "body_mass", "name": "puck", "bounds": [0.08, 0.2], "unit": "kg", "scale_inertia": True},
        "friction_x": {"field": "pair_friction", "name": _FEET, "index": 1, "bounds": [0.2, 0.75]},
        "friction_y": {"field": "pair_friction", "name": _FEET, "index": 0, "bounds": [0.2, 0.75]},
        "contact_time": {
            "field": "pair_solref",
            "name": "stick_side",
            "index": 0,
            "bounds": [0.003, 0.02],
            "unit": "s",
        },
        **_gains("actuator_kp", "kp", KP, "N m/rad"),
        **_gains("actuator_kv", "kd", KD, "N m s/rad"),
    },
    log=_HERE / "log.npz",
    task="dropo_sims.puck.task:PuckTask",
    study="dropo_sims.puck.study:run_study",
    truth={
        "mass": 0.11,
        "friction_x": 0.35,
        "friction_y": 0.28,
        "contact_time": 0.015,
        **{f"kp{i}": round(f * k, 1) for i, (f, k) in enumerate(zip(_FACTORS[0], KP, strict=True), 1)},
        **{f"kd{i}": round(f * k, 1) for i, (f, k) in enumerate(zip(_FACTORS[1], KD, strict=True), 1)},
    },
)
