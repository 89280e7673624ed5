"""The Hopper: four link masses to find, as in the paper's simulated experiments."""

from pathlib import Path

from dropo_torch.models.bundled import BundledSim

_HERE = Path(__file__).parent
LINKS = ("torso", "thigh", "leg", "foot")

SIM = BundledSim(
    name="hopper",
    model=_HERE / "hopper.xml",
    frame_skip=4,
    observation=("qpos[1:]", "qvel"),
    parameters={
        f"{link}_mass": {"field": "body_mass", "name": link, "bounds": [0.5, 8.0], "limits": [0.1, 16.0], "unit": "kg"}
        for link in LINKS
    },
    log=_HERE / "log.npz",
    study="dropo_sims.hopper.study:run_study",
    truth={"torso_mass": 3.0, "thigh_mass": 4.7, "leg_mass": 2.4, "foot_mass": 4.9},
    task="dropo_sims.hopper.task:HopperTask",
)
