"""The bundled Hopper: the same physics as Gymnasium's, and logs that are what they say."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import HOPPER
from dropo_sims.hopper import LINKS, SIM
from dropo_sims.hopper.record import HOLD, NOISE_VARIANCE, SPREAD, VARIANTS, main, nominal_masses, record

from dropo_torch.data.readers import read_trajectories
from dropo_torch.errors import InputError
from dropo_torch.models.bundled import bundled_sim

#: What fields start with that are seen, or are names, files and bookkeeping, but no physics.
NO_PHYSICS = (
    "name",
    "nname",
    "nbuffer",
    "nmat",
    "ntex",
    "mat_",
    "tex_",
    "light_",
    "geom_rgba",
    "geom_matid",
    "signature",
)


def physics(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Every number of a model that is not in :data:`NO_PHYSICS`, options included."""
    found = {}
    for prefix, owner in (("", model), ("opt.", model.opt)):
        for field in dir(owner):
            value = getattr(owner, field)
            if not field.startswith(("_", *NO_PHYSICS)) and isinstance(value, int | float | np.ndarray):
                found[prefix + field] = np.asarray(value)
    return found


def test_the_hopper_has_the_physics_of_gymnasiums() -> None:
    ours, theirs = (physics(mujoco.MjModel.from_xml_path(str(path))) for path in (SIM.model, HOPPER))
    assert ours.keys() == theirs.keys()
    assert len(ours) > 300
    for field in ours:
        np.testing.assert_allclose(ours[field], theirs[field], rtol=1e-12, atol=1e-15, err_msg=field)


def test_the_hopper_is_found_by_name() -> None:
    assert bundled_sim("hopper") is SIM
    with pytest.raises(InputError, match="did you mean 'hopper'"):
        bundled_sim("hoper")


def test_the_truth_lies_in_the_search_box_and_is_not_the_model() -> None:
    assert set(SIM.truth) == set(SIM.parameters) == {f"{link}_mass" for link in LINKS}
    for name, own in nominal_masses().items():
        low, high = SIM.parameters[name]["bounds"]
        assert low < SIM.truth[name] < high
        assert abs(SIM.truth[name] - own) > 0.1


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_seed_decides_a_log(variant: str) -> None:
    first, again, other = (record(variant=variant, episodes=2, steps=30, seed=seed) for seed in (5, 5, 6))
    for name in ("observations", "next_observations", "actions", "terminals", "masses"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.actions, other.actions)
    assert first.observations.shape == (60, 11)
    assert np.flatnonzero(first.terminals).tolist() == [29, 59]
    assert (np.abs(first.actions) <= 1).all()


def test_masses_of_a_point_never_change() -> None:
    masses = record(steps=30).masses
    np.testing.assert_array_equal(masses, np.tile(list(nominal_masses().values()), (60, 1)))


def test_each_transition_of_a_log_is_one_of_the_recorded_hopper() -> None:
    log = record(variant="point", episodes=1, steps=20, masses=SIM.truth)
    np.testing.assert_array_equal(log.observations[1:], log.next_observations[:-1])
    np.testing.assert_array_equal(log.masses[0], list(SIM.truth.values()))
    model = mujoco.MjModel.from_xml_path(str(SIM.model))
    model.body_mass[1:] = list(SIM.truth.values())
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for before, action, after in zip(log.observations, log.actions, log.next_observations, strict=True):
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:], data.ctrl[:] = before[:5], before[5:], action
        mujoco.mj_step(model, data, SIM.frame_skip)
        np.testing.assert_allclose(np.concatenate([data.qpos[1:], data.qvel]), after, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("variant", "noisy", "clean"), [("ends", 1, 0), ("starts", 0, 1)])
def test_noise_is_on_one_side_of_transitions_alone(variant: str, noisy: int, clean: int) -> None:
    columns = ("observations", "next_observations")
    true, measured = (record(variant=v, steps=300, seed=2) for v in ("point", variant))
    np.testing.assert_array_equal(getattr(measured, columns[clean]), getattr(true, columns[clean]))
    noise = getattr(measured, columns[noisy]) - getattr(true, columns[noisy])
    np.testing.assert_allclose(noise.var(0), NOISE_VARIANCE, rtol=0.2)


def test_a_policy_acts_on_what_is_true() -> None:
    """And on velocities that are cut off."""
    seen: list[np.ndarray] = []

    def policy(observation: np.ndarray) -> np.ndarray:
        seen.append(observation)
        return np.clip(observation[5:8], -1, 1)

    log, clean = (record(variant=v, episodes=1, steps=100, seed=2, policy=policy) for v in ("noisy", "point"))
    np.testing.assert_array_equal(log.actions, clean.actions)
    assert np.abs(clean.observations[:, 5:]).max() > 10
    np.testing.assert_array_equal(np.stack(seen[:100])[:, :5], clean.observations[:, :5])
    np.testing.assert_array_equal(np.stack(seen[:100])[:, 5:], clean.observations[:, 5:].clip(-10, 10))


def test_noise_is_on_every_measurement_and_has_its_variance() -> None:
    clean, noisy = (record(variant=variant, steps=300, seed=2) for variant in ("point", "noisy"))
    noise = noisy.observations - clean.observations
    np.testing.assert_allclose(noise.var(0), NOISE_VARIANCE, rtol=0.2)
    np.testing.assert_array_equal(noisy.actions, clean.actions)
    np.testing.assert_array_equal(
        noisy.observations[1:300], noisy.next_observations[:299]
    )  # one measurement, one noise


def test_the_unmodeled_torso_is_a_kilogram_lighter() -> None:
    difference = record(variant="unmodeled", steps=3).masses[0] - record(steps=3).masses[0]
    np.testing.assert_allclose(difference, [-1, 0, 0, 0], atol=1e-12)


def test_masses_of_the_distribution_hold_for_a_while_and_spread_around_the_truth() -> None:
    masses = record(variant="distribution", episodes=1, steps=60 * HOLD).masses
    changes = np.flatnonzero(np.any(np.diff(masses, axis=0) != 0, axis=1)) + 1
    np.testing.assert_array_equal(changes, np.arange(HOLD, 60 * HOLD, HOLD))
    drawn = masses[::HOLD]
    spread = [SPREAD.get(f"{link}_mass", 0.0) for link in LINKS]
    np.testing.assert_allclose(drawn.std(0), spread, rtol=0.35, atol=1e-12)
    np.testing.assert_allclose(drawn.mean(0), list(nominal_masses().values()), atol=0.12)


def test_the_bundled_log_is_what_the_documented_command_records(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log"  # no suffix: the path that is given is the path that is written
    main([str(path), "--robot", "--episodes", "2", "--steps", "100", "--seed", "1"])
    assert capsys.readouterr().out == f"200 transitions in {path}\n"
    with np.load(path) as ours, np.load(SIM.log) as bundled:
        assert set(ours.files) == set(bundled.files)
        for name in ours.files:
            np.testing.assert_allclose(ours[name], bundled[name], rtol=1e-6, atol=1e-6)
    assert len(read_trajectories(SIM.log)) == 200


def test_recording_refuses_what_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="variant"):
        record(variant="nosy")
    with pytest.raises(InputError, match="episodes 0"):
        record(episodes=0)
    with pytest.raises(InputError, match="did you mean 'torso_mass'"):
        record(masses={"torsomass": 1.0})
    for arguments in (["x.npz", "--steps", "0"], [str(tmp_path)], ["x.npz", "--variant", "nosy"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert "Traceback" not in capsys.readouterr().err
