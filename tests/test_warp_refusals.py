"""Everything that Warp does not simulate is refused by name, one thing at a time."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators.warp import WarpSimulator, tables
from dropo_torch.simulators.warp.support import Missing, summary
from dropo_torch.simulators.warp.supported import DOCS, written

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
        ({"option": 'integrator="discrete"'}, "option integrator=discrete"),
        ({"option": 'noslip_iterations="3"'}, "option noslip_iterations"),
        ({"flag": 'diagexact="enable"'}, "flag diagexact enabled"),
        ({"option": 'actuatorgroupdisable="0"'}, "option actuatorgroupdisable"),
        ({"flag": 'override="enable"'}, "flag override enabled"),
        ({"body": 'gravcomp="1"', "second": 'actuatorgravcomp="true" actuatorfrcrange="-1 1"'},
         "actuatorgravcomp within actuatorfrcrange (1: 'k')"),
        ({"actuator": '<general name="g" joint="root" gear="1 0 0 0 0 0" damping="1"/>'},
         "actuator damping or armature of anything but a hinge or a slide (1: 'g')"),
        ({"actuator": '<general name="g" joint="k" gaintype="user"/>'}, "actuator gain user (1: 'g')"),
        (
            {"actuator": '<motor name="g" jointinparent="root"/>'},
            "actuator of a free or ball joint with its transmission in the parent's frame (1: 'g')",
        ),
        ({"world": '<site name="s"/><site name="t" pos="1 1 1"/><geom name="w" pos=".5 .5 .5" size=".1"/>',
          "extra": '<tendon><spatial name="t" stiffness="1"><site site="s"/><geom geom="w"/><site site="t"/></spatial>'
                   "</tendon>"}, "tendon that wraps around a geom (1: 't')"),
        ({"world": '<site name="s"/><site name="t" pos="1 1 1"/>',
          "extra": '<tendon><spatial name="t" armature="1"><site site="s"/><site site="t"/></spatial></tendon>'},
         "armature of a spatial tendon (1: 't')"),
        ({"option": 'integrator="implicitfast"',
          "extra": '<tendon><fixed name="t" actuatorfrcrange="-1 1"><joint joint="j" coef="1"/></fixed></tendon>'
                   '<actuator><motor name="g" tendon="t"/></actuator>'},
         "actuatorfrcrange of a tendon under implicit or implicitfast (1: 't')"),
        ({"world": '<site name="w"/><body pos="9 0 0"><joint/><geom size=".1"/><site name="s"/></body>',
          "actuator": '<motor name="g" site="s" refsite="w"/>'}, "actuator at a site with a reference site (1: 'g')"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_a_part_that_warp_lacks_is_named(parts: dict[str, str], words: str) -> None:
    assert words in refused(**parts)


@pytest.mark.parametrize(
    ("parameter", "parts", "words"),
    [
        ({"field": "actuator_gainprm", "name": "m", "index": 4}, {}, "effects of actuator_gainprm[4], only of"),
        ({"field": "eq_data", "name": "e", "index": 6},
         {"extra": '<equality><joint name="e" joint1="j" joint2="k"/></equality>'}, "effects of eq_data[6], only of"),
        ({"field": "eq_data", "name": "e", "index": 8},
         {"extra": '<equality><connect name="e" body1="a" body2="b" anchor="0 0 0"/></equality>'},
         "effects of eq_data[8], only of eq_data[0], eq_data[1], eq_data[2]"),
        ({"field": "qpos_spring", "name": "root", "index": 4}, {}, "gradients of qpos_spring of a quaternion"),
        ({"field": "geom_size", "name": "a", "index": 1}, {}, "gradients of geom_size[1] of a sphere"),
        ({"field": "body_iquat", "name": "a", "index": 1}, {}, "gradients of body_iquat"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_a_parameter_without_effect_there_is_named(parameter: dict, parts: dict[str, str], words: str) -> None:
    found = refused({**parameter, "bounds": [0.1, 1.0]}, **parts)
    assert words in found
    assert "(1: parameter 'p')" in found


def test_what_is_missing_often_is_counted_and_said_once() -> None:
    names = [f"g{i}" for i in range(5)]
    some = "".join(f'<general name="{n}" joint="k" gaintype="user" dyntype="user"/>' for n in names)
    message = refused(actuator=some)
    assert "actuator gain user (5: 'g0', 'g1', 'g2', ...)" in message
    assert message.count("gain user") == 1
    assert "'g3'" not in message


def test_three_are_named_without_dots() -> None:
    assert summary([Missing("x", "'a'"), Missing("y"), Missing("x", "'b'"), Missing("x", "'c'")]) == (
        "x (3: 'a', 'b', 'c'); y"
    )


def test_more_contacts_than_there_is_memory_for_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "MOST_CONTACTS", 5)
    boxes = "".join(
        f'<body name="{name}" pos="{x} 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
        for name, x in (("a", 0), ("b", 3))
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="5 5 1"/>{boxes}</worldbody></mujoco>'
    )
    simulator = WarpSimulator(model, parameters=ParameterSpace(model, {"p": MASS}), frame_skip=1)
    both = torch.from_numpy(np.r_[model.qpos0, np.zeros(model.nv)])[None]
    one = both.clone()
    one[0, 9] += 1.0  # the other box is in the air
    control, values = torch.zeros(1, 1, 0, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    assert simulator.simulate(one, control, values).isfinite().all()
    with pytest.raises(InputError, match="more than 5 contacts in one simulation"):
        simulator.simulate(both, control, values)


def test_the_documentation_lists_what_the_code_takes() -> None:
    text = DOCS.read_text()
    assert written(text) == text, "run python -m dropo_torch.simulators.warp.supported"
