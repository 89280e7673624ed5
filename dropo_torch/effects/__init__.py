"""The physical effects that a model may lack, and how each enters a simulation."""

from __future__ import annotations

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
from dropo_torch.effects.base import Effect, Path, Placed, Quantity, Setting, Signals
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
from dropo_torch.effects.sensor import SensorBias, SensorDelay, SensorScale
from dropo_torch.effects.world import GravityTilt, GroundSlope, Integration
from dropo_torch.errors import InputError, choices

#: Every effect of the package, by name. A user's own joins with :func:`register`.
VOCABULARY: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        JointDamping(), JointQuadraticDamping(), JointFriction(), JointStribeck(), JointStiffness(), JointCogging(),
        Armature(), JointLimit(), JointCoupling(), Payload(), CenterOfMass(), Inertia(), ExternalForce(), FluidDrag(),
        GravityTilt(), GroundSlope(), Integration(), ActuatorGain(), ActuatorBias(), ActuatorDamping(),
        ActuatorDelay(), ActuatorLag(), ActuatorDeadband(), ActuatorBacklash(), ActuatorSaturation(), SensorBias(),
        SensorScale(), SensorDelay(), ContactFriction(), ContactStiffness(), ContactMargin(),
    )
}  # fmt: skip


def register(effect: Effect) -> Effect:
    """Add an effect of one's own to the vocabulary.

    Raises:
        InputError: a name that is taken.
    """
    if effect.name in VOCABULARY:
        raise InputError(f"effect: the name {effect.name!r} is taken; choose another")
    VOCABULARY[effect.name] = effect
    return effect


def find_effect(name: str) -> Effect:
    """Return an effect by its name.

    Raises:
        InputError: an unknown name; the nearest is offered.
    """
    if name not in VOCABULARY:
        raise InputError(f"effect: unknown {name!r}" + choices(name, VOCABULARY))
    return VOCABULARY[name]


__all__ = [
    "VOCABULARY",
    "Effect",
    "Path",
    "Placed",
    "Quantity",
    "Setting",
    "Signals",
    "find_effect",
    "register",
]
