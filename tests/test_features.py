"""Laws of the features that are compared: what moves them, what undoes that, and what masks leave."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from conftest import BOX_XML
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dropo_torch.data.features import Features, masked_columns, rotation_vector
from dropo_torch.data.observation import Observation, generic_observation, parse_observation
from dropo_torch.errors import InputError


@pytest.fixture(scope="module")
def box() -> Observation:
    """A free body beside a hinge."""
    return parse_observation(mujoco.MjModel.from_xml_string(BOX_XML), ["qpos", "qvel"])


def random_columns(observation: Observation, *shape: int) -> np.ndarray:
    columns = np.random.default_rng(0).standard_normal((*shape, observation.size))
    for q in observation.quaternions:
        columns[..., list(q)] /= np.linalg.norm(columns[..., list(q)], axis=-1, keepdims=True)
    return columns


def some_scale(features: Features) -> Features:
    """The features in other units, rotations as they are."""
    return replace(features, scale=np.append(np.geomspace(0.1, 10, len(features.plain)), np.ones(3)))


def same(features: Features, first: np.ndarray, second: np.ndarray) -> bool:
    """Whether columns are equal, orientations up to the quaternion's sign."""
    plain = np.allclose(first[..., list(features.plain)], second[..., list(features.plain)], atol=1e-12)
    inner = [np.abs((first[..., list(q)] * second[..., list(q)]).sum(-1)) for q in features.quaternions]
    return plain and all(np.allclose(i, 1.0, atol=1e-12) for i in inner)


@pytest.mark.parametrize("scaled", [False, True])
def test_move_undoes_difference(box: Observation, scaled: bool) -> None:
    features, (start, end) = Features.of(box), random_columns(box, 2, 50)
    features = some_scale(features) if scaled else features
    assert features.size == start.shape[-1] - 1 == len(features.labels) == len(features.units)
    assert same(features, features.move(start, features.difference(end, start)), end)
    assert np.all(features.difference(start, start) == 0)


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5])
def test_difference_undoes_move(box: Observation, size: float, scaled: bool) -> None:
    features, start = Features.of(box), random_columns(box, 50)
    features = some_scale(features) if scaled else features
    delta = size * np.random.default_rng(1).standard_normal((3, 50, features.size))
    found = features.difference(features.move(start, delta), start)
    assert found == pytest.approx(delta, abs=(1e-14 if not scaled else 1e-13) + 1e-9 * size)


def test_difference_ignores_the_sign_of_quaternions(box: Observation) -> None:
    features, (start, end) = Features.of(box), random_columns(box, 2, 50)
    flipped = end.copy()
    for q in features.quaternions:
        flipped[..., list(q)] *= -1
    assert features.difference(flipped, start) == pytest.approx(features.difference(end, start), abs=1e-12)


def test_values_and_differences_are_of_the_same_features(box: Observation) -> None:
    """Of a measured orientation about itself there is nothing left; the simulated one is turned away from it."""
    features, (measured, simulated) = some_scale(Features.of(box)), random_columns(box, 2, 50)
    about, other = torch.from_numpy(measured), torch.from_numpy(simulated)
    ours = (features.values(other, about) - features.values(about, about)).numpy()
    theirs = features.difference(simulated, measured)
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_what_diverged_is_different_from_everything(box: Observation) -> None:
    features, (start, end) = Features.of(box), random_columns(box, 2, 4)
    end[1] = np.nan
    found = features.difference(start, end)
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 2, 3]]).all()


def test_masked_columns_are_never_known_and_not_compared(box: Observation) -> None:
    masked = masked_columns(box, ["hang.position", 4, "root.velocity[vx]"])
    assert masked == {box.labels.index("hang.position"), *box.quaternions[0], box.labels.index("root.velocity[vx]")}
    every = Features.of(box, masked)
    known = every.known(np.ones((3, box.size), bool))
    compared = some_scale(every).compared()
    assert compared.labels == tuple(np.array(every.labels)[known[0]])
    assert compared.units == tuple(np.array(every.units)[known[0]])
    assert (compared.scale == some_scale(every).scale[known[0]]).all()
    assert compared.quaternions == ()
    assert (compared.compared().labels, compared.masked) == (compared.labels, frozenset())
    measured, simulated = random_columns(box, 2, 5)
    np.testing.assert_array_equal(
        compared.difference(measured, simulated), some_scale(every).difference(measured, simulated)[:, known[0]]
    )
    assert not every.known(np.zeros((3, box.size), bool)).any()


def test_an_unknown_column_of_a_quaternion_leaves_the_rotation_unknown(box: Observation) -> None:
    valid = np.ones(box.size, bool)
    valid[box.quaternions[0][2]] = False
    unknown = np.array(Features.of(box).labels)[~Features.of(box).known(valid)]
    assert list(unknown) == [f"root.position.rotation[{a}]" for a in "xyz"]


def test_something_is_to_be_compared() -> None:
    with pytest.raises(InputError, match="every column is masked"):
        Features.of(generic_observation(2), frozenset({0, 1})).compared()


def test_scales_are_those_of_the_log_and_a_column_that_never_changes_keeps_its_own(box: Observation) -> None:
    columns = random_columns(box, 30)
    columns[:, 0] = 5.0
    features = Features.of(box).scaled(columns)
    assert features.scale[0] == 1.0
    np.testing.assert_allclose(features.scale[1:-3], columns[:, list(features.plain)].std(0)[1:], rtol=1e-12)
    assert features.scale[-3:].tolist() == [1.0] * 3


def test_noise_of_columns_is_that_of_features(box: Observation) -> None:
    """Of a quaternion's four columns, which stand between others, to three rotations and back."""
    columns = np.full(box.size, 0.3)
    columns[list(box.quaternions[0])] = 0.02
    features = Features.of(box)
    assert features.feature_noise(columns) == pytest.approx([0.3] * (features.size - 3) + [0.04] * 3)
    for kind in (features, some_scale(features)):
        assert kind.column_noise(kind.feature_noise(columns)) == pytest.approx(columns)


unit = st.builds(
    lambda x, s: s * Rotation.from_rotvec(x).as_quat(scalar_first=True),
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.sampled_from([-1, 1]),
)


@given(unit, unit)
def test_rotation_vectors_turn_the_measured_into_the_simulated_orientation(
    measured: np.ndarray, simulated: np.ndarray
) -> None:
    ours = rotation_vector(torch.from_numpy(measured), torch.from_numpy(simulated)).numpy()
    first, second = (Rotation.from_quat(q, scalar_first=True) for q in (measured, simulated))
    np.testing.assert_allclose(np.linalg.norm(ours), (first.inv() * second).magnitude(), atol=1e-9)
    reached = first * Rotation.from_rotvec(ours)
    np.testing.assert_allclose((reached.inv() * second).magnitude(), 0, atol=1e-7)


def test_small_rotations_keep_their_precision() -> None:
    turn = np.array([1e-9, -2e-9, 3e-10])
    q = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    ours = rotation_vector(torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), torch.from_numpy(q))
    np.testing.assert_allclose(ours, turn, rtol=1e-6)
