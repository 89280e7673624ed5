"""A planned motion as a view, from which a video is drawn."""

from __future__ import annotations

import numpy as np

from dropo_torch.planning.plan import Plan
from dropo_torch.view import Candidate, Run, Stretch, Take, View


def view_of(plan: Plan) -> View:
    """Return the motion that is expected of the model at the point, as ghost and as robot."""
    ground = plan.ground
    problem = ground.problem
    candidate = Candidate("expected", problem, ground.values[0])
    stretch = Stretch(0, 0, 0, ground.steps, ground.steps, ground.timestep)
    shown, features = stretch.frames, problem.objective.features
    take = Take("expected", candidate, plan.states[shown], np.zeros((len(shown), features.size)))
    return View(
        run=Run("The motion to record next", (candidate,), None, ground.noise_source, None), stretch=stretch,
        times=stretch.times[shown], logged=plan.states[shown],
        controls=np.append(plan.commands, plan.commands[-1:], axis=0)[shown], takes=(take,), labels=features.labels,
        units=features.units, noise=np.ones(features.size), unseen=(),
    )  # fmt: skip
