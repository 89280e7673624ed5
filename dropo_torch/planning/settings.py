"""What limits a planned motion and how it is searched: the config's ``plan``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import pydantic

from dropo_torch.config import explained
from dropo_torch.errors import InputError
from dropo_torch.support.given import check_keys

Positive = Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
Interval = tuple[Finite, Finite]
Count = Annotated[int, pydantic.Field(ge=1)]


class PlanSettings(pydantic.BaseModel):
    """How a motion is planned.

    Attributes:
        velocity: largest speed of all driven joints, or of each by its name.
        acceleration: likewise.
        position: joint → lowest and highest position, in place of the model's range.
        force: largest force of all actuators, or of each by its name, in the joint's unit times gear 1.
        workspace: site or body → intervals of x, y and z in the world that its origin stays in.
        touch: pairs of bodies that may touch, beside those that do at the start or in the log.
        start: joint → position at which the motion starts and ends.
        frequency: lowest and highest frequency of the motion's sines in Hz.
        waves: sines of each joint.
        models: other models, of those that the bounds and the log leave possible, that keep the limits, too.
        evaluations: motions that are tried; by default 15 for each of a motion's numbers, 400 at least.
        population: motions of a generation.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    velocity: Positive | dict[str, Positive] | None = None
    acceleration: Positive | dict[str, Positive] | None = None
    position: dict[str, Interval] = {}
    force: Positive | dict[str, Positive] | None = None
    workspace: dict[str, tuple[Interval, Interval, Interval]] = {}
    touch: tuple[tuple[str, str], ...] = ()
    start: dict[str, Finite] = {}
    frequency: tuple[Positive, Positive] | None = None
    waves: Annotated[int, pydantic.Field(ge=1, le=20)] = 3
    models: Annotated[int, pydantic.Field(ge=0, le=100)] = 4
    evaluations: Count | None = None
    population: Annotated[int, pydantic.Field(ge=4, le=1000)] | None = None

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> PlanSettings:
        intervals = {**{f"position.{k}": v for k, v in self.position.items()}, "frequency": self.frequency}
        intervals |= {f"workspace.{k}": v for k, box in self.workspace.items() for v in box}
        for where, interval in intervals.items():
            if interval is not None and not interval[0] < interval[1]:
                raise ValueError(f"{where} is {list(interval)}; expected the lower end first")
        return self


def plan_settings(given: Mapping[str, Any]) -> PlanSettings:
    """Return the settings of a config's ``plan``.

    Raises:
        InputError: an unknown key, or a value that does not fit.
    """
    check_keys(given, PlanSettings.model_fields, "plan")
    for key, value in given.items():
        if isinstance(value, bool):
            raise InputError(f"plan.{key} is {str(value).lower()}; expected a number")
    try:
        return PlanSettings(**given)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "value_error":
            raise InputError(f"plan.{first['msg'].removeprefix('Value error, ')}") from None
        raise InputError(f"plan.{explained(error, given)}") from None
