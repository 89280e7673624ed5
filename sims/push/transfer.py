"""The box from a raw log to policies in the target: ``python examples/transfer_manipulation.py push``."""

from __future__ import annotations

from ..transfer import METHODS, Plan, Robot, arm_effects
from . import SIM
from .target import ARM, TRUTH, distances, make_target, record_runs

ROBOT = Robot(
    sim=SIM,
    make_target=make_target,
    record=record_runs,
    distances=distances,
    start=0.06,
    own={"effects": arm_effects(ARM, "drive"), "distribution": TRUTH},  # friction as in fast motion: no effect has both
    title="From a model to a target that it does not describe: the box",
    lead=(
        "Written by examples/transfer_manipulation.py push. No robot stands here: the target is a second simulation "
        "with finer steps, a table whose friction falls with speed, friction and delay in the arm, and noise and "
        "latency of what is measured, outside the library."
    ),
    plan=Plan(
        seeds=3, methods=METHODS, boxes=10, runs=16, train={"steps": 2_000_000, "num_envs": 128, "horizon": 64},
    ),
    reduced=Plan(
        seeds=1, methods=("own", "dropo", "udr", "plain"), boxes=1, runs=6, gap_seconds=20, samples=20,
        train={"steps": 4096, "num_envs": 16, "horizon": 64, "evaluations": 2, "episodes": 4},
    ),
)  # fmt: skip
