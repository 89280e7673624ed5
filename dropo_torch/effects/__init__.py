"""The physical effects that a model may lack, and how each enters a simulation."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence

from dropo_torch.effects.actuator import (
    ActuatorBacklash,
    ActuatorBias,
    ActuatorDamping,
    ActuatorDeadband,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    ActuatorSaturation,
)
from dropo_torch.effects.base import VOCABULARY, Effect, Placed, Quantity, Setting, Signals, find_effect
from dropo_torch.effects.body import CenterOfMass, ExternalForce, FluidDrag, Inertia, Payload
from dropo_torch.effects.contact import ContactFriction, ContactMargin, ContactStiffness
from dropo_torch.effects.joint import (
    Armature,
    JointCogging,
    JointCoupling,
    JointDamping,
    JointFriction,
    JointLimit,
    JointQuadraticDamping,
    JointStiffness,
    JointStribeck,
)
from dropo_torch.effects.path import SensedPath
from dropo_torch.effects.sensor import SensorBias, SensorDelay, SensorScale
from dropo_torch.effects.world import GravityTilt, GroundSlope, Integration
from dropo_torch.errors import InputError
from dropo_torch.support.usercode import load_callable, user_code

for _effect in (
    JointDamping(), JointQuadraticDamping(), JointFriction(), JointStribeck(), JointStiffness(), JointCogging(),
    Armature(), JointLimit(), JointCoupling(), Payload(), CenterOfMass(), Inertia(), ExternalForce(), FluidDrag(),
    GravityTilt(), GroundSlope(), Integration(), ActuatorGain(), ActuatorBias(), ActuatorDamping(),
    ActuatorDelay(), ActuatorLag(), ActuatorDeadband(), ActuatorBacklash(), ActuatorSaturation(), SensorBias(),
    SensorScale(), SensorDelay(), ContactFriction(), ContactStiffness(), ContactMargin(),
):  # fmt: skip
    VOCABULARY[_effect.name] = _effect


def register(effect: Effect) -> Effect:
    """Add an effect of one's own to the vocabulary; a class that is defined again takes its own place.

    Raises:
        InputError: a name that is taken.
    """
    taken = VOCABULARY.get(effect.name)
    if taken is not None and _source(taken) != _source(effect):
        raise InputError(f"effect: the name {effect.name!r} is taken; choose another")
    VOCABULARY[effect.name] = effect
    return effect


def load_effects(names: Sequence[str], path: Callable[[str], pathlib.Path]) -> None:
    """Add effects of the user's own, classes that a config names as ``file.py:Class`` or ``module:Class``.

    Args:
        names: of the classes.
        path: resolves a path that stands in the config.

    Raises:
        InputError: a missing file or class, one that fails or is no effect, or a name that is taken.
    """
    for name in names:
        maker = load_callable(
            "own_effects", name, path=path, what="class {} that is an Effect", example="file.py:Class of an Effect"
        )
        with user_code("own_effects", name):
            effect = maker()
        if not isinstance(effect, Effect):
            kind = type(effect).__name__
            raise InputError(f"own_effects: {name} makes a {kind}; expected a subclass of dropo_torch.effects.Effect")
        register(effect)


def _source(effect: Effect) -> tuple[str, str]:
    return type(effect).__module__, type(effect).__qualname__


__all__ = [
    "VOCABULARY",
    "Effect",
    "Placed",
    "Quantity",
    "SensedPath",
    "Setting",
    "Signals",
    "find_effect",
    "load_effects",
    "register",
]
