from __future__ import annotations

import mujoco
import mujoco.batch
import numpy as np
import pytest
from conftest import ARM_XML, BOX_XML, SLIDE_XML, TENDON_XML, compiled, masses, random_controls, random_states
from conftest import settled_rollout as rollout

from dropo_torch.errors import InputError
from dropo_torch.parameters import ParameterSpace, object_names, read_field

#: Something of every kind that may carry a parameter.
RICH_XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="trunk" type="box" size=".1 .1 .1" mass="2"/>
      <site name="tip" pos=".1 0 0"/>
      <body name="arm" pos=".2 0 0">
        <joint name="swing" type="ball" damping=".3"/>
        <geom name="link" type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass=".5"/>
        <body name="end" pos=".3 0 0">
          <joint name="flex" type="hinge" axis="0 1 0" stiffness="2" damping=".1" armature=".01"/>
          <geom name="tool" type="sphere" size=".04" mass=".2"/>
          <site name="nail" pos=".04 0 0"/>
        </body>
      </body>
    </body>
    <body name="other" pos="1 0 1"><joint name="slide" type="slide"/>
      <geom name="block" type="box" size=".1 .1 .1" mass="1"/></body>
  </worldbody>
  <contact><pair name="touch" geom1="tool" geom2="block"/></contact>
  <equality><connect name="pin" body1="arm" body2="other" anchor="0 0 0"/></equality>
  <tendon><spatial name="rope" stiffness="3"><site site="tip"/><site site="nail"/></spatial></tendon>
  <actuator><position name="bend" joint="flex" kp="4" kv=".2"/><motor name="push" joint="slide"/></actuator>
</mujoco>"""
RICH = compiled(RICH_XML)
CARRIERS = {
    "body": "arm", "geom": "tool", "jnt": "flex", "dof": "flex", "qpos0": "flex", "qpos": "flex", "actuator": "bend",
    "site": "nail", "tendon": "rope", "eq": "pin", "pair": "touch",
}  # fmt: skip
ROW_OF = {"dof": RICH.joint("flex").dofadr[0], "qpos0": RICH.joint("flex").qposadr[0], "qpos": RICH.jnt_qposadr[2]}
DERIVED = (
    "actuator_acc0", "actuator_length0", "body_invweight0", "body_margin", "body_subtreemass", "dof_M0",
    "dof_invweight0", "dof_length", "geom_aabb", "geom_rbound", "tendon_invweight0", "tendon_length0",
)  # fmt: skip
VARIABLE = sorted(
    f
    for f in mujoco.batch.MODEL_FIELDS
    if f.split("_")[0] in CARRIERS and read_field(RICH, f).dtype.kind == "f" and read_field(RICH, f).size
    if f not in DERIVED
)
OPTIONS = sorted(f for f in mujoco.batch.MODEL_FIELDS if f.startswith("opt.") and read_field(RICH, f).dtype.kind == "f")


def space(model: mujoco.MjModel, field: str, name: object = None, bounds: tuple = (1.0, 2.0), **more: object):
    spec = {"field": field, "bounds": list(bounds), **more}
    return ParameterSpace(model, {"p": spec if name is None else {**spec, "name": name}})


def written(a_space: ParameterSpace, value: float) -> dict[str, dict[int, float]]:
    """Which entries of which fields a value changes in per-simulation fields, and to what."""
    fields = {f: np.full((2, *read_field(a_space.model, f).shape), np.nan) for f in a_space.fields}
    a_space.write(fields, np.full((2, len(a_space)), value))
    found = {}
    for field, rows in fields.items():
        flat = rows.reshape(2, -1)
        np.testing.assert_array_equal(flat[0], flat[1])
        found[field] = {int(i): float(flat[0, i]) for i in np.flatnonzero(~np.isnan(flat[0]))}
    return found


def float_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    names = [f for f in mujoco.batch.MODEL_FIELDS if read_field(model, f).dtype.kind == "f"]
    return {f: read_field(model, f) for f in names}


@pytest.mark.parametrize("field", VARIABLE)
def test_any_real_valued_field_of_a_named_object_can_vary_by_component(field):
    prefix = field.split("_")[0]
    array = read_field(RICH, field)
    size = int(np.prod(array.shape[1:], dtype=int))
    row = ROW_OF.get(prefix)
    if row is None:
        row = object_names(RICH, prefix).index(CARRIERS[prefix])
    component = size - 1
    found = written(space(RICH, field, CARRIERS[prefix], index=component), 1.25)
    assert found == {field: {int(row) * size + component: 1.25}}


@pytest.mark.parametrize("field", DERIVED)
def test_a_field_that_mujoco_derives_from_others_is_refused(field):
    prefix = field.split("_")[0]
    size = int(np.prod(read_field(RICH, field).shape[1:], dtype=int))
    with pytest.raises(InputError, match=f"MuJoCo derives {field} from other fields"):
        space(RICH, field, CARRIERS[prefix], index=size - 1)


def test_there_are_fields_of_every_kind_of_object():
    assert {f.split("_")[0] for f in VARIABLE} == set(CARRIERS)


@pytest.mark.parametrize("field", OPTIONS)
def test_any_real_valued_option_can_vary(field):
    size = read_field(RICH, field).size
    found = space(RICH, field, index=size - 1)
    assert written(found, 1.25) == {field: {size - 1: 1.25}}
    assert read_field(found.apply(np.array([1.25])), field).reshape(-1)[size - 1] == 1.25


def test_a_component_stands_in_the_field_or_in_index():
    inline = space(RICH, "geom_pos[2]", "tool")
    assert inline.parameters == space(RICH, "geom_pos", "tool", index=2).parameters
    assert inline.parameters[0].where == "geom_pos[2] of tool"


def test_sliding_friction_and_gear_are_meant_where_no_component_is_given():
    tool = RICH.geom("tool").id
    assert written(space(RICH, "geom_friction", "tool"), 1.5) == {"geom_friction": {3 * tool: 1.5}}
    assert written(space(RICH, "actuator_gear", "push"), 1.5) == {"actuator_gear": {6: 1.5}}


def test_tied_objects_share_one_value():
    names = space(RICH, "body_mass", ["arm", "end"])
    assert written(names, 1.5) == {"body_mass": {RICH.body("arm").id: 1.5, RICH.body("end").id: 1.5}}
    assert names.parameters[0].objects == ("arm", "end")


def test_a_pattern_names_all_objects_that_match():
    model = compiled(ARM_XML)
    found = space(model, "dof_damping", "*l*w*")
    assert found.parameters[0].objects == ("elbow",)
    assert written(space(model, "dof_damping", ["*"]), 1.5) == {"dof_damping": {0: 1.5, 1: 1.5, 2: 1.5}}


def test_two_unnamed_actuators_of_one_joint_are_two_objects():
    model = compiled(
        """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
        <actuator><position joint="j" kp="5"/><velocity joint="j" kv="2"/></actuator></mujoco>"""
    )
    assert object_names(model, "actuator") == ["j", "actuator1"]
    assert space(model, "actuator_kp", "j").nominal == 5
    assert space(model, "actuator_kv", "actuator1").nominal == 2
    assert len(space(model, "actuator_gear", "*").parameters[0].targets) == 2


def test_the_degrees_of_freedom_of_free_and_ball_joints_vary_together_or_one_by_one():
    assert written(space(RICH, "dof_damping", "root"), 1.5)["dof_damping"] == dict.fromkeys(range(6), 1.5)
    assert written(space(RICH, "dof_damping", "swing"), 1.5)["dof_damping"] == dict.fromkeys(range(6, 9), 1.5)
    assert written(space(RICH, "dof_damping", "swing", index=2), 1.5) == {"dof_damping": {8: 1.5}}
    assert written(space(RICH, "dof_damping", "flex"), 1.5) == {"dof_damping": {9: 1.5}}
    with pytest.raises(InputError, match="index 3 is outside dof_damping of this joint, which has 3"):
        space(RICH, "dof_damping", "swing", index=3)


def test_a_relative_parameter_multiplies_the_models_own_values():
    found = space(RICH, "body_mass", ["arm", "end"], bounds=(0.5, 2), relative=True)
    assert found.nominal == 1
    model = found.apply([1.5])
    assert model.body("arm").mass[0] == pytest.approx(0.75, rel=1e-15)
    assert model.body("end").mass[0] == pytest.approx(0.3, rel=1e-15)


def test_a_relative_parameter_of_a_value_that_is_zero_is_refused():
    with pytest.raises(InputError, match="relative, but the model's dof_frictionloss is 0"):
        space(RICH, "dof_frictionloss", "flex", relative=True)


def test_a_multiplier_of_what_cannot_be_negative_cannot_be_negative():
    with pytest.raises(InputError, match="allow a negative"):
        space(RICH, "dof_damping", "flex", bounds=(-1, 2), relative=True)
    assert space(RICH, "dof_damping", "flex", bounds=(0, 2), relative=True).limits[0, 0] == 0


@pytest.mark.parametrize("relative", [False, True])
def test_a_mass_can_take_its_inertia_along(relative):
    value = 1.4 if relative else 1.4 * 0.5
    found = space(RICH, "body_mass", "arm", bounds=(0.3, 2), scale_inertia=True, relative=relative)
    model = found.apply([value])
    assert model.body("arm").mass[0] == pytest.approx(0.7, rel=1e-14)
    np.testing.assert_allclose(model.body("arm").inertia, 1.4 * RICH.body("arm").inertia, rtol=1e-14)
    rescaled = compiled(RICH_XML.replace('fromto="0 0 0 .3 0 0" mass=".5"', 'fromto="0 0 0 .3 0 0" mass=".7"'))
    np.testing.assert_allclose(model.body_inertia, rescaled.body_inertia, rtol=1e-12)
    np.testing.assert_allclose(model.dof_invweight0, rescaled.dof_invweight0, rtol=1e-9)


def test_without_it_a_mass_leaves_the_inertia_alone():
    model = space(RICH, "body_mass", "arm").apply([1.5])
    np.testing.assert_array_equal(model.body_inertia, RICH.body_inertia)
    with pytest.raises(InputError, match="scale_inertia is for field body_mass"):
        space(RICH, "dof_damping", "flex", scale_inertia=True)


def test_applying_a_mass_equals_compiling_a_model_with_that_mass():
    model = space(compiled(ARM_XML), "body_mass", "lower", bounds=(0.1, 2)).apply([0.95])
    expected = compiled(ARM_XML.replace('mass=".6"', 'mass=".95"'))
    assert (expected.body_invweight0 != compiled(ARM_XML).body_invweight0).any()
    for field, value in float_fields(expected).items():
        np.testing.assert_allclose(read_field(model, field), value, rtol=1e-13, atol=0, err_msg=field)


@pytest.mark.parametrize("xml", [ARM_XML, BOX_XML, TENDON_XML, SLIDE_XML, RICH_XML])
def test_applying_the_models_own_values_changes_nothing(xml):
    model = compiled(xml)
    found = masses(model, [model.body(i).name for i in range(1, model.nbody)])
    for field, value in float_fields(found.apply(found.nominal)).items():
        np.testing.assert_array_equal(value, read_field(model, field), err_msg=field)


def test_applying_leaves_the_given_model_alone():
    model = compiled(ARM_XML)
    before = {k: v.copy() for k, v in float_fields(model).items()}
    found = ParameterSpace(
        model,
        {
            "m": {"field": "body_mass", "name": "hand", "bounds": [0.1, 2]},
            "h": {"field": "opt.timestep", "bounds": [0.001, 1]},
        },
    )
    changed = found.apply({"h": 0.5, "m": 1.0})
    assert (changed.opt.timestep, changed.body("hand").mass[0]) == (0.5, 1.0)
    for field, value in float_fields(model).items():
        np.testing.assert_array_equal(value, before[field], err_msg=field)


@pytest.mark.parametrize(
    ("field", "name", "old", "new", "value"),
    [
        ("actuator_kp", "reach", 'kp="12"', 'kp="20"', 20.0),
        ("actuator_kv", "reach", 'kv="0.5"', 'kv="0.9"', 0.9),
        ("actuator_kv", "turn", 'kv="1.5"', 'kv="2.5"', 2.5),
    ],
)
def test_a_servo_gain_equals_compiling_the_servo_with_it(field, name, old, new, value):
    model, expected = compiled(ARM_XML), compiled(ARM_XML.replace(old, new))
    found = space(model, field, name, bounds=(0.1, 50))
    changed = found.apply([value])
    assert found.nominal == float(old.split('"')[1])
    for key, array in float_fields(expected).items():
        np.testing.assert_array_equal(read_field(changed, key), array, err_msg=key)
    state, controls = random_states(model, 1)[0].numpy(), random_controls(model, 1, 5)[0].numpy()
    np.testing.assert_array_equal(rollout(changed, state, controls, 4), rollout(expected, state, controls, 4))
    assert (rollout(changed, state, controls, 4) != rollout(model, state, controls, 4)).any()


@pytest.mark.parametrize(("field", "gains"), [("actuator_kp", 'kp="7" kv=".4"'), ("actuator_kv", 'kp="3" kv="7"')])
def test_a_servo_with_two_controls_has_gains_and_shifts_no_other_actuator(field, gains):
    xml = ARM_XML.replace('<position name="reach" joint="shoulder" kp="12" kv="0.5"/>', "<pid {}/>")
    own, expected = (compiled(xml.format(f'name="reach" joint="shoulder" {g}')) for g in ('kp="3" kv=".4"', gains))
    assert (own.nactuator, own.nu) == (3, 4)
    changed = space(own, field, "reach", bounds=(0.1, 50)).apply([7.0])
    for key, array in float_fields(expected).items():
        np.testing.assert_array_equal(read_field(changed, key), array, err_msg=key)
    assert space(own, "actuator_kv", "turn").nominal == 1.5


@pytest.mark.parametrize("field", ["actuator_kp", "actuator_kv"])
def test_a_relative_servo_gain_multiplies_the_gain(field):
    absolute = space(compiled(ARM_XML), field, "reach", bounds=(0.1, 50))
    relative = space(compiled(ARM_XML), field, "reach", bounds=(0.1, 50), relative=True)
    ours, theirs = relative.apply([1.5]), absolute.apply(1.5 * absolute.nominal)
    np.testing.assert_allclose(ours.actuator_gainprm, theirs.actuator_gainprm, rtol=1e-15)
    np.testing.assert_allclose(ours.actuator_biasprm, theirs.actuator_biasprm, rtol=1e-15)


def test_a_motor_has_no_servo_gain_and_a_velocity_servo_no_kp():
    with pytest.raises(InputError, match="'push' is no position or velocity servo"):
        space(RICH, "actuator_kp", "push")
    with pytest.raises(InputError, match="'turn' is a velocity servo; its gain is actuator_kv"):
        space(compiled(ARM_XML), "actuator_kp", "turn")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"field": "body_mas", "name": "arm"}, "unknown field 'body_mas'; did you mean 'body_mass'"),
        ({"field": "body_mass", "name": "amr"}, "no body 'amr'; did you mean 'arm'"),
        ({"field": "dof_damping", "name": "*q"}, "no joint"),
        ({"field": "body_mass", "nam": "arm"}, "unknown key 'nam'; did you mean 'name'"),
        ({"field": "body_mass"}, "no name given; expected a body"),
        ({"name": "arm"}, "no field given"),
        ({"field": "body_pos", "name": "arm"}, "body_pos has 3 components; add index: 0 to 2"),
        ({"field": "body_pos", "name": "arm", "index": 3}, "index 3 is outside body_pos, which has 3 components"),
        ({"field": "body_mass", "name": "arm", "index": -1}, "index is -1"),
        ({"field": "body_mass", "name": "arm", "index": True}, "index is True"),
        ({"field": "geom_contype", "name": "tool"}, "holds whole numbers or flags"),
        ({"field": "opt.integrator"}, "holds whole numbers or flags"),
        ({"field": "opt.timestep", "name": "arm"}, "belongs to the whole model; leave out name"),
        ({"field": "key_qpos", "name": "arm"}, "belongs to no named object"),
        ({"field": "dof_damping", "name": "flex", "scale": "cubic"}, "scale is 'cubic'; expected linear or log"),
    ],
)
def test_an_entry_that_cannot_be_is_refused_with_what_would_be_right(spec, message):
    with pytest.raises(InputError, match=r"parameters\.p: .*" + message):
        ParameterSpace(RICH, {"p": {"bounds": [1, 2], **spec}})


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"bounds": [2, 1]}, r"bounds is \[2, 1\]; the first must be below the second"),
        ({"bounds": [1, 1]}, "the first must be below the second"),
        ({"bounds": [1, 2, 3]}, r"bounds is \[1, 2, 3\]; expected \[low, high\]"),
        ({"bounds": None}, "bounds is None"),
        ({"bounds": [0.5, np.inf]}, "expected finite numbers"),
        ({"bounds": [np.nan, 1]}, "expected finite numbers"),
        ({"bounds": [0, 1]}, "allow a mass that is not positive"),
        ({"bounds": [-1, 1]}, "allow a mass that is not positive"),
        ({"bounds": [-1, 1], "relative": True}, "not positive"),
        ({"bounds": [1, 2], "limits": [1.5, 3]}, "do not contain bounds"),
        ({"bounds": [1, 2], "limits": [0, 3]}, "allow a mass that cannot be"),
        ({"field": "dof_damping", "name": "flex", "bounds": [-0.1, 1]}, "allow a negative damping"),
        ({"field": "dof_damping", "name": "flex", "bounds": [0, 1], "limits": [-1, 2]}, "cannot be"),
        ({"field": "geom_pos[0]", "name": "tool", "bounds": [0, 1], "scale": "log"}, "scale log needs positive bounds"),
    ],
)
def test_bounds_that_cannot_be_are_refused(spec, message):
    with pytest.raises(InputError, match=r"parameters\.p: .*" + message):
        ParameterSpace(RICH, {"p": {"field": "body_mass", "name": "arm", **spec}})


def test_limits_keep_samples_physical():
    assert (space(RICH, "body_mass", "arm").limits[0] == [0.1, np.inf]).all()
    assert (space(RICH, "dof_damping", "flex").limits[0] == [0, np.inf]).all()
    assert (space(RICH, "geom_pos[1]", "tool").limits[0] == [-np.inf, np.inf]).all()
    assert (space(RICH, "geom_pos[1]", "tool", limits=[0, 4]).limits[0] == [0, 4]).all()
    assert space(RICH, "geom_pos[1]", "tool", scale="log").limits[0, 0] > 0


def test_two_parameters_that_write_the_same_number_are_refused():
    one = {"field": "body_mass", "name": "arm", "bounds": [1, 2]}
    with pytest.raises(InputError, match=r"parameters\.b: writes the same body_mass as 'a'"):
        ParameterSpace(RICH, {"a": one, "b": {**one, "name": "*"}})
    with pytest.raises(InputError, match="writes the same actuator_biasprm as 'a'"):
        ParameterSpace(
            RICH,
            {
                "a": {"field": "actuator_kp", "name": "bend", "bounds": [1, 2]},
                "b": {"field": "actuator_biasprm", "name": "bend", "index": 1, "bounds": [-2, -1]},
            },
        )
    ParameterSpace(RICH, {"a": one, "b": {**one, "name": "end"}})


def test_vectors_and_named_values_convert_both_ways():
    found = masses(RICH, ["arm", "end"])
    values = {"end": 0.2, "arm": 0.4}
    np.testing.assert_array_equal(found.vector(values), [0.4, 0.2])
    assert found.named(found.vector(values)) == {"arm": 0.4, "end": 0.2}
    with pytest.raises(InputError, match="unknown name 'amr'; did you mean 'arm'"):
        found.vector({**values, "amr": 1})
    with pytest.raises(InputError, match="no value given for 'end'"):
        found.vector({"arm": 1})


def test_parameters_of_a_simulator_without_a_model_need_no_field():
    found = ParameterSpace(None, {"gain": {"bounds": [1, 2], "unit": "N"}})
    assert (found.names, found.parameters[0].unit) == (("gain",), "N")
    assert np.isnan(found.nominal).all()
    for spec, message in (
        ({"field": "body_mass"}, "needs a MuJoCo model"),
        ({"relative": True}, "needs a MuJoCo model"),
    ):
        with pytest.raises(InputError, match=message):
            ParameterSpace(None, {"gain": {"bounds": [1, 2], **spec}})
    with pytest.raises(InputError, match="none given"):
        ParameterSpace(None, {})
    with pytest.raises(InputError, match="these belong to no MuJoCo model"):
        found.apply([1.5])
