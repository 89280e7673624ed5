"""The paper's experiment with a hockey puck, in simulation: ``dropo reproduce puck``.

Eighteen parameters of five hits of 750 transitions; puck and contact are redrawn for every hit in one of two logs.
"""

from __future__ import annotations

from ..manipulation import Plan, Study
from ..manipulation_tables import About
from . import SIM
from .record import record

STUDY = Study(
    about=About(
        sim=SIM,
        title="The paper's hockey puck, in simulation",
        lead=(
            "Written by dropo reproduce puck. The paper's numbers are of a real arm and puck, whose truth nobody "
            "knows; here arm, hits and logs are this project's, and the truth is known."
        ),
        cases={"point": "one puck", "distribution": "puck redrawn for every hit"},
        published={
            "DROPO": ((0.111, 2.2e-4), (0.349, 3.4e-5), (0.231, 4.7e-4), (0.019, 6.7e-5)),
            "DROID": ((0.100, 1.5e-7), (0.334, 8.9e-6), (0.226, 9.7e-6), (0.019, 1.7e-5)),
        },
    ),
    record=record,
    truth=SIM.truth,
    plan=Plan(
        seeds=3, episodes=5, steps=750, small_episodes=1, horizon=50, droid_budget=400, simulations=300, cma_budget=80
    ),
    reduced=Plan(
        seeds=1, episodes=2, steps=260, samples=40, droid_budget=60, simulations=40, simopt_samples=8,
        simopt_iterations=2, horizon=10, small_episodes=1, small_samples=20, cma_budget=20, adam_steps=10,
    ),
)  # fmt: skip
run_study = STUDY.run
