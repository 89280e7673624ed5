"""Everything that Warp does not simulate is refused by name, one thing at a time."""

from __future__ import annotations

import mujoco
import pytest

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator

SOUND = """<mujoco><option {option}><flag {flag}/></option><worldbody>
<body name="a"><joint name="j" {joint}/><geom name="a" size=".1" mass="1"/>
<body name="b" pos="1 0 0" {body}><joint name="k" axis="0 1 0" {second}/><geom name="b" size=".1" mass="1" {geom}/>
</body></body>
<body name="free" pos="3 0 0"><freejoint name="root"/><geom name="c" size=".1" mass="1"/></body>{world}</worldbody>
<actuator><motor name="m" joint="j"/>{actuator}</actuator>{extra}</mujoco>"""
PARTS = dict.fromkeys(("option", "flag", "joint", "body", "second", "geom", "world", "actuator", "extra"), "")
MASS = {"field": "body_mass", "name": "a", "bounds": [0.5, 2.0]}


def refused(parameter: dict | None = None, **parts: str) -> str:
    model = mujoco.MjModel.from_xml_string(SOUND.format(**{**PARTS, **parts}))
    with pytest.raises(InputError) as caught:
        WarpSimulator(model, parameters=ParameterSpace(model, {"p": parameter or MASS}), frame_skip=1)
    message = str(caught.value)
    assert message.startswith("backend warp does not simulate: ")
    assert message.endswith(". Use backend mujoco")
    return message


def test_the_sound_model_is_simulated() -> None:
    model = mujoco.MjModel.from_xml_string(SOUND.format(**PARTS))
    WarpSimulator(model, parameters=ParameterSpace(model, {"p": MASS}), frame_skip=1)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"option": 'iterations="3"'}, "option iterations=3"),
        ({"option": 'solver="PGS"'}, "option solver=PGS"),
        ({"option": 'integrator="implicitfast" density="1"'}, "implicitfast with density or viscosity"),
        ({"option": 'integrator="implicitfast"'}, "free body of joint 'root' under implicitfast"),
        ({"option": 'actuatorgroupdisable="0"'}, "option actuatorgroupdisable"),
        ({"flag": 'override="enable"'}, "flag override enabled"),
        ({"geom": 'fluidshape="ellipsoid"'}, "ellipsoid fluid model of geom 'b'"),
        ({"body": 'gravcomp="-1"'}, "negative gravcomp of body 'b'"),
        ({"body": 'gravcomp="1"', "second": 'actuatorgravcomp="true"'}, "actuatorgravcomp on body 'b'"),
        ({"world": '<body name="m" mocap="true"/>'}, "mocap body (1)"),
        ({"actuator": '<general name="g" joint="k" gaintype="user"/>'}, "actuator 'g': gain user"),
        (
            {"actuator": '<motor name="g" jointinparent="root"/>'},
            "actuator 'g': transmission in the parent's frame of a free or ball joint",
        ),
        ({"extra": '<equality><connect name="e" body1="a" body2="b" anchor="0 0 0"/></equality>'},
         "equality 'e': connect"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_a_part_that_warp_lacks_is_named(parts: dict[str, str], words: str) -> None:
    assert words in refused(**parts)


@pytest.mark.parametrize(
    ("parameter", "parts", "words"),
    [
        ({"field": "actuator_gainprm", "name": "m", "index": 4}, {}, "actuator_gainprm[4] does not act, only"),
        ({"field": "eq_data", "name": "e", "index": 6},
         {"extra": '<equality><joint name="e" joint1="j" joint2="k"/></equality>'}, "eq_data[6] does not act, only"),
        ({"field": "qpos_spring", "name": "root", "index": 4}, {}, "qpos_spring of a quaternion has no gradient here"),
        ({"field": "geom_size", "name": "a", "index": 0}, {}, "geom_size has no gradient here"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_a_parameter_without_effect_there_is_named(parameter: dict, parts: dict[str, str], words: str) -> None:
    found = refused({**parameter, "bounds": [0.1, 1.0]}, **parts)
    assert f"parameter 'p': {words}" in found
