"""The physical effects that a model may lack, and how each enters a simulation.

A new one is a class in the module of its kind: ``joint``, ``tendon``, ``body``, ``world``, ``actuator``, ``sensor`` or
``contact``.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence

from dropo_torch.effects import actuator, body, contact, elastic, joint, presliding, sensor, tendon, world
from dropo_torch.effects.base import VOCABULARY, Effect, Placed, Quantity, Setting, Signals, find_effect
from dropo_torch.effects.path import SensedPath
from dropo_torch.errors import InputError
from dropo_torch.support.usercode import load_callable, user_code

for _module in (joint, presliding, elastic, tendon, body, world, actuator, sensor, contact):
    for _class in vars(_module).values():  # in the order in which they stand there
        if isinstance(_class, type) and issubclass(_class, Effect) and hasattr(_class, "name"):
            VOCABULARY[_class.name] = _class()


def register(effect: Effect) -> Effect:
    """Add an effect of one's own to the vocabulary; a class that is defined again takes its own place.

    Raises:
        InputError: a class that does not say what it is, or a name that is taken.
    """
    for what, example in (("name", "'slip'"), ("kind", "'joint'"), ("sentence", "'joint {target} slips'")):
        if not isinstance(getattr(effect, what, None), str):
            raise InputError(f"own_effects: {type(effect).__name__} has no {what}; add a line {what} = {example}")
    taken = VOCABULARY.get(effect.name, effect)
    if _source(taken) != _source(effect):
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
