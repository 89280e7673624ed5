"""Whether what a hypothesis leaves is no missing effect but of the step with which the model is simulated."""

from __future__ import annotations

from dropo_torch.gap.ground import Ground
from dropo_torch.gap.refit import ANEW, Refit, change_of_step, least_beside, refit
from dropo_torch.gap.rules import significant


def is_of_step(ground: Ground, fitted: Refit) -> bool:
    """Return whether all that a hypothesis leaves is of the model's own step: a finer one leaves no more than noise.

    Where a finer step explains most of it with the derivatives of the own one, by numbers and by initial states, but
    not all, it has its own: what a coarse step distorts, such as friction that is larger near rest, is not found by
    the others.
    """
    rules, change = ground.rules, change_of_step(ground.part, fitted)
    if change is not None and significant(least_beside(ground.part, fitted, change), rules):
        return False
    last = ground.resolved(fitted)
    most = last.fit.cost.left_of(fitted.cost) <= 1 - rules.most
    if not significant(last.fit.cost, rules):
        return most or significant(fitted.cost, rules)  # of what is no more than noise, a finer step must leave less
    if not most:
        return False
    again = refit(last.evidence, last.fit.hypothesis, iterations=ANEW, slopes=False)
    return not significant(again.cost, rules)
