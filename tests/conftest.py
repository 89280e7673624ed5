"""Models and small helpers shared by the tests; which tests are too long for every commit; workers side by side."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import hypothesis
import mujoco
import numpy as np
import pytest
import torch

from dropo_torch.data.observation import generic_observation as generic_observation
from dropo_torch.data.trajectory import Transitions
from dropo_torch.effects import VOCABULARY
from dropo_torch.fit import noise_of
from dropo_torch.objective import Objective
from dropo_torch.optimizers import Optimizer, Request
from dropo_torch.parameters import ParameterSpace
from dropo_torch.testing.linear import LinearSimulator as LinearSimulator
from dropo_torch.testing.linear import linear_objective as linear_objective
from dropo_torch.testing.simulators import stepped as settled_rollout  # noqa: F401

#: Tests that take a second of a processor or more, by file and name, or all of a file: what ``make check`` leaves out.
WHOLE = {
    "test_adam.py": ("test_adam_approaches_the_masses_and_continues_from_any_state",
                     "test_adam_finds_what_fisher_scoring_finds"),
    "test_baselines.py": ("test_a_few_wild_simulations_do_not_blind_the_network",
                          "test_a_mixture_density_network_learns_a_gaussian_posterior",
                          "test_bayessim_contains_the_truth_and_is_narrower_than_the_prior",
                          "test_laplace_is_calibrated_for_a_fixed_truth_and_dropo_for_a_varying_one",
                          "test_several_explanations_are_told",
                          "test_the_hopper_study_resumes_and_says_what_it_found",
                          "test_what_varies_is_no_outlier_where_the_starts_are_noisy"),
    "test_check.py": ("test_a_fault_is_told_and_cured", "test_a_fit_that_is_forced_goes_on",
                      "test_a_good_log_is_left_in_peace", "test_an_actuator_that_answers_late_stops_nothing",
                      "test_doubts_are_told_by_a_fit", "test_whatever_a_log_holds_it_is_examined"),
    "test_cli.py": ("test_a_reader_that_has_seen_enough_does_not_stop_a_fit",
                    "test_ctrl_c_ends_with_130_and_one_line",
                    "test_the_demo_finds_four_masses_within_two_percent", "test_the_demo_takes_other_parameters",
                    "test_two_runs_do_not_share_a_folder"),
    "test_compare.py": ("test_a_comparison_runs_every_method_on_one_log",
                        "test_an_interrupted_comparison_repeats_no_finished_run"),
    "test_docs.py": ("test_crane", "test_demo_figure", "test_gradient_vs_gradient_free", "test_own_effect",
                     "test_python_runs", "test_transfer_hopper"),
    "test_fit.py": ("test_a_fit_killed_at_any_moment_resumes_to_the_same_result",),
    "test_fuzz.py": ("test_a_reader_that_dies_eats_or_hangs_is_told_in_one_line",
                     "test_damaged_binary_models_are_refused", "test_damaged_files_are_read_or_refused_in_one_line",
                     "test_damaged_matlab_files_do_not_take_the_process_along",
                     "test_epsilon_may_be_as_small_or_large_as_its_limits_say"),
    "test_gap.py": ("",),
    "test_optimizers.py": ("test_optimizers_keep_their_laws",),
    "test_gap_written.py": ("test_of_every_effect_what_is_written_is_what_was_found",),
    "test_manipulation.py": ("test_every_cell_has_a_config_that_is_understood",),
    "test_parallel.py": ("",),
    "test_puck.py": ("test_a_hit_sends_the_puck_along_its_heading", "test_an_action_is_a_whole_hit",
                     "test_puck_and_servos_are_found"),
    "test_push.py": ("test_the_box_is_found",),
    "test_recorders.py": ("",),
    "test_rl_train.py": ("",),
    "test_target.py": ("test_preprocessing_gives_back_the_true_states_within_the_noise",
                       "test_the_cameras_latency_is_found_by_the_marker_and_holds_for_the_object",
                       "test_the_log_is_in_order_and_a_seed_decides_it"),
    "test_transfer.py": ("test_a_small_study_runs_from_the_log_to_the_page_and_grows",
                         "test_the_arm_as_it_was_found_stays_while_the_object_is_searched",
                         "test_the_targets_own_model_moves_as_the_target_does"),
    "test_shooting.py": ("test_a_fit_that_was_interrupted_goes_on_to_the_same_result",
                         "test_a_state_that_is_seen_is_fitted_as_it_is_without_sensors",
                         "test_a_model_that_lacks_friction_does_not_explain_what_a_camera_saw",
                         "test_masses_of_the_arm_are_found_by_what_it_has",
                         "test_the_center_of_a_tossed_box_is_found_by_a_marker_and_a_gyroscope",
                         "test_the_command_writes_what_it_always_writes"),
    "test_sweep.py": ("test_the_noise_of_every_measurement_is_found",),
    "test_unseen_robots.py": ("test_a_log_is_what_the_truth_predicts_to_the_noise",),
    "test_view.py": ("test_a_video_has_a_pane_for_each_simulation",
                     "test_in_a_browser_time_moves_by_keys_and_cursors_with_it"),
    "test_warp_backend.py": ("test_the_library_does_not_need_warp",),
    "test_warp_collide.py": ("test_geoms_touch_where_mujoco_says",),
    "test_warp_conformance.py": ("test_contacts", "test_gymnasium_models", "test_hopper_through_four_substeps"),
}  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is too long for every commit."""
    for item in items:
        names = WHOLE.get(item.path.name, ())
        if not all(names) or item.name.split("[")[0] in names:
            item.add_marker(pytest.mark.whole)


def share_processors() -> None:
    """Give each of several workers processors of its own: whatever counts them makes no more threads than those."""
    own, count = int(os.environ["PYTEST_XDIST_WORKER"].lstrip("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    every = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, every[own % len(every) :: count] or every)
    torch.set_num_threads(max(1, len(every) // count))


WORKS_ALONE = "PYTEST_XDIST_WORKER" not in os.environ
if not WORKS_ALONE and hasattr(os, "sched_setaffinity"):
    share_processors()


@pytest.fixture(autouse=True, scope="session")
def kernels_are_compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Of several workers, one compiles a kernel while the others wait, and then find it on disk."""
    if WORKS_ALONE:
        yield
        return
    warp = pytest.importorskip("warp")
    load, lock = warp.load_module, tmp_path_factory.getbasetemp().parent / "kernels.lock"

    def load_in_turn(*arguments: Any, **options: Any) -> Any:
        with lock.open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            return load(*arguments, **options)

    warp.load_module = load_in_turn
    yield
    warp.load_module = load


hypothesis.settings.register_profile("tests", deadline=None, derandomize=True, max_examples=60, database=None)
hypothesis.settings.load_profile("tests")


@pytest.fixture(autouse=True, scope="module")
def own_effects_leave_with_their_module() -> Iterator[None]:
    """Effects that a module registers are not in the vocabulary of the next."""
    known = dict(VOCABULARY)
    yield
    VOCABULARY.clear()
    VOCABULARY.update(known)


HOPPER = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "hopper.xml"
HOPPER_BODIES = ("torso", "thigh", "leg", "foot")

#: A free box and a fixed ball on a slippery floor; a second box hangs out of everything's reach.
BOX_XML = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction="0.01 0.001 0.0001"/>
    <body name="box" pos="0 0 .1">
      <freejoint name="root"/>
      <geom name="box" type="box" size=".1 .08 .06" mass="1.5" friction="0.5 0.005 0.0001"/>
    </body>
    <body name="far" pos="0 0 4">
      <joint name="hang" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="far" type="sphere" size=".05" pos=".2 0 0" mass=".3"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="hang"/></actuator>
</mujoco>"""

#: A two-link arm with a position servo, a velocity servo and a filtered motor; no contact.
ARM_XML = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <inertial mass="1.1" pos="0 0 -.2" diaginertia=".02 .018 .004"/>
      <joint name="shoulder" type="hinge" axis="0 1 0" damping=".3" armature=".01"/>
      <body name="lower" pos="0 0 -.4">
        <inertial mass=".6" pos="0 0 -.15" diaginertia=".009 .008 .002"/>
        <joint name="elbow" type="hinge" axis="0 1 0" damping=".1" stiffness=".4" armature=".005"/>
        <body name="hand" pos="0 0 -.3">
          <inertial mass=".2" pos="0 0 -.05" diaginertia=".001 .001 .0005"/>
          <joint name="wrist" type="slide" axis="0 0 1" damping=".2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="reach" joint="shoulder" kp="12" kv="0.5"/>
    <velocity name="turn" joint="elbow" kv="1.5"/>
    <general name="extend" joint="wrist" gainprm="3" dyntype="filterexact" dynprm=".05" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""

#: Two fingers coupled by a tendon with limits, stiffness and friction, and a ball joint beside them.
TENDON_XML = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="a"><joint name="ja" type="hinge" axis="0 1 0" frictionloss=".02"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".2"/></body>
    <body name="b" pos="0 .5 0"><joint name="jb" type="hinge" axis="0 1 0"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass=".3"/></body>
    <body name="c" pos="0 1 0"><joint name="jc" type="ball" damping=".02"/>
      <geom type="box" size=".05 .1 .15" pos=".1 0 0" mass=".4"/></body>
  </worldbody>
  <tendon>
    <fixed name="cable" stiffness="2" damping=".1" limited="true" range="-.4 .4" frictionloss=".01">
      <joint joint="ja" coef="1"/><joint joint="jb" coef="-.5"/></fixed>
  </tendon>
  <actuator><motor name="pull" tendon="cable" gear="2"/></actuator>
</mujoco>"""

#: A block on a spring; nothing else. One step of MuJoCo is a matrix.
SLIDE_XML = """
<mujoco>
  <option timestep="0.01"><flag gravity="disable" contact="disable"/></option>
  <worldbody>
    <body name="block">
      <inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/>
      <joint name="rail" type="slide" axis="1 0 0" stiffness="30"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
</mujoco>"""


@pytest.fixture(scope="session")
def hopper() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(HOPPER))


def compiled(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def masses(model: mujoco.MjModel, names: Sequence[str] = HOPPER_BODIES) -> ParameterSpace:
    """A space of the given bodies' masses, between 0.6 and 1.5 times the model's own."""
    own = {n: float(model.body(n).mass[0]) for n in names}
    return ParameterSpace(
        model,
        {n: {"field": "body_mass", "name": n, "bounds": [0.6 * m, 1.5 * m], "unit": "kg"} for n, m in own.items()},
    )


def hopper_states(model: mujoco.MjModel, number: int, seed: int = 0) -> torch.Tensor:
    """Hopper states around standing, about half of them in contact with the floor."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (number, 1)) + rng.uniform(-0.2, 0.2, (number, model.nq))
    qpos[:, 1] = 1.25 + rng.uniform(-0.06, 0.15, number)
    return torch.from_numpy(np.concatenate([qpos, rng.normal(0, 1.0, (number, model.nv))], 1))


def random_states(model: mujoco.MjModel, number: int, seed: int = 0, height: float | None = None) -> torch.Tensor:
    """Random states of any model with unit quaternions; ``height`` bounds a free body's."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0, 0.7, (number, model.nv))
    qpos = np.tile(model.qpos0, (number, 1))
    for row, move in zip(qpos, rng.normal(0, 0.5, (number, model.nv)), strict=True):
        mujoco.mj_integratePos(model, row, move, 1.0)
        if height is not None:
            row[2] = rng.uniform(0.05, height)
    return torch.from_numpy(np.concatenate([qpos, velocity], 1))


def random_controls(model: mujoco.MjModel, number: int, lag: int, seed: int = 1) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (number, lag, model.nu)))


def windows(states: torch.Tensor, controls: torch.Tensor, measured: torch.Tensor | np.ndarray) -> Transitions:
    number = len(states)
    return Transitions(
        states=states.numpy(), controls=controls.numpy(), measured=np.asarray(measured),
        rows=np.arange(number) * controls.shape[1], episodes=np.zeros(number, dtype=int),
    )  # fmt: skip


def space_of(**bounds: Sequence[float] | dict) -> ParameterSpace:
    """Parameters of no MuJoCo model: name=[low, high], or name={bounds: ..., scale: ...}."""
    return ParameterSpace(None, {k: v if isinstance(v, dict) else {"bounds": list(v)} for k, v in bounds.items()})


def drive(optimizer: Optimizer, objective: Objective, after_tell: Callable[[], None] = lambda: None) -> None:
    """Ask, simulate and tell until the optimizer stops."""
    while optimizer.stop_reason is None:
        optimizer.tell(answered(objective, optimizer.ask()))
        after_tell()


def answered(objective: Objective, request: Request) -> torch.Tensor:
    """The sums that an optimizer asks for, around the noise of the initial states."""
    return objective.map(request.values, request.reduce, initial=noise_of(objective, request)).total


def numerical_gradient(function: Callable[[np.ndarray], float], at: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of a scalar function, ``(d,)``."""
    eye = step * np.eye(len(at))
    return np.array([(function(at + e) - function(at - e)) / (2 * step) for e in eye])
