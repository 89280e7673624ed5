"""A pushed box: five parameters of it and its friction to find, as in the paper's experiments with a Panda arm."""

from pathlib import Path

from dropo_torch.models.bundled import BundledSim

_HERE = Path(__file__).parent

#: The table's frame has its first direction of friction along y, and its second one along x.
SIM = BundledSim(
    name="push",
    model=_HERE / "push.xml",
    frame_skip=10,
    observation=("qpos", "qvel"),
    parameters={
        "mass": {"field": "body_mass", "name": "box", "bounds": [0.08, 2.0], "unit": "kg"},
        "friction_x": {"field": "pair_friction", "name": "table_box", "index": 1, "bounds": [0.2, 2.0]},
        "friction_y": {"field": "pair_friction", "name": "table_box", "index": 0, "bounds": [0.2, 2.0]},
        "com_x": {"field": "body_ipos", "name": "box", "index": 0, "bounds": [-0.032, 0.032], "unit": "m"},
        "com_y": {"field": "body_ipos", "name": "box", "index": 1, "bounds": [-0.032, 0.032], "unit": "m"},
    },
    log=_HERE / "log.npz",
    task="dropo_sims.push.task:PushTask",
    study="dropo_sims.push.study:run_study",
    truth={"mass": 0.7, "friction_x": 0.8, "friction_y": 0.6, "com_x": 0.01, "com_y": -0.012},
)
