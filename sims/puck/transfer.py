"""The puck from a raw log to policies in the target: ``python examples/transfer_manipulation.py puck``."""

from __future__ import annotations

from ..transfer import METHODS, Plan, Robot, arm_effects
from . import SIM
from .target import ARM, TILT, TRUTH, distances, make_target, record_runs

#: What the model lacks of the target, as far as effects can say it: all but the finer step.
_EFFECTS = [{"effect": "gravity_tilt", "roll": -TILT[0], "pitch": -TILT[1]}, *arm_effects(ARM, "servo")]
#: SAC learns this bandit from a third of the hits that single-step PPO needs.
_LEARNING = {"num_envs": 32, "warmup": 512, "updates_per_step": 1.0, "learning_rate": 1e-3, "hidden": [64, 64]}

ROBOT = Robot(
    sim=SIM,
    make_target=make_target,
    record=record_runs,
    distances=distances,
    start=1.2,  # of 3 s: the stick is on its way to the puck
    own={"effects": _EFFECTS, "distribution": TRUTH},
    title="From a model to a target that it does not describe: the puck",
    lead=(
        "Written by examples/transfer_manipulation.py puck. No robot stands here: the target is a second simulation "
        "with finer steps, a board that is not level, friction and delay in the arm, and noise, outside the library."
    ),
    plan=Plan(
        seeds=3, methods=METHODS, boxes=10, runs=8, gap_seconds=1800, algorithm="sac",
        train={**_LEARNING, "steps": 2016, "evaluations": 9, "episodes": 16},
    ),
    reduced=Plan(
        seeds=1, methods=("own", "dropo", "udr", "plain"), boxes=1, runs=6, gap_seconds=30, samples=20, algorithm="sac",
        train={**_LEARNING, "steps": 96, "warmup": 32, "minibatch": 16, "evaluations": 2, "episodes": 4},
    ),
)  # fmt: skip
