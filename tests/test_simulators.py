"""Laws that every backend keeps. A new backend is one more entry in ``BACKENDS``."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from conftest import (
    ARM_XML,
    BOX_XML,
    HOPPER,
    TENDON_XML,
    compiled,
    hopper_states,
    masses,
    random_controls,
    random_states,
    settled_rollout,
    space_of,
)

from dropo_torch.errors import InputError
from dropo_torch.models.load import unsimplify
from dropo_torch.parameters import ParameterSpace
from dropo_torch.rl.stepper import make_stepper
from dropo_torch.simulators import GymnasiumSimulator, MujocoEnvAdapter, MujocoSimulator, Simulator, make_simulator
from dropo_torch.simulators.warp import WarpSimulator
from dropo_torch.testing import Tolerance, check_simulator, mujoco_reference


class PlainEnv:
    """As much of a Gymnasium MuJoCo environment as the adapter drives, on any model."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int) -> None:
        self.unwrapped = self
        self.model, self.data = model, mujoco.MjData(model)
        self.frame_skip, self.dt = frame_skip, frame_skip * model.opt.timestep

    def reset(self, seed: int) -> None:
        mujoco.mj_resetData(self.model, self.data)

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, self.data)

    def do_simulation(self, control: np.ndarray, frame_skip: int) -> None:
        self.data.ctrl[:] = control
        mujoco.mj_step(self.model, self.data, frame_skip)


def plain_gymnasium(space: ParameterSpace, frame_skip: int) -> GymnasiumSimulator:
    model = copy.copy(space.model)
    return GymnasiumSimulator(MujocoEnvAdapter(PlainEnv(model, frame_skip), space), parameters=space)


@dataclass(frozen=True)
class Backend:
    """How to make a backend, and how near to C MuJoCo it must come.

    Attributes:
        make: from a parameter space and a frame skip, with any of ``options``.
        options: constructor options that must not change a result.
        tolerance: how near to C MuJoCo, by default to the bit.
        settles_filters: whether first-order filters start settled at their control; refused where not.
    """

    make: Callable[..., Simulator]
    options: tuple[Mapping[str, int], ...] = ({},)
    tolerance: Tolerance = field(default_factory=Tolerance)
    settles_filters: bool = True


BACKENDS = {
    "mujoco": Backend(
        lambda space, frame_skip, **options: MujocoSimulator(
            space.model, parameters=space, frame_skip=frame_skip, **options
        ),
        options=({"num_threads": 1}, {"num_threads": 2}, {"chunk_size": 1}, {"chunk_size": 7}, {"chunk_size": 10**6}),
    ),
    "warp": Backend(
        lambda space, frame_skip, **options: WarpSimulator(
            space.model, parameters=space, frame_skip=frame_skip, **options
        ),
        options=({"num_threads": 1}, {"num_threads": 2}, {"chunk_size": 1}, {"chunk_size": 7}),
        tolerance=Tolerance(states=1e-6, gradient=1e-4, most=np.inf),  # gradients have a suite of their own
    ),
    "gymnasium": Backend(plain_gymnasium, tolerance=Tolerance(states=1e-14), settles_filters=False),
}


@dataclass(frozen=True)
class Case:
    """A model, what varies in it, and where its transitions start."""

    space: ParameterSpace
    frame_skip: int
    states: torch.Tensor
    controls: torch.Tensor
    values: torch.Tensor
    idle: tuple[str, ...] = ()


def case_of(space: ParameterSpace, frame_skip: int, states: torch.Tensor, lag: int = 3, num_values: int = 4) -> Case:
    share = np.random.default_rng(5).uniform(0, 1, (num_values, len(space)))
    values = torch.from_numpy(space.low + share * (space.high - space.low))
    return Case(space, frame_skip, states, random_controls(space.model, len(states), lag), values)


def hopper_case() -> Case:
    model = mujoco.MjModel.from_xml_path(str(HOPPER))
    return case_of(masses(model), 4, hopper_states(model, 12))


def box_case() -> Case:
    model = compiled(BOX_XML)
    space = ParameterSpace(
        model,
        {
            "mass": {"field": "body_mass", "name": "box", "bounds": [0.5, 3], "scale_inertia": True},
            "friction": {"field": "geom_friction", "name": "box", "bounds": [0.1, 1]},
            "size": {"field": "geom_size[2]", "name": "box", "bounds": [0.05, 0.08]},
        },
    )
    return case_of(space, 5, random_states(model, 8, height=0.15))


def arm_case() -> Case:
    space = ParameterSpace(
        compiled(ARM_XML),
        {
            "kp": {"field": "actuator_kp", "name": "reach", "bounds": [5, 20]},
            "kv": {"field": "actuator_kv", "name": "reach", "bounds": [0.1, 1]},
            "armature": {"field": "dof_armature", "name": "*", "bounds": [0.001, 0.02]},
            "gravity": {"field": "opt.gravity", "index": 2, "bounds": [-12, -3]},
        },
    )
    return case_of(space, 3, random_states(space.model, 8))


def tendon_case() -> Case:
    space = ParameterSpace(
        compiled(TENDON_XML),
        {
            "stiffness": {"field": "tendon_stiffness", "name": "cable", "bounds": [1, 5]},
            "friction": {"field": "tendon_frictionloss", "name": "cable", "bounds": [0, 0.1]},
            "loss": {"field": "dof_frictionloss", "name": "ja", "bounds": [0, 0.1]},
            "mass": {"field": "body_mass", "name": ["a", "b"], "bounds": [0.5, 2], "relative": True},
            "step": {"field": "opt.timestep", "bounds": [0.001, 0.004]},
        },
    )
    return case_of(space, 2, random_states(space.model, 8))


CASES = {"hopper": hopper_case, "box": box_case, "arm": arm_case, "tendon": tendon_case}


def made(backend: Backend, case: Case, **options: int) -> Simulator:
    try:
        return backend.make(case.space, case.frame_skip, **options)
    except InputError as error:
        if "backend warp does not simulate" not in str(error):
            raise
        pytest.skip(str(error))  # the subset stands in docs/warp.md; what is in it has suites of its own


def turned(space: ParameterSpace) -> ParameterSpace:
    """The same parameters in the reverse order."""
    other = copy.copy(space)
    other.parameters = space.parameters[::-1]
    other.__dict__.pop("nominal", None)
    return other


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_backends_keep_the_laws_of_a_simulator(backend: str, case: str) -> None:
    kind, on = BACKENDS[backend], CASES[case]()
    if on.space.model.na and not kind.settles_filters:
        with pytest.raises(InputError, match="actuators with filters"):
            made(kind, on)
        return
    simulator, controls = made(kind, on), on.controls
    variants = [made(kind, on, **options) for options in kind.options]
    report = check_simulator(
        simulator,
        on.states,
        controls,
        on.values,
        variants=[*variants, made(kind, replace(on, space=turned(on.space)))],
        reference=mujoco_reference(on.space, on.frame_skip),
        tolerance=kind.tolerance,
        diverging=torch.full_like(on.values[:1], torch.nan),
        idle=on.idle,
    )
    assert not set(report.skipped) - {"gradients are those of central differences"}
    assert simulator.timestep == pytest.approx(on.frame_skip * on.space.model.opt.timestep)


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=BACKENDS.keys())
def test_every_entry_of_a_result_is_written(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES["hopper"]()
    simulator = made(backend, case)
    expected = simulator.simulate(case.states, case.controls, case.values)
    monkeypatch.setattr(np, "empty", lambda shape, *a, **k: np.full(shape, 1e99, *a, **k))
    torch.testing.assert_close(simulator.simulate(case.states, case.controls, case.values), expected, rtol=0, atol=0)


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=BACKENDS.keys())
def test_what_diverges_says_nothing_and_writes_no_file(backend: Backend, tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(HOPPER))
    space = ParameterSpace(model, {"damping": {"field": "dof_damping", "name": "leg_joint", "bounds": [0.1, 5]}})
    simulator = backend.make(space, 4)
    states, controls = hopper_states(model, 5), random_controls(model, 5, 12)
    values = torch.tensor([[1.0], [2.0]], dtype=torch.float64)
    wild = torch.tensor([[-1e7], [-1e3]], dtype=torch.float64)  # at once, and in the course of the window
    # how near the gradients are is not asked here: these states press on contacts; test_warp_conformance asks it
    check_simulator(simulator, states, controls, values, diverging=wild, tolerance=Tolerance(gradient=1.0, most=np.inf))
    states[3, -3:] = 1e9
    assert torch.isnan(simulator.simulate(states, controls, values)[3]).all()
    assert os.listdir(tmp_path) == []
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_the_given_model_is_left_alone():
    case = hopper_case()
    flags, mass = case.space.model.opt.disableflags, case.space.model.body_mass.copy()
    simulator = MujocoSimulator(case.space.model, parameters=case.space, frame_skip=4)
    simulator.simulate(case.states, case.controls, case.values)
    assert case.space.model.opt.disableflags == flags
    np.testing.assert_array_equal(case.space.model.body_mass, mass)


@pytest.mark.parametrize("push", [0.5, 3.0])
def test_a_filter_settled_at_a_constant_control_acts_like_none(push):
    plain = compiled(ARM_XML.replace('dyntype="filterexact" dynprm=".05"', ""))
    filtered = compiled(ARM_XML)
    controls = torch.full((6, 4, 3), push, dtype=torch.float64)
    results = []
    for model in (plain, filtered):
        space = masses(model, ["upper"])
        simulator = MujocoSimulator(model, parameters=space, frame_skip=3)
        results.append(simulator.simulate(random_states(model, 6), controls, torch.from_numpy(space.nominal[None])))
    torch.testing.assert_close(results[1], results[0], rtol=1e-12, atol=1e-12)


def test_actuators_with_several_controls_or_no_state_are_simulated():
    model = compiled(
        ARM_XML.replace("<position", "<pid").replace(
            '<velocity name="turn" joint="elbow" kv="1.5"/>',
            '<dcmotor name="turn" joint="elbow" motorconst="1" resistance="2"/>',
        )
    )
    assert model.nu == model.nactuator + 1
    space = masses(model, ["lower"])
    states, controls = random_states(model, 4), random_controls(model, 4, 2)
    ours = MujocoSimulator(model, parameters=space, frame_skip=3).rollout(
        states, controls, torch.from_numpy(space.nominal[None])
    )
    for row, state, control in zip(ours, states.numpy(), controls.numpy(), strict=True):
        np.testing.assert_array_equal(row[0], settled_rollout(space.apply(space.nominal), state, control, 3))


def test_actuators_with_a_hidden_state_are_refused():
    xml = ARM_XML.replace('dyntype="filterexact"', 'dyntype="integrator"')
    with pytest.raises(InputError, match="actuators extend keep a hidden state"):
        MujocoSimulator(compiled(xml), parameters=masses(compiled(xml), ["upper"]))


def test_a_frame_skip_below_one_is_refused():
    case = hopper_case()
    with pytest.raises(InputError, match="frame_skip 0"):
        MujocoSimulator(case.space.model, parameters=case.space, frame_skip=0)


def test_the_environment_of_gymnasium_gives_the_mujoco_backends_transitions():
    pytest.importorskip("imageio", reason="gymnasium's MuJoCo environments import it")
    environment = gymnasium.make("Hopper-v5")
    space = masses(environment.unwrapped.model)
    case = case_of(space, 4, hopper_states(space.model, 10))
    nominal = space.nominal.copy()
    ours = make_simulator("gymnasium", lambda s: MujocoEnvAdapter(environment, s), parameters=space)
    theirs = make_simulator("mujoco", str(HOPPER), parameters=space, frame_skip=4)
    arguments = (case.states, case.controls, torch.cat([case.values, torch.from_numpy(nominal[None])]))
    torch.testing.assert_close(ours.rollout(*arguments), theirs.rollout(*arguments), rtol=1e-9, atol=1e-9)
    assert ours.timestep == pytest.approx(theirs.timestep)


class Pendulum:
    """A user's own simulator: a damped pendulum in numpy, semi-implicit Euler."""

    num_states, num_controls, timestep = 2, 1, 0.01

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.state = np.zeros(2)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        self.values = dict(values)

    def set_state(self, state: np.ndarray) -> None:
        self.state = state

    def step(self, control: np.ndarray) -> np.ndarray:
        angle, speed = self.state
        torque = control[0] - self.values["damping"] * speed
        speed = speed + self.timestep * (torque / self.values["mass"] - 9.81 * np.sin(angle))
        self.state = np.array([angle + self.timestep * speed, speed])
        return self.state


def pendulum_space() -> ParameterSpace:
    return space_of(mass=[0.1, 2], damping=[0.0, 1])


def test_any_python_simulator_can_be_fitted_through_an_adapter():
    space = pendulum_space()
    simulator = GymnasiumSimulator(Pendulum(), parameters=space, frame_skip=3)
    assert simulator.timestep == pytest.approx(0.03)
    rng = np.random.default_rng(0)
    states, controls, values = rng.normal(size=(5, 2)), rng.normal(size=(5, 2, 1)), rng.uniform(0.2, 1, (3, 2))
    ours = simulator.rollout(*(torch.from_numpy(x) for x in (states, controls, values)))
    angle, speed = (np.repeat(states[:, None, i], 3, 1) for i in range(2))
    for step in range(2):
        for _ in range(3):
            torque = controls[:, None, step, 0] - values[:, 1] * speed
            speed = speed + 0.01 * (torque / values[:, 0] - 9.81 * np.sin(angle))
            angle = angle + 0.01 * speed
        np.testing.assert_allclose(ours[:, :, step], np.stack([angle, speed], -1), rtol=1e-13)


def test_an_adapter_may_be_made_from_the_parameter_space():
    seen = []
    GymnasiumSimulator(lambda space: seen.append(space) or Pendulum(), parameters=(space := pendulum_space()))
    assert seen == [space]


@pytest.mark.parametrize("missing", ["set_parameters", "set_state", "step", "num_states", "num_controls"])
def test_an_adapter_that_lacks_something_is_refused(missing):
    members = {k: getattr(Pendulum, k) for k in ("set_parameters", "set_state", "step", "num_states", "num_controls")}
    del members[missing]
    with pytest.raises(InputError, match=rf"environment: .*{missing}.*; an adapter has"):
        GymnasiumSimulator(type("Half", (), members)(), parameters=pendulum_space())


def test_an_adapter_that_returns_another_shape_is_refused():
    class Short(Pendulum):
        def step(self, control: np.ndarray) -> np.ndarray:
            return super().step(control)[:1]

    simulator = GymnasiumSimulator(Short(), parameters=pendulum_space())
    one = (torch.ones(shape, dtype=torch.float64) for shape in ((1, 2), (1, 1, 1), (1, 2)))
    with pytest.raises(InputError, match=r"step of Short returns shape \(1,\); expected \(2,\) numbers"):
        simulator.simulate(*one)


def test_an_adapter_that_returns_nan_has_diverged_for_that_value_only():
    class Fragile(Pendulum):
        def step(self, control: np.ndarray) -> np.ndarray:
            return super().step(control) * (np.nan if self.values["mass"] > 1 else 1)

    values = torch.tensor([[0.5, 0.1], [1.5, 0.1]], dtype=torch.float64)
    states, controls = torch.ones(3, 2, dtype=torch.float64), torch.ones(3, 2, 1, dtype=torch.float64)
    ours = GymnasiumSimulator(Fragile(), parameters=pendulum_space()).rollout(states, controls, values)
    assert torch.isnan(ours[:, 1]).all()
    assert torch.isfinite(ours[:, 0]).all()


def test_a_direction_that_varies_keeps_length_one_in_an_environment() -> None:
    """As it does in the other backends, whichever values came before."""
    entries = {
        "axis": {"field": "jnt_axis", "name": "hinge", "index": 0, "bounds": [0.2, 1.0]},
        "turn": {"field": "geom_quat", "name": "stop", "index": 3, "bounds": [0.1, 0.9]},
    }
    space = ParameterSpace(mujoco.MjModel.from_xml_string(COINCIDING_XML), entries)
    case = case_of(space, 5, random_states(space.model, 4))
    expected = MujocoSimulator(space.model, parameters=space, frame_skip=5).rollout(
        case.states, case.controls, case.values
    )
    found = plain_gymnasium(space, 5).rollout(case.states, case.controls, case.values)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)
    assert found.std(1).max() > 1e-3


@pytest.mark.parametrize("where", ["mj_setConst", "mj_forward", "mj_step"])
def test_what_mujoco_refuses_in_an_environment_is_nan_for_that_value_only(
    where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, plain = box_case(), getattr(mujoco, where)
    simulator = plain_gymnasium(case.space, 5)
    expected = simulator.rollout(case.states, case.controls, case.values)
    refused = case.values[:, 0] == case.values[0, 0]

    def refusing(model: mujoco.MjModel, *arguments: object) -> None:
        if model.body_mass[1] == float(case.values[0, 0]):
            raise mujoco.FatalError("refused")
        plain(model, *arguments)

    monkeypatch.setattr(mujoco, where, refusing)
    found = simulator.rollout(case.states, case.controls, case.values)
    assert torch.isnan(found[:, refused]).all()
    torch.testing.assert_close(found[:, ~refused], expected[:, ~refused], rtol=0, atol=0)


def test_an_environment_that_is_none_of_mujocos_is_refused():
    with pytest.raises(InputError, match="no Gymnasium MuJoCo environment; write an adapter"):
        MujocoEnvAdapter(gymnasium.make("CartPole-v1"), pendulum_space())


def test_an_unknown_backend_is_refused_with_the_nearest():
    with pytest.raises(InputError, match="unknown 'mujocco'; did you mean 'mujoco'"):
        make_simulator("mujocco", None, parameters=pendulum_space())


#: A link whose frame, inertial frame, geom and site coincide, so that MuJoCo computes one for all.
COINCIDING_XML = """
<mujoco>
  <option gravity="0 -9.81 0"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" axis="0 0 1"/>
      <geom name="bar" type="box" size=".2 .1 .1" mass="2"/>
      <site name="tip"/>
      <body name="tool" pos=".5 0 0">
        <joint axis="0 0 1"/>
        <geom type="box" size=".1 .1 .1" pos="0 .1 0" mass="1" contype="0" conaffinity="0"/>
      </body>
    </body>
    <geom name="stop" type="box" size=".1 .1 .1" pos=".1 -.22 0"/>
  </worldbody>
  <actuator><general site="tip" gear="0 1 0 0 0 0"/></actuator>
</mujoco>"""


MOVED_FRAMES = (
    {"field": "body_ipos[0]", "name": "link", "bounds": [0.05, 0.4]},
    {"field": "body_iquat[3]", "name": "link", "bounds": [0.3, 0.8]},
    {"field": "geom_pos[1]", "name": "bar", "bounds": [-0.05, 0.03]},
    {"field": "site_pos[0]", "name": "tip", "bounds": [0.1, 0.5]},
)


@pytest.mark.parametrize(
    ("entry", "backend"),
    [(entry, backend) for entry in MOVED_FRAMES for backend in ("mujoco", "environments")]
    + [(MOVED_FRAMES[0], "warp")],
    ids=lambda x: x if isinstance(x, str) else x["field"],
)
def test_a_frame_that_coincided_with_another_moves_with_its_parameter(entry: dict[str, object], backend: str) -> None:
    """As in one model with the value written and ``mj_setConst`` run."""
    xml = COINCIDING_XML
    if backend == "warp":  # it has neither forces at sites nor boxes that touch boxes
        xml = xml.replace('site="tip" gear="0 1 0 0 0 0"', 'joint="hinge"').replace(
            'name="stop"', 'contype="0" conaffinity="0"'
        )
    spec = mujoco.MjSpec.from_string(xml)
    unsimplify(spec)
    space = ParameterSpace(spec.compile(), {"moved": entry})
    values = np.linspace(space.low, space.high, 3)
    start, control = np.array([0.1, -0.2, 0.5, 0.3]), np.array([3.0])
    expected = []
    for value in values:
        model = space.apply(value)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = start[:2], start[2:], control
        mujoco.mj_step(model, data, nstep=20)
        expected.append(np.concatenate([data.qpos, data.qvel]))
    assert np.abs(np.diff(expected, axis=0)).max() > 1e-4
    if backend == "environments":
        stepper = make_stepper("mujoco", space, len(values), frame_skip=20)
        stepper.reset(torch.arange(3), torch.from_numpy(start).repeat(3, 1), torch.from_numpy(values))
        found = stepper.step(torch.from_numpy(control).repeat(3, 1, 1))[:, -1]
    else:
        simulator = make_simulator(backend, space.model, parameters=space, frame_skip=20)
        rows = torch.from_numpy(start)[None], torch.from_numpy(control)[None, None]
        found = simulator.simulate(*rows, torch.from_numpy(values))[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 if backend == "warp" else 0)


def test_the_center_of_a_body_compiled_as_simple_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(COINCIDING_XML)
    model.body_simple[1] = 1
    space = ParameterSpace(model, {"x": {"field": "body_ipos[0]", "name": "link", "bounds": [-0.4, 0.4]}})
    for make in (lambda: MujocoSimulator(model, parameters=space), lambda: plain_gymnasium(space, 1)):
        with pytest.raises(InputError, match=r"'x': body 1 \(link\) is compiled as simple"):
            make()


def test_moving_the_center_of_a_body_compiled_as_simple_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(BOX_XML)
    assert model.body_simple[1]
    space = ParameterSpace(model, {"x": {"field": "body_ipos[0]", "name": model.body(1).name, "bounds": [-0.4, 0.4]}})
    with pytest.raises(InputError, match=r"'x': body 1 \(.*\) is compiled as simple"):
        space.apply([0.1])
    with pytest.raises(InputError, match="is compiled as simple"):
        MujocoSimulator(model, parameters=space)
