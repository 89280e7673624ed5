"""The paper's simulated experiment with a pushed box, redone: ``dropo reproduce push``.

Fifty pushes of 30 transitions, the box redrawn for every push.
"""

from __future__ import annotations

from ..manipulation import Plan, Study
from ..manipulation_tables import About
from . import SIM
from .record import record

STUDY = Study(
    about=About(
        sim=SIM,
        title="The paper's pushed box, in simulation",
        lead=(
            "Written by dropo reproduce push. Arm, controller, pushes and logs are this project's: compare with the "
            "paper in kind, not digit by digit."
        ),
        cases={"point": "one box", "distribution": "box redrawn for every push"},
        published={
            "truth": ((0.7, 0.3), (0.8, 0.2), (0.8, 0.2), (0.01, 0.001), (0.01, 0.001)),
            "DROPO": ((0.788, 0.108), (0.603, 0.033), (0.683, 0.18), (0.015, 0.001), (0.009, 0.003)),
            "DROID": ((0.774, 3.1e-11), (0.737, 1.3e-10), (0.716, 1.2e-11), (0.014, 7.6e-11), (0.011, 2.4e-11)),
            "BayesSim": ((0.703, 0.269), (0.894, 0.224), (0.840, 0.257), (-0.011, 0.309), (0.004, 0.234)),
        },
    ),
    record=record,
    truth={"mass": 0.7, "friction_x": 0.8, "friction_y": 0.8, "com_x": 0.01, "com_y": 0.01},
    plan=Plan(seeds=3, episodes=50, steps=30, small_episodes=8),
    reduced=Plan(
        seeds=1, episodes=6, steps=30, samples=40, droid_budget=150, simulations=60, simopt_samples=12,
        simopt_iterations=3, horizon=10, small_episodes=2, small_samples=20, cma_budget=40, adam_steps=20,
    ),
)  # fmt: skip
run_study = STUDY.run
