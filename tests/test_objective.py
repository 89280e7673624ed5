from __future__ import annotations

import copy

import hypothesis
import mujoco
import numpy as np
import pytest
import scipy.spatial
import scipy.stats
import torch
from conftest import (
    ARM_XML,
    BOX_XML,
    SLIDE_XML,
    LinearSimulator,
    compiled,
    hopper_states,
    linear_objective,
    masses,
    random_controls,
    random_states,
    space_of,
    windows,
)
from hypothesis import given
from hypothesis import strategies as st

from dropo_torch.data.observation import generic_observation, parse_observation
from dropo_torch.errors import InputError
from dropo_torch.excitation import no_effect
from dropo_torch.likelihood import gaussian_log_density, likelihood_with_losses, log_likelihood, robust_cholesky
from dropo_torch.objective import Objective
from dropo_torch.parameters import ParameterSpace
from dropo_torch.simulators import MujocoSimulator
from dropo_torch.support.random import draw_uniforms


def literal(samples: np.ndarray, measured: np.ndarray, epsilon) -> float:
    """Equations 2 and 3 for one transition: samples ``(K, n)``, measured ``(n,)``."""
    covariance = np.atleast_2d(np.cov(samples, rowvar=False, ddof=1)) + np.diag(
        np.broadcast_to(epsilon, measured.shape)
    )
    return scipy.stats.multivariate_normal.logpdf(measured, samples.mean(0), covariance)


def reference(objective: Objective, mean: np.ndarray, std: np.ndarray, uniforms: torch.Tensor, epsilon) -> float:
    """The literal likelihood of every transition under the same samples, one transition at a time."""
    values = objective.values(mean[None], std[None], uniforms)[0]
    simulated = objective.simulated(values).numpy()
    return sum(literal(s, m, epsilon) for s, m in zip(simulated, objective.transitions.measured, strict=True))


def hopper_objective(
    model: mujoco.MjModel, *, lag: int = 1, threads: int = 0, number: int = 25, **options
) -> Objective:
    space = masses(model)
    simulator = MujocoSimulator(model, parameters=space, frame_skip=4, num_threads=threads)
    observation = parse_observation(model, ["qpos[1:]", "qvel"])
    states, controls = hopper_states(model, number), random_controls(model, number, lag)
    states[:, 0] = 0
    measured = simulator.simulate(states, controls, torch.from_numpy(1.1 * space.nominal[None]))[:, 0, 1:]
    return Objective(simulator, windows(states, controls, measured), observation, **options)


def middle(objective: Objective) -> tuple[np.ndarray, np.ndarray]:
    return objective.box.middle, objective.box.width / 10


def evaluate(objective: Objective, uniforms: torch.Tensor, *phi: np.ndarray, initial=None) -> float:
    mean, std = phi or middle(objective)
    return objective.evaluate(mean[None], std[None], uniforms, initial)[0].log_likelihood


@given(st.integers(1, 6), st.integers(2, 30), st.integers(0, 10_000), st.floats(1e-3, 1e2))
def test_the_likelihood_is_that_of_equations_2_and_3(n, num_samples, seed, epsilon):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(3, num_samples, n)) @ rng.normal(size=(n, n)) * rng.uniform(0.1, 10, n)
    measured = samples.mean(1) + rng.normal(size=(3, n))
    per_column = epsilon * rng.uniform(0.5, 2, n)
    for noise in (epsilon, per_column):
        ours = log_likelihood(torch.from_numpy(samples), torch.from_numpy(measured), noise)
        theirs = [literal(s, m, noise) for s, m in zip(samples, measured, strict=True)]
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("lag", [1, 3])
@pytest.mark.parametrize("epsilon", [1e-5, np.linspace(1e-4, 1e-2, 11)])
def test_on_the_hopper_it_is_the_literal_likelihood(hopper, lag, epsilon):
    objective = hopper_objective(hopper, lag=lag, epsilon=epsilon)
    mean, std = middle(objective)
    uniforms = draw_uniforms(20, 4, 0)
    found = objective.evaluate(mean[None], std[None], uniforms)[0]
    assert found.log_likelihood == pytest.approx(reference(objective, mean, std, uniforms, epsilon), rel=1e-8)
    simulated = objective.simulated(objective.values(mean[None], std[None], uniforms)[0]).numpy()
    assert found.mse == pytest.approx(((simulated.mean(1) - objective.transitions.measured) ** 2).mean(), rel=1e-9)
    assert (found.diverged, found.simulated_transitions) == (0, 25 * 20 * lag)


def test_several_phi_evaluated_together_are_those_evaluated_alone(hopper):
    objective = hopper_objective(hopper)
    mean, std = middle(objective)
    means, stds = np.stack([mean, 1.1 * mean, mean]), np.stack([std, std, 0.1 * std])
    uniforms = draw_uniforms(10, 4, 0)
    together = objective.evaluate(means, stds, uniforms)
    for i, one in enumerate(together):
        alone = objective.evaluate(means[i : i + 1], stds[i : i + 1], uniforms)[0]
        assert one.log_likelihood == pytest.approx(alone.log_likelihood, rel=1e-12)
    assert together[0].log_likelihood != together[2].log_likelihood
    own = torch.stack([draw_uniforms(10, 4, i) for i in range(3)])
    assert objective.evaluate(means, stds, own)[2].log_likelihood == pytest.approx(
        objective.evaluate(means[2:], stds[2:], own[2])[0].log_likelihood, rel=1e-12
    )


def test_the_size_of_chunks_does_not_matter(hopper):
    uniforms = draw_uniforms(10, 4, 0)
    expected = evaluate(hopper_objective(hopper), uniforms)
    for size in (1, 7, 30, 10**6):
        assert evaluate(hopper_objective(hopper, chunk_size=size), uniforms) == pytest.approx(expected, rel=1e-12)


def test_the_number_of_threads_does_not_matter_to_the_bit(hopper):
    uniforms = draw_uniforms(10, 4, 0)
    before = torch.get_num_threads()
    found = set()
    try:
        for torch_threads in (1, 2):
            for threads in (1, 2):
                torch.set_num_threads(torch_threads)
                found.add(evaluate(hopper_objective(hopper, threads=threads, number=60), uniforms))
                assert torch.get_num_threads() == torch_threads
    finally:
        torch.set_num_threads(before)
    assert len(found) == 1


def test_masked_columns_leave_the_likelihood(hopper):
    keep = [0, 1, 3, 4, 6, 7, 8, 9]
    masked = hopper_objective(hopper, mask=["thigh_joint.position", 5, "foot_joint.velocity"])
    assert masked.features.size == len(masked.features.labels) == len(masked.features.units) == 8
    mean, std = middle(masked)
    uniforms = draw_uniforms(15, 4, 0)
    simulated = masked.simulated(masked.values(mean[None], std[None], uniforms)[0]).numpy()[..., keep]
    theirs = sum(literal(s, m, 1e-5) for s, m in zip(simulated, masked.transitions.measured[:, keep], strict=True))
    assert evaluate(masked, uniforms) == pytest.approx(theirs, rel=1e-8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"mask": ["thigh_joint.positon"]},
            "no observed column 'thigh_joint.positon'; did you mean 'thigh_joint.position'",
        ),
        ({"mask": [11]}, "no observed column 11"),
        ({"mask": list(range(11))}, "every column is masked"),
        ({"epsilon": 0.0}, "epsilon: 0.0 given; expected positive"),
        ({"epsilon": [1e-5] * 10}, "epsilon: 10 values given; expected one, or one per feature: rootz"),
        ({"epsilon": [1e-5] * 10 + [np.nan]}, "expected positive numbers"),
        ({"epsilon": "small"}, "epsilon: 'small' given"),
        ({"noise": -1.0}, "noise: -1.0 given; expected numbers of at least 0"),
        ({"noise": [1.0]}, "noise: 1 values given; expected one, or one per column"),
    ],
)
def test_options_that_cannot_be_are_refused(hopper, options, message):
    with pytest.raises(InputError, match=message):
        hopper_objective(hopper, **options)


def scaled_objective(factor: np.ndarray, **options) -> Objective:
    """Two parameters seen through three columns, measured in units of 1/factor."""
    effect = np.array([[1.0, 0.2], [-0.3, 2.0], [0.5, 0.5]])
    measured = np.random.default_rng(0).normal(size=(30, 2)) * 0.3 @ effect.T + effect @ [1.0, 1.0]
    measured += np.random.default_rng(1).normal(0, 0.05, (30, 3))
    simulator = LinearSimulator(space_of(a=[0, 2], b=[0, 2]), factor[:, None] * effect)
    return linear_objective(simulator, factor * measured, **options)


def test_with_scaling_the_units_of_a_column_do_not_matter():
    uniforms = draw_uniforms(20, 2, 0)
    factor = np.array([1e3, 0.2, 7.0])
    expected = evaluate(scaled_objective(np.ones(3), scaling=True, epsilon=1e-3), uniforms)
    assert evaluate(scaled_objective(factor, scaling=True, epsilon=1e-3), uniforms) == pytest.approx(expected, rel=1e-9)
    assert evaluate(scaled_objective(factor, epsilon=1e-3), uniforms) != pytest.approx(expected, rel=1e-2)


def test_a_change_of_units_with_its_epsilon_changes_the_density_by_the_jacobian():
    uniforms = draw_uniforms(20, 2, 0)
    factor, epsilon = np.array([1e2, 0.2, 7.0]), np.array([1e-3, 2e-3, 3e-3])
    expected = evaluate(scaled_objective(np.ones(3), epsilon=epsilon), uniforms) - 30 * np.log(factor).sum()
    ours = evaluate(scaled_objective(factor, epsilon=epsilon * factor**2), uniforms)
    assert ours == pytest.approx(expected, rel=1e-9)


def test_a_column_that_never_changes_can_be_scaled():
    simulator = LinearSimulator(space_of(a=[0, 2]), np.array([[1.0], [0.0]]))
    objective = linear_objective(simulator, np.array([[1.0, 5.0], [1.2, 5.0]]), scaling=True)
    assert objective.features.scale.tolist() == pytest.approx([0.1, 1.0])


def box_objective(**options) -> Objective:
    """A thrown box, measured by its pose: inertia decides how it turns."""
    model = compiled(BOX_XML)
    space = ParameterSpace(
        model,
        {
            "x": {"field": "body_inertia[0]", "name": "box", "bounds": [0.003, 0.008]},
            "y": {"field": "body_inertia[1]", "name": "box", "bounds": [0.004, 0.010]},
            "lift": {"field": "body_gravcomp", "name": "box", "bounds": [0, 0.5]},
        },
    )
    simulator = MujocoSimulator(model, parameters=space, frame_skip=10)
    states, controls = random_states(model, 15, height=3.0), random_controls(model, 15, 1)
    states[:, 2] += 1
    states[:, 8 + 3 : 8 + 6] *= 8  # spinning
    measured = simulator.simulate(states, controls, torch.tensor([[0.005, 0.006, 0.1]], dtype=torch.float64))[:, 0, :7]
    observation = parse_observation(model, ["root.position"])
    full = windows(states, controls, measured)
    return Objective(simulator, full, observation, **options)


def test_as_in_the_paper_an_orientation_enters_by_its_angle_with_both_signs_measured_zero():
    """Of the angle's sample alone: that of the position is as it is."""
    objective = box_objective(epsilon=1e-4, orientation="angle")
    assert objective.features.labels[3:] == tuple(f"root.position.rotation[{a}]" for a in "xyz")
    mean, std = middle(objective)
    uniforms = draw_uniforms(25, 3, 0)
    simulated = objective.simulated(objective.values(mean[None], std[None], uniforms)[0]).numpy()
    theirs = 0.0
    for samples, measured in zip(simulated, objective.transitions.measured, strict=True):
        cosine = np.abs(samples[:, 3:] @ measured[3:]) / np.linalg.norm(samples[:, 3:], axis=1)
        angle = 2 * np.arccos(np.clip(cosine, 0, 1))[:, None]
        theirs += literal(samples[:, :3], measured[:3], 1e-4) + literal(np.vstack([angle, -angle]), np.zeros(1), 1e-4)
    assert evaluate(objective, uniforms) == pytest.approx(theirs, rel=1e-8)


def turned_world(objective: Objective, model: mujoco.MjModel, turn: np.ndarray, **options) -> Objective:
    """The same motions seen in a world turned by a unit quaternion: gravity, positions, velocities, orientations."""
    model = copy.copy(model)
    model.opt.gravity = rotated(turn, model.opt.gravity)
    space = ParameterSpace(model, SPINNING)
    log = objective.transitions
    states, measured = log.states.copy(), log.measured.copy()
    states[:, 7:10] = rotated(turn, states[:, 7:10])  # a free body's angular velocity is in its own frame
    for rows in (states, measured):
        rows[:, :3], rows[:, 3:7] = rotated(turn, rows[:, :3]), product(turn, rows[:, 3:7])
    simulator = MujocoSimulator(model, parameters=space, frame_skip=10)
    moved = windows(torch.from_numpy(states), torch.from_numpy(log.controls), measured)
    return Objective(simulator, moved, parse_observation(model, ["qpos"]), **options)


def rotated(turn: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return scipy.spatial.transform.Rotation.from_quat(turn, scalar_first=True).apply(vectors)


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    w0, v0, w1, v1 = first[0], first[1:], second[:, :1], second[:, 1:]
    return np.hstack([w0 * w1 - v1 @ v0[:, None], w0 * v1 + w1 * v0 + np.cross(v0, v1)])


#: A body in the air: nothing but gravity pulls.
FLYING_XML = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="top"><freejoint/><inertial mass="1.5" pos="0 0 0" diaginertia=".005 .006 .009"/></body>
  </worldbody>
</mujoco>"""
SPINNING = {
    "x": {"field": "body_inertia[0]", "name": "top", "bounds": [0.003, 0.008]},
    "y": {"field": "body_inertia[1]", "name": "top", "bounds": [0.004, 0.010]},
}


def flying_objective(seed: int, **options) -> tuple[Objective, mujoco.MjModel]:
    """A spinning body, measured with noise that is as large in every direction."""
    model, generator = compiled(FLYING_XML), np.random.default_rng(seed)
    simulator = MujocoSimulator(model, parameters=ParameterSpace(model, SPINNING), frame_skip=10)
    states = random_states(model, 12, seed)
    states[:, 10:] *= 8
    controls = torch.zeros(12, 1, 0, dtype=torch.float64)
    truth = torch.tensor([[0.005, 0.006]], dtype=torch.float64)
    measured = simulator.simulate(states, controls, truth)[:, 0, :7].numpy()
    measured[:, :3] += generator.normal(0, 0.02, (12, 3))
    for row, noise in zip(measured, generator.normal(0, 0.05, (12, 3)), strict=True):
        mujoco.mju_quatIntegrate(row[3:], noise, 1.0)
    return Objective(
        simulator, windows(states, controls, measured), parse_observation(model, ["qpos"]), **options
    ), model


@pytest.mark.parametrize("orientation", ["rotation_vector", "angle"])
@pytest.mark.parametrize("noise", [None, [0, 0, 0, 0.02, 0.02, 0.02, 0.02]])
@given(seed=st.integers(0, 1000), turn=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(np.any))
@hypothesis.settings(max_examples=10)
def test_in_a_turned_world_the_likelihood_is_the_same(orientation, noise, seed, turn):
    options = {"epsilon": 1e-4, "orientation": orientation, "noise": noise}
    objective, model = flying_objective(seed, **options)
    other = turned_world(objective, model, np.array(turn) / np.linalg.norm(turn), **options)
    mean, std, uniforms = *middle(objective), draw_uniforms(15, 2, seed)
    ours, theirs = (
        o.evaluate(mean[None], 2 * std[None], uniforms, o.initial_noise(mean, widen=False))[0]
        for o in (objective, other)
    )
    assert ours.log_likelihood == pytest.approx(theirs.log_likelihood, rel=1e-8, abs=1e-6)
    assert ours.gaussian == pytest.approx(theirs.gaussian, rel=1e-8, abs=1e-6)


def test_the_same_noise_of_an_orientation_counts_the_same_about_every_axis():
    """Of a spread about one axis, as much is explained whichever axis of the body it is."""
    found = []
    for axis in ([1, 0, 0], [0, 1, 0], [0.6, 0, -0.8], [3**-0.5] * 3):
        turn = torch.tensor(axis, dtype=torch.float64)
        samples = torch.linspace(-0.2, 0.2, 20, dtype=torch.float64)[:, None] * turn
        base = 0.1**2 * torch.outer(turn, turn) + 1e-4 * torch.eye(3)
        values = likelihood_with_losses(samples[None, None], 0.15 * turn[None, None], base[None, None], 0)
        found.append(float(values[0]))
    np.testing.assert_allclose(found, found[0], rtol=1e-9)


def test_how_an_orientation_enters_does_not_touch_other_columns():
    both = [slide_objective(None, orientation=way)[0] for way in ("rotation_vector", "angle")]
    assert len({evaluate(o, draw_uniforms(10, 1, 0), np.array([2.0]), np.array([0.1])) for o in both}) == 1
    with pytest.raises(InputError, match="orientation: unknown 'angel'; did you mean 'angle'"):
        box_objective(orientation="angel")


@pytest.mark.parametrize("orientation", ["rotation_vector", "angle"])
def test_the_likelihood_of_orientations_is_differentiable(orientation):
    objective = box_objective(epsilon=1e-4, orientation=orientation)
    reduce = objective.likelihood()
    simulated = objective.evaluator.after(slice(0, 2), objective.values(*(x[None] for x in middle(objective)),
                                                                       draw_uniforms(6, 3, 0))[0])  # fmt: skip
    target, base = objective.target(slice(0, 2)), objective.base_covariance(slice(0, 2))
    leaf = simulated.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: reduce(x, target, base)[0], (leaf,), eps=1e-7, atol=1e-3, rtol=1e-4)


def test_the_sign_of_a_measured_quaternion_does_not_matter():
    objective = box_objective()
    flipped = objective.transitions.measured.copy()
    flipped[::2, 3:] *= -1
    transitions = windows(
        torch.from_numpy(objective.transitions.states), torch.from_numpy(objective.transitions.controls), flipped
    )
    uniforms = draw_uniforms(10, 3, 0)
    assert evaluate(objective.on(transitions), uniforms) == pytest.approx(evaluate(objective, uniforms), rel=1e-12)


def test_masking_one_column_of_a_quaternion_masks_the_orientation():
    assert box_objective(mask=["root.position[qx]"]).features.labels == tuple(f"root.position[{a}]" for a in "xyz")


def chained(model: mujoco.MjModel, states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    space = masses(model, [model.body(i).name for i in range(1, model.nbody)])
    simulator = MujocoSimulator(model, parameters=space, frame_skip=3)
    controls = random_controls(model, len(states), 2)
    values = torch.from_numpy(space.low + np.array([[0.2], [0.7]]) * (space.high - space.low))
    once = simulator.simulate(states, controls, values)
    after = simulator.simulate(states, controls[:, :1], values)
    twice = [simulator.simulate(after[:, k], controls[:, 1:], values[k : k + 1])[:, 0] for k in range(2)]
    return once, torch.stack(twice, 1)


def test_two_steps_are_one_step_after_another(hopper):
    arm = compiled(ARM_XML.replace('dyntype="filterexact" dynprm=".05"', ""))
    once, twice = chained(arm, random_states(arm, 6))
    torch.testing.assert_close(once, twice, rtol=0, atol=0)
    once, twice = chained(hopper, hopper_states(hopper, 20))  # the solver starts warm at the second of two steps
    torch.testing.assert_close(once, twice, rtol=1e-4, atol=1e-5)


class Fragile(LinearSimulator):
    """Diverges where a parameter exceeds 1, on the first transition only."""

    def rollout(self, states, controls, values):
        out = super().rollout(states, controls, values)
        out[states[:, 0] == 7, :] = torch.where(
            (values[:, 0] > 1)[None, :, None, None], torch.nan, out[states[:, 0] == 7]
        )
        return out


def fragile_objective() -> Objective:
    simulator = Fragile(space_of(a=[0, 2]), np.array([[1.0], [0.5]]))
    states = torch.zeros(3, 2, dtype=torch.float64)
    states[0, 0] = 7
    measured = np.array([[1.0, 0.4], [0.9, 0.5], [1.1, 0.6]])
    transitions = windows(states, torch.zeros(3, 1, 1, dtype=torch.float64), measured)
    return Objective(simulator, transitions, generic_observation(2), epsilon=1e-2)


def test_diverged_samples_are_counted_and_the_rest_still_count():
    objective = fragile_objective()
    mean, std, uniforms = np.array([1.0]), np.array([0.2]), draw_uniforms(20, 1, 0)
    values = objective.values(mean[None], std[None], uniforms)[0].numpy()
    lost = int((values > 1).sum())
    assert 2 < lost < 18
    samples = values * np.array([1.0, 0.5])
    measured = objective.transitions.measured
    theirs = literal(samples[values[:, 0] <= 1], measured[0], 1e-2)
    theirs += literal(samples, measured[1], 1e-2) + literal(samples, measured[2], 1e-2)
    found = objective.evaluate(mean[None], std[None], uniforms)[0]
    assert found.log_likelihood == pytest.approx(theirs, rel=1e-9)
    assert found.diverged == lost


def test_a_transition_whose_samples_all_diverge_is_lost_and_the_log_has_no_likelihood():
    objective = fragile_objective()
    uniforms = draw_uniforms(20, 1, 0)
    found = objective.evaluate(np.array([[1.5], [0.5]]), np.full((2, 1), 0.01), uniforms)
    samples = objective.values(np.array([[1.5]]), np.array([[0.01]]), uniforms)[0].numpy() * [1.0, 0.5]
    rest = sum(literal(samples, m, 1e-2) for m in objective.transitions.measured[1:])
    assert found[0].log_likelihood == found[0].gaussian == -np.inf
    assert found[0].remaining == pytest.approx(rest, rel=1e-9)
    assert [f.diverged for f in found] == [20, 0]
    assert found[1].log_likelihood == found[1].remaining == found[1].gaussian


def test_a_covariance_that_rounding_left_indefinite_still_has_a_density():
    vector = torch.tensor([1e4, 1.0, 1e-4], dtype=torch.float64)
    flat = torch.outer(vector, vector) - 1e-12 * torch.eye(3, dtype=torch.float64)
    assert torch.isfinite(gaussian_log_density(torch.ones(3, dtype=torch.float64), flat))
    fine = torch.tensor([[2.0, 0.3], [0.3, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(
        robust_cholesky(torch.stack([fine, -1e-9 * torch.eye(2)]).double())[0],
        torch.linalg.cholesky(fine),
        rtol=0,
        atol=0,
    )


def slide_objective(noise, *, lag: int = 2, epsilon: float = 1e-6, **options) -> tuple[Objective, np.ndarray]:
    """A block on a spring, and the matrix G that takes its start state to its end state."""
    model = compiled(SLIDE_XML)
    space = ParameterSpace(model, {"mass": {"field": "body_mass", "name": "block", "bounds": [1, 4]}})
    simulator = MujocoSimulator(model, parameters=space, frame_skip=3)
    states, controls = random_states(model, 8), random_controls(model, 8, lag)
    measured = simulator.simulate(states, controls, torch.tensor([[2.0]], dtype=torch.float64))[:, 0]
    observation = parse_observation(model, None)
    h, pull = 0.01, 30 / 2.0
    step = np.array([[1 - h * h * pull, h], [-h * pull, 1]])  # semi-implicit Euler
    objective = Objective(
        simulator, windows(states, controls, measured), observation, noise=noise, epsilon=epsilon, **options
    )
    return objective, np.linalg.matrix_power(step, 3 * lag)


@pytest.mark.parametrize("lag", [1, 4])
@pytest.mark.parametrize("chunk_size", [1, 5, 10_000])
def test_start_noise_goes_through_the_simulation_exactly_where_it_is_linear(lag, chunk_size):
    noise = np.array([0.02, 0.3])
    objective, matrix = slide_objective(noise, lag=lag, chunk_size=chunk_size)
    initial = objective.initial_noise(np.array([2.0]))
    expected = matrix @ np.diag(noise**2) @ matrix.T + np.diag(noise**2) + 1e-6 * np.eye(2)
    for block in (slice(0, 8), slice(3, 5)):
        np.testing.assert_allclose(
            objective.base_covariance(block, initial),
            np.tile(expected, (block.stop - block.start, 1, 1)),
            rtol=1e-10,
            atol=1e-13,
        )
    assert initial.mean == [2.0]
    torch.testing.assert_close(objective.target(slice(0, 8), initial), objective.measured, rtol=0, atol=1e-12)


def test_a_window_that_the_noise_does_not_explain_is_widened_as_under_students_law():
    noise = np.array([0.02, 0.3])
    exact, matrix = slide_objective(noise)
    measured = exact.transitions.measured.copy()
    measured[2] += [0.5, -4.0]
    states, controls = (torch.from_numpy(x) for x in (exact.transitions.states, exact.transitions.controls))
    objective = exact.on(windows(states, controls, measured))
    initial = objective.initial_noise(np.array([2.0]))
    covariance = matrix @ np.diag(noise**2) @ matrix.T + np.diag(noise**2) + 1e-6 * np.eye(2)
    distance = [0.5, -4.0] @ np.linalg.inv(covariance) @ [0.5, -4.0]
    found = objective.base_covariance(slice(0, 8), initial)
    np.testing.assert_allclose(found[2], covariance * (5 + distance) / (5 + 2), rtol=1e-9)
    np.testing.assert_allclose(found[3], covariance, rtol=1e-9)


def test_with_noisy_starts_the_objective_is_students_under_the_noise_as_it_is_given_with_eq_3_beside_it():
    noise = np.array([0.02, 0.3])
    objective, _ = slide_objective(noise)
    measured = objective.transitions.measured.copy()
    measured[2] += [0.5, -4.0]  # far outside: the Gaussian likelihood would widen its covariance
    states, controls = (torch.from_numpy(x) for x in (objective.transitions.states, objective.transitions.controls))
    objective = objective.on(windows(states, controls, measured))
    mean, std, uniforms = np.array([2.1]), np.array([0.3]), draw_uniforms(12, 1, 0)
    values = objective.values(mean[None], std[None], uniforms)[0]
    base = matrix_at(objective, mean) + np.diag(noise**2) + 1e-6 * np.eye(2)
    theirs, eq3 = 0.0, 0.0
    for samples, logged in zip(objective.simulated(values).numpy(), measured, strict=True):
        scale = base + np.cov(samples, rowvar=False)
        theirs += scipy.stats.multivariate_t.logpdf(logged - samples.mean(0), shape=scale, df=5)
        eq3 += scipy.stats.multivariate_normal.logpdf(logged, samples.mean(0), scale)
    found = objective.evaluate_values(values[None], objective.initial_noise(mean, widen=False))[0]
    assert found.log_likelihood == pytest.approx(theirs, rel=1e-9)
    assert found.gaussian == pytest.approx(eq3, rel=1e-9)


def matrix_at(objective: Objective, mean: np.ndarray) -> np.ndarray:
    """What the starts' noise becomes at μ: a block on a spring is linear."""
    h, pull = 0.01, 30 / mean[0]
    step = np.linalg.matrix_power(np.array([[1 - h * h * pull, h], [-h * pull, 1]]), 6)
    return step @ np.diag(objective.noise.numpy() ** 2) @ step.T


@pytest.mark.parametrize("scaling", [False, True])
def test_the_noise_of_columns_gives_every_feature_its_variance(scaling):
    """Also of a box's pose, whose orientation turns by twice its quaternion's noise."""
    objective = box_objective(scaling=scaling)
    noise = objective.noise_of(4e-6)
    assert len(noise) == 7
    given = box_objective(scaling=scaling, noise=noise)
    np.testing.assert_allclose(given.feature_noise, np.full(6, 2e-3), rtol=1e-12)
    masked = box_objective(scaling=scaling, mask=["root.position[qw]"])
    np.testing.assert_allclose(masked.noise_of(4e-6), noise)  # its start is as noisy


def test_start_noise_follows_scaling_and_masks():
    noise = np.array([0.02, 0.3])
    scaled, matrix = slide_objective(noise, scaling=True)
    initial = scaled.initial_noise(np.array([2.0]))
    expected = matrix @ np.diag(noise**2) @ matrix.T + np.diag(noise**2)
    size = np.outer(scaled.features.scale, scaled.features.scale)
    np.testing.assert_allclose(
        scaled.base_covariance(slice(0, 1), initial)[0], expected / size + 1e-6 * np.eye(2), rtol=1e-10
    )
    masked, _ = slide_objective(noise, mask=[0])
    initial = masked.initial_noise(np.array([2.0]))
    assert float(masked.base_covariance(slice(0, 1), initial)) == pytest.approx(expected[1, 1] + 1e-6, rel=1e-10)


def test_before_the_first_linearization_the_noise_is_that_of_the_measured_end():
    objective, _ = slide_objective([0.02, 0.3])
    np.testing.assert_allclose(
        torch.diagonal(objective.base_covariance(slice(0, 8)), dim1=1, dim2=2),
        np.tile([4e-4 + 1e-6, 0.09 + 1e-6], (8, 1)),
    )


def test_evaluations_do_not_interfere_whatever_their_order():
    objective, _ = slide_objective([0.02, 0.3], epsilon=1e-3)
    uniforms, std = draw_uniforms(10, 1, 0), np.array([0.2])
    noises = [None, objective.initial_noise(np.array([1.5])), objective.initial_noise(np.array([3.0]), std)]
    kept = [(n.shift.clone(), n.covariance.clone(), n.widening.clone()) for n in noises[1:]]
    before = dict(vars(objective))

    def value(which: int) -> float:
        return evaluate(objective, uniforms, np.array([2.0]), std, initial=noises[which])

    first = [value(i) for i in (0, 1, 2)]
    assert len(set(first)) == 3
    evaluate(objective, uniforms, np.array([2.5]), std, initial=objective.initial_noise(np.array([2.5]), widen=False))
    assert [value(i) for i in (2, 1, 2, 0)] == [first[i] for i in (2, 1, 2, 0)]
    again = objective.initial_noise(np.array([1.5]))
    for found in (again, noises[1]):
        for ours, theirs in zip((found.shift, found.covariance, found.widening), kept[0], strict=True):
            assert torch.equal(ours, theirs)
    assert vars(objective) == before
    assert again.is_at(np.array([1.5]), None)
    assert not again.is_at(np.array([1.5]), std)
    assert not again.is_at(np.array([1.5]), None, widen=False)
    assert noises[2].is_at(np.array([3.0]), std.copy())


@pytest.mark.parametrize("noise", [None, [0.02, 0.3]])
def test_what_an_evaluation_takes_is_what_the_simulator_did(noise, monkeypatch):
    objective, _ = slide_objective(noise, lag=3, chunk_size=5)
    simulate, done = objective.simulator.simulate, []

    def counting(states, controls, values):
        done.append(len(states) * controls.shape[1] * len(values))
        return simulate(states, controls, values)

    monkeypatch.setattr(objective.simulator, "simulate", counting)
    initial = objective.initial_noise(np.array([2.0]), np.array([0.1]))
    assert (0 if initial is None else initial.simulated_transitions) == sum(done)
    done.clear()
    found = objective.evaluate(np.full((2, 1), 2.0), np.full((2, 1), 0.1), draw_uniforms(7, 1, 0), initial)
    assert sum(f.simulated_transitions for f in found) == sum(done) == 2 * 7 * 8 * 3
    done.clear()
    sums = objective.map(np.full((4, 1), 2.0), objective.likelihood(), np.array([1, 5, 7]))
    assert sums.simulated_transitions == sum(done) == 4 * 3 * 3


def test_no_noise_and_noise_of_zero_are_the_same():
    uniforms = draw_uniforms(10, 1, 0)
    values = []
    for noise in (None, 0.0, [0.0, 0.0]):
        objective, _ = slide_objective(noise)
        assert objective.initial_noise(np.array([2.0])) is None
        values.append(evaluate(objective, uniforms, np.array([2.0]), np.array([0.1])))
    assert len(set(values)) == 1


def test_noise_enters_eq_3_as_a_covariance():
    objective, _ = slide_objective([0.02, 0.3])
    initial = objective.initial_noise(np.array([2.0]))
    mean, std, uniforms = np.array([2.1]), np.array([0.3]), draw_uniforms(12, 1, 0)
    simulated = objective.simulated(objective.values(mean[None], std[None], uniforms)[0]).numpy()
    base = objective.base_covariance(slice(0, 8), initial).numpy()
    theirs = sum(
        scipy.stats.multivariate_normal.logpdf(m, s.mean(0), np.cov(s, rowvar=False) + c)
        for s, m, c in zip(simulated, objective.transitions.measured, base, strict=True)
    )
    found = objective.evaluate(mean[None], std[None], uniforms, initial)[0]
    assert found.gaussian == pytest.approx(theirs, rel=1e-9)


def dead(objective: Objective) -> list[str]:
    return no_effect(objective)[0]


def box_on_floor(parameters: dict) -> Objective:
    model = compiled(BOX_XML)
    simulator = MujocoSimulator(model, parameters=ParameterSpace(model, parameters), frame_skip=5)
    states = random_states(model, 700, height=1.0)
    states[:, 2] += 2  # in the air, but for a few that lie on the floor, outside the coarse look
    states[601:604] = torch.from_numpy(np.concatenate([model.qpos0, np.zeros(model.nv)]))
    states[601:604, 2], states[601:604, 8] = 0.0599, 1.0
    measured = np.zeros((700, model.nq + model.nv))
    measured[:, 3] = 1
    return Objective(
        simulator, windows(states, random_controls(model, 700, 1), measured), parse_observation(model, None)
    )


def test_parameters_that_move_nothing_are_named_and_those_that_do_are_not():
    friction = {"field": "geom_friction", "bounds": [0.1, 1]}
    objective = box_on_floor(
        {
            "sliding": {**friction, "name": "box"},
            "untouched": {**friction, "name": "far"},
            "mass": {"field": "body_mass", "name": "far", "bounds": [0.1, 1]},
            "free_fall": {"field": "opt.magnetic[0]", "bounds": [1, 2]},
        }
    )
    assert dead(objective) == ["untouched", "free_fall"]


def test_a_parameter_that_only_moves_masked_columns_has_no_effect():
    simulator = LinearSimulator(space_of(a=[0, 2], b=[0, 2]), np.eye(2))
    measured = np.ones((5, 2))
    assert dead(linear_objective(simulator, measured)) == []
    assert dead(linear_objective(simulator, measured, mask=[1])) == ["b"]


def test_draws_depend_on_their_seeds_alone():
    torch.manual_seed(0)
    first = draw_uniforms(5, 2, 3, 4)
    torch.manual_seed(1)
    assert torch.equal(draw_uniforms(5, 2, 3, 4), first)
    assert not torch.equal(draw_uniforms(5, 2, 4, 3), first)


def test_a_parameter_whose_effect_is_even_about_its_middle_is_no_dead_one() -> None:
    simulator = LinearSimulator(space_of(a=[-1, 1], b=[-1, 1]), np.eye(2), transform=lambda v: v.square())
    assert dead(linear_objective(simulator, np.zeros((5, 2)))) == []
    half = LinearSimulator(space_of(a=[-1, 1], b=[-1, 1]), np.array([[1.0, 0.0], [1.0, 0.0]]), transform=torch.square)
    assert dead(linear_objective(half, np.zeros((5, 2)))) == ["b"]
