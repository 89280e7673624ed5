"""The same small log in every format, and what is said about logs that cannot be read."""

from __future__ import annotations

import json
import os
import re
import shutil
import warnings
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import scipy.io
import torch
from pyarrow import feather, parquet
from scipy.spatial.transform import Rotation

from dropo_torch.data.readers import ReadOptions, read_recording, read_trajectories
from dropo_torch.data.recording import Recording
from dropo_torch.errors import InputError

DT = 0.05
RNG = np.random.default_rng(0)
LENGTHS = (4, 3)  # samples of the two episodes
SAMPLES = sum(LENGTHS)
OBSERVATIONS = RNG.normal(size=(SAMPLES, 2))
ACTIONS = RNG.normal(size=(SAMPLES, 1))
EPISODE = np.repeat([7, 9], LENGTHS)
TIME = np.concatenate([DT * np.arange(n) for n in LENGTHS])
LAST = np.isin(np.arange(SAMPLES), (3, 6))
START = np.flatnonzero(~LAST)  # the rows from which a transition starts
COLUMNS = {"observations": ["q", "dq"], "actions": ["u"], "time": "t", "episode": "episode"}


def arrays(*, following: bool) -> dict[str, np.ndarray]:
    """The log as transitions with next observations, or as samples with timeouts."""
    if not following:
        return {"observations": OBSERVATIONS, "actions": ACTIONS, "terminals": 0 * LAST, "timeouts": LAST}
    return {
        "observations": OBSERVATIONS[START],
        "next_observations": OBSERVATIONS[START + 1],
        "actions": ACTIONS[START],
        "terminals": LAST[START + 1],
    }


def frame(**columns) -> pd.DataFrame:
    q, dq = OBSERVATIONS.T
    return pd.DataFrame({"t": TIME, "episode": EPISODE, "q": q, "dq": dq, "u": ACTIONS[:, 0], **columns})


def write_npz(folder: Path):
    np.savez(folder / "log.npz", **arrays(following=True))
    return folder / "log.npz", {"dt": DT}


def write_npz_of_samples(folder: Path):
    np.savez(folder / "log.npz", **arrays(following=False))
    return folder / "log.npz", {"dt": DT}


def write_npy(folder: Path):
    for name, array in arrays(following=True).items():
        np.save(folder / f"hopper_{name.replace('_', '')}.npy", array)
    return folder, {"dt": DT}


def write_npy_file(folder: Path):
    write_npy(folder)
    np.save(folder / "other_observations.npy", OBSERVATIONS)
    return folder / "hopper_observations.npy", {"dt": DT}


def write_csv(folder: Path):
    frame().to_csv(folder / "log.csv", index=False)
    return folder / "log.csv", COLUMNS


def write_spaced_csv(folder: Path):
    frame().to_csv(folder / "log.txt", index=False, sep=";")
    text = (folder / "log.txt").read_text().replace("dq;", " dq ;")
    (folder / "log.txt").write_text(text)
    return folder / "log.txt", {**COLUMNS, "separator": ";"}


def write_savetxt(folder: Path):
    table = frame()
    header = "of an arm, 3 May\n" + " ".join(table)
    np.savetxt(folder / "log.txt", table.to_numpy(dtype=float), header=header, fmt="%.17g")
    return folder / "log.txt", {**COLUMNS, "separator": " "}


def write_packed_text(folder: Path):
    frame().to_csv(folder / "log.dat.gz", index=False, sep="\t")
    return folder / "log.dat.gz", {**COLUMNS, "separator": "\t"}


def write_json_lines(folder: Path):
    frame().to_json(folder / "log.jsonl", orient="records", lines=True, double_precision=15)
    return folder / "log.jsonl", COLUMNS


def write_commented_csv(folder: Path):
    frame().to_csv(folder / "log.csv", index=False)
    (folder / "log.csv").write_text("% exported\n" + (folder / "log.csv").read_text())
    return folder / "log.csv", COLUMNS


def write_dated_csv(folder: Path):
    stamps = pd.Timestamp("2024-05-01 12:00") + pd.to_timedelta(TIME, unit="s")
    frame(t=stamps.strftime("%Y-%m-%dT%H:%M:%S.%f")).to_csv(folder / "log.csv", index=False)
    return folder / "log.csv", COLUMNS


def write_tsv_of_transitions(folder: Path):
    table = frame(stop=LAST).iloc[START].copy()
    table[["next_q", "next_dq"]] = OBSERVATIONS[START + 1]
    table.to_csv(folder / "log.tsv", index=False, sep="\t")
    return folder / "log.tsv", {**COLUMNS, "next_observations": ["next_q", "next_dq"]}


def write_flagged_parquet(folder: Path):
    stamps = 1_700_000_000_000_000_000 + np.round(TIME * 1e9).astype(np.int64)
    frame(t=stamps, done=LAST).to_parquet(folder / "log.parquet")
    time = {"signal": "t", "scale": "1e-9"}
    return folder / "log.parquet", {"observations": ["q", "dq"], "actions": "u", "time": time, "terminals": "done"}


def write_indexed_parquet(folder: Path):
    frame().set_index(["episode", "t"]).to_parquet(folder / "log.parquet")
    return folder / "log.parquet", COLUMNS


def write_parquet_of_lists(folder: Path):
    table = frame(state=list(OBSERVATIONS)).drop(columns=["q", "dq"])
    table["t"] = pd.Timestamp("2024-05-01", tz="Europe/Rome") + pd.to_timedelta(TIME, unit="s")
    table.to_parquet(folder / "log.parquet")
    return folder / "log.parquet", {**COLUMNS, "observations": "state"}


def write_feather(folder: Path):
    frame().set_index(["episode", "t"]).to_feather(folder / "log.feather")
    return folder / "log.feather", COLUMNS


def write_arrow_of_lists(folder: Path):
    feather.write_feather(pa.table({"q": list(OBSERVATIONS), "u": ACTIONS[:, 0], "k": EPISODE}), folder / "log.arrow")
    return folder / "log.arrow", {"observations": "q", "actions": "u", "episode": "k", "dt": DT}


#: What LeRobot says of its datasets, in degrees and with the elbow's speed before its angle.
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [2], "names": ["elbow.vel", "elbow.pos"]},
    "action": {"dtype": "float32", "shape": [1], "names": {"motors": ["elbow"]}},
    "observation.images.front": {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]},
    **{name: {"dtype": "float32", "shape": [1], "names": None} for name in ("timestamp",)},
    **{name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index", "index")},
}


def write_lerobot(folder: Path):
    """Two files of a dataset, in the order of neither name nor time."""
    (folder / "meta").mkdir()
    about = {"codebase_version": "v3.0", "fps": round(1 / DT), "total_frames": SAMPLES, "total_episodes": 2}
    (folder / "meta" / "info.json").write_text(json.dumps({**about, "features": FEATURES}))
    columns = {
        "observation.state": list(np.rad2deg(OBSERVATIONS[:, ::-1])),
        "action": list(np.rad2deg(ACTIONS)),
        "timestamp": TIME.astype(np.float32),
        "episode_index": EPISODE // 8,
        "index": np.arange(SAMPLES),
    }
    for number, rows in enumerate((slice(3, None), slice(0, 3))):
        chunk = folder / "data" / f"chunk-00{number}"
        chunk.mkdir(parents=True)
        parquet.write_table(pa.table({k: v[rows] for k, v in columns.items()}), chunk / "file-000.parquet")
    degree = float(np.pi / 180)
    chosen = "observation.state[elbow.pos, elbow.vel]"
    return folder, {"observations": chosen, "scale": {"observation.state": degree, "action": degree}}


def write_d4rl(folder: Path):
    with h5py.File(folder / "log.hdf5", "w") as file:
        file.update(arrays(following=False))
        file["infos/qpos"] = OBSERVATIONS[:, :1]
    return folder / "log.hdf5", {"dt": DT}


def write_d4rl_with_next(folder: Path):
    with h5py.File(folder / "log.h5", "w") as file:
        file.update(arrays(following=True))
    return folder / "log.h5", {"dt": DT}


def write_hdf5_groups(folder: Path):
    with h5py.File(folder / "log.h5", "w") as file:
        for name, label in (("demo_2", 7), ("demo_10", 9)):
            rows = label == EPISODE
            file[f"data/{name}/obs/q"] = OBSERVATIONS[rows, 0]
            file[f"data/{name}/obs/dq"] = OBSERVATIONS[rows, 1:]
            file[f"data/{name}/actions"] = ACTIONS[rows]
    return folder / "log.h5", {"group": "data/demo_*", "observations": ["obs/q", "obs/dq"], "dt": DT}


def write_mat(folder: Path):
    log = {"state": OBSERVATIONS, "wide": OBSERVATIONS.T, "u": ACTIONS / 2, "t": TIME[:, None], "k": EPISODE}
    scipy.io.savemat(folder / "log.mat", {"log": log, "gain": 2.0})
    columns = {"observations": ["log.state[0]", {"signal": "log.wide[1]", "transpose": True}], "time": "log.t"}
    return folder / "log.mat", {
        **columns,
        "actions": {"force": {"signal": "log.u", "scale": "gain"}},
        "episode": "log.k",
    }


def write_mat73(folder: Path):
    with h5py.File(folder / "log.mat", "w", userblock_size=512) as file:
        file["log/state"] = OBSERVATIONS.T  # MATLAB stores by columns
        file["log/u"] = ACTIONS.T
        file["t"] = TIME[None]
        file["k"] = EPISODE[None]
    return folder / "log.mat", {"observations": "log.state", "actions": "log.u", "time": "t", "episode": "k"}


WRITERS = [value for name, value in sorted(globals().items()) if name.startswith("write_")]


def check(log) -> None:
    expected = arrays(following=True)
    np.testing.assert_allclose(log.observations, expected["observations"], atol=1e-12)
    np.testing.assert_allclose(log.next_observations, expected["next_observations"], atol=1e-12)
    np.testing.assert_allclose(log.actions, expected["actions"], atol=1e-12)
    np.testing.assert_array_equal(log.terminals, expected["terminals"])
    assert log.dt == pytest.approx(DT, rel=1e-5)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__.removeprefix("write_"))
def test_every_format_gives_the_same_transitions(tmp_path, write):
    path, options = write(tmp_path)
    check(read_trajectories(path, **options))
    check(read_trajectories({"path": str(path), **options}))
    check(read_trajectories({"path": path.name, **options}, base=path.parent))


# -- Minari ---------------------------------------------------------------------------------------


def minari_dataset(tmp_path, monkeypatch, *, dictionary: bool = False):
    minari = pytest.importorskip("minari")
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    box = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float64)
    buffers = []
    for label, length in zip((7, 9), LENGTHS, strict=True):
        seen = OBSERVATIONS[label == EPISODE]
        buffers.append(
            EpisodeBuffer(
                observations={"state": seen, "goal": 0 * seen} if dictionary else seen,
                actions=ACTIONS[label == EPISODE][:-1],
                rewards=[0.0] * (length - 1),
                terminations=[False] * (length - 1),
                truncations=[False] * (length - 2) + [True],
            )
        )
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of metadata left out
        minari.create_dataset_from_buffers(
            "robot/log-v0",
            buffers,
            observation_space=spaces.Dict({"state": box, "goal": box}) if dictionary else box,
            action_space=spaces.Box(-np.inf, np.inf, (1,), dtype=np.float64),
        )


def test_options_without_a_meaning_for_minari_are_refused():
    """All that say how rows become transitions."""
    given = {
        "next_observations": ["q"], "time": "t", "episode": "e", "terminals": "t", "tolerance": 0.5, "group": "g",
        "separator": ";", "preprocess": {"dt": 0.1}, "scale": {"q": 2.0}, "unwrap": ["q"], "shift": 1, "breaks": [3],
        "pause": 0.5, "joints": ["q"], "stamps": {"q": "t"},
        "orientations": {"hull": {"angles": ["a", "b", "c"]}},
    }  # fmt: skip
    assert set(given) == {*ReadOptions.__dataclass_fields__} - {"observations", "actions", "dt"}
    for name, value in given.items():
        with pytest.raises(InputError, match=rf"log-v0: {name} has no meaning for a Minari dataset"):
            read_trajectories("minari:arm/log-v0", **{name: value})


def test_minari_by_id_and_by_folder(tmp_path, monkeypatch):
    minari_dataset(tmp_path, monkeypatch)
    folder = tmp_path / "robot" / "log-v0"
    for source in ("minari:robot/log-v0", folder, folder / "data"):
        check(read_trajectories(source, dt=DT))
    with pytest.raises(InputError, match=r"minari:robot/lg-v0: no such local dataset; did you mean 'robot/log-v0'"):
        read_trajectories("minari:robot/lg-v0")
    with pytest.raises(InputError, match=r"log-v1: no such file.*a local Minari dataset is written minari:log-v1"):
        read_trajectories(folder.with_name("log-v1"))
    with pytest.raises(InputError, match=r"preprocess has no meaning for a Minari dataset"):
        read_trajectories(folder, preprocess={"dt": 0.1})


def test_minari_dictionary_is_chosen_from(tmp_path, monkeypatch):
    minari_dataset(tmp_path, monkeypatch, dictionary=True)
    check(read_trajectories("minari:robot/log-v0", dt=DT, observations="state"))
    with pytest.raises(
        InputError, match=r"episode 0: observations are a dictionary; choose .* \[KEY, \.\.\.\].*goal, state"
    ):
        read_trajectories("minari:robot/log-v0")
    with pytest.raises(InputError, match=r"there is no 'states'; did you mean 'state'"):
        read_trajectories("minari:robot/log-v0", observations="states")


# -- several logs ---------------------------------------------------------------------------------


def test_lists_and_patterns_are_joined_in_order(tmp_path):
    for name, shift in (("b", 1.0), ("a", 0.0)):
        frame(q=OBSERVATIONS[:, 0] + shift).to_csv(tmp_path / f"{name}.csv", index=False)
    for source in (["a.csv", "b.csv"], "*.csv", [{"path": "a.csv"}, "b.csv"], {"path": ["a.csv", "b.csv"]}):
        log = read_trajectories(source, **COLUMNS, base=tmp_path)
        assert log.num_episodes == 4
        assert len(log) == 2 * len(START)
        np.testing.assert_allclose(log.observations[len(START) :, 0], OBSERVATIONS[START, 0] + 1, atol=1e-12)
    with pytest.raises(InputError, match=r"\*\.h5: no file matches this pattern"):
        read_trajectories("*.h5", base=tmp_path)


def test_preprocess_is_applied_to_each_log(tmp_path):
    frame().to_csv(tmp_path / "log.csv", index=False)
    log = read_trajectories(tmp_path / "log.csv", **COLUMNS, preprocess={"dt": DT, "velocities": ["dq"]})
    check(log)
    columns = {**COLUMNS, "observations": "q", "actions": None}
    log = read_trajectories(tmp_path / "log.csv", **columns, preprocess={"dt": DT, "actions": "position"})
    np.testing.assert_allclose(log.actions[:, 0], OBSERVATIONS[START + 1, 0], atol=1e-12)


def test_passive_system_has_no_actions(tmp_path):
    frame().to_csv(tmp_path / "log.csv", index=False)
    assert read_trajectories(tmp_path / "log.csv", **{**COLUMNS, "actions": []}).actions.shape == (len(START), 0)


def test_action_of_an_episodes_last_sample_may_be_missing(tmp_path):
    frame(u=np.where(LAST, np.nan, ACTIONS[:, 0])).to_csv(tmp_path / "log.csv", index=False)
    check(read_trajectories(tmp_path / "log.csv", **COLUMNS))


def test_column_map_scales_renames_and_slices(tmp_path):
    np.savez(tmp_path / "log.npz", s=np.arange(12.0).reshape(4, 3), u=np.arange(4.0))
    columns = {
        "observations": ["s[1:]", {"signal": "s[-3]", "name": "first", "offset": 1}],
        "actions": {"f": {"signal": "u", "scale": 2}},
    }
    log = read_recording(tmp_path / "log.npz", **columns)
    assert log.observation_names == ("s[1]", "s[2]", "first")
    assert log.action_names == ("f",)
    np.testing.assert_array_equal(log.observations[1], [4, 5, 4])
    np.testing.assert_array_equal(log.actions[:, 0], [0, 2, 4, 6])


# -- orientations ---------------------------------------------------------------------------------


def turning(rows: int = 400, seed: int = 0) -> Rotation:
    """Orientations along a path that turns over in every direction."""
    steps = Rotation.from_rotvec(
        np.array([0.02, 0.03, 0.11]) + 0.02 * np.random.default_rng(seed).normal(size=(rows, 3))
    )
    found = [steps[0]]
    for step in steps[1:]:
        found.append(found[-1] * step)
    return Rotation.concatenate(found)


@pytest.mark.parametrize("sequence", ["xyz", "XYZ", "ZYX", "zxy", "ZXZ"])
def test_orientations_of_angles_are_those_that_were_written(tmp_path, sequence):
    """In whatever unit and sequence, through the wraps of angles, without a flip of the quaternion."""
    truth = turning()
    angles = dict(zip("abc", truth.as_euler(sequence, degrees=True).T, strict=True))
    assert max(np.abs(np.diff(values)).max() for values in angles.values()) > 300
    angles["b"][7] = np.nan
    pd.DataFrame({"t": 0.01 * np.arange(400), **angles, "u": 0.0}).to_csv(tmp_path / "log.csv", float_format="%.17g")
    degrees = [{"signal": name, "scale": np.pi / 180} for name in "abc"]
    given = {"hull": {"angles": degrees, "sequence": sequence}}
    log = read_recording(tmp_path / "log.csv", observations="hull", actions="u", time="t", orientations=given)
    assert log.observation_names == ("hull[w]", "hull[x]", "hull[y]", "hull[z]")
    assert log.quaternions == (log.observation_names,)
    assert np.flatnonzero(np.isnan(log.observations).any(axis=1)).tolist() == [7]
    read = np.delete(log.observations, 7, axis=0)
    assert (read[1:] * read[:-1]).sum(axis=1).min() > 0.9
    wrong = Rotation.from_quat(read, scalar_first=True) * truth[np.delete(np.arange(400), 7)].inv()
    assert wrong.magnitude().max() < 1e-12
    part = read_recording(tmp_path / "log.csv", observations="hull[z]", actions="u", time="t", orientations=given)
    np.testing.assert_array_equal(part.observations[:, 0], log.observations[:, 3])


def test_roll_pitch_yaw_turn_about_fixed_axes_where_nothing_else_is_said(tmp_path):
    """So that yaw is the heading: with a roll of a quarter turn, too, it turns about the world's z."""
    rows = pd.DataFrame({"roll": [np.pi / 2] * 3, "pitch": 0.0, "yaw": [0.0, 0.1, 0.2], "u": 0.0})
    rows.to_csv(tmp_path / "log.csv", index=False, float_format="%.17g")
    given = {"hull": {"angles": ["roll", "pitch", "yaw"]}}
    log = read_recording(tmp_path / "log.csv", observations="hull", actions="u", dt=0.1, orientations=given)
    read = Rotation.from_quat(log.observations, scalar_first=True)
    np.testing.assert_allclose((read[2] * read[0].inv()).as_rotvec(), [0, 0, 0.2], atol=1e-12)


def test_angles_are_resampled_as_the_orientation_that_they_are(tmp_path):
    """Between two rows, past a wrap, and with a cell of text where a sample is missing."""
    time, heading = 0.1 * np.arange(60), 170 + 3.0 * np.arange(60)
    frame = pd.DataFrame({"t": time, "roll": 0.0, "pitch": 0.0, "yaw": ((heading + 180) % 360 - 180).astype(object)})
    frame.loc[30, "yaw"] = "ERR"
    frame.assign(u=0.0).to_csv(tmp_path / "log.csv", index=False)
    degrees = [{"signal": name, "scale": np.pi / 180} for name in ("roll", "pitch", "yaw")]
    log = read_trajectories(
        tmp_path / "log.csv", observations="hull", actions="u", time="t", orientations={"hull": {"angles": degrees}},
        preprocess={"dt": 0.05, "max_gap": 0.25},
    )  # fmt: skip
    quaternion, rates = log.observations[:, :4], log.observations[:, 4:]
    assert (np.abs(np.linalg.norm(quaternion, axis=1) - 1) < 1e-9).all()
    turned = Rotation.from_quat(quaternion, scalar_first=True)
    np.testing.assert_allclose((turned[1:] * turned[:-1].inv()).as_rotvec(degrees=True)[:, 2], 1.5, atol=1e-2)
    np.testing.assert_allclose(rates, np.radians([[0, 0, 30]] * len(rates)), atol=1e-2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("hull", r"data: orientations is 'hull'; expected names with their angles, such as \{hull: "),
        ({"hull": ["q", "dq", "u"]}, r"data: orientations: hull is \['q', 'dq', 'u'\]; expected angles, such as"),
        ({"hull": {}}, r"data: orientations: hull has no angles; expected three columns"),
        ({"hull[w]": {"angles": ["q", "dq", "u"]}}, r"'hull\[w\]' is no name; expected text without brackets"),
        ({"hull": {"angels": ["q", "dq", "u"]}}, r"orientations: hull: unknown key 'angels'; did you mean 'angles'"),
        ({"hull": {"angles": ["q", "dq"]}}, r"orientations: hull: angles are 2 columns \(q, dq\); expected three"),
        ({"hull": {"angles": ["q", "dq", "v"]}}, r"log\.csv: orientations: hull: there is no 'v'"),
        ({"hull": {"angles": ["q", "dq", "u"], "sequence": "xyy"}}, r"hull: sequence is 'xyy'; expected three axes"),
        ({"hull": {"angles": ["q", "dq", "u"], "sequence": "xYz"}}, r"hull: sequence is 'xYz'; expected three axes"),
        ({"hull": {"angles": ["q", "dq", "u"], "sequence": 3}}, r"hull: sequence is 3; expected three axes"),
        ({"q": {"angles": ["q", "dq", "u"]}}, r"log\.csv: orientations: q is in the log already; expected another"),
    ],
)  # fmt: skip
def test_orientations_that_cannot_be_read(tmp_path, given, message):
    path, options = write_csv(tmp_path)
    fails(message, path, **{**options, "observations": "hull", "orientations": given})


# -- bad input ------------------------------------------------------------------------------------


def fails(message: str, source, **options) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_trajectories(source, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observations": ["q", "dp"]}, r"observations: there is no 'dp'; did you mean 'dq'"),
        ({"actions": None}, r"there is no 'actions'; say which columns are the actions with actions: \[NAME, \.\.\.\]"),
        ({"observations": None}, r"there is no 'observations'; say which columns"),
        ({"observations": []}, r"observations: the list is empty"),
        ({"observations": "q[1]"}, r"observations: q\[1\] is outside q, which has 1 columns"),
        ({"observations": ["q", "q"]}, r"two columns are named 'q'"),
        ({"observations": 1.5}, r"observations: 1\.5 is not understood; expected a column's name"),
        ({"actions": {"u": ["u"]}}, r"is not understood; expected a column's name, a list of names"),
        ({"actions": {"signal": "u", "scal": 2}}, r"actions: unknown key 'scal'; did you mean 'scale'"),
        ({"actions": {"signal": "u", "scale": "gain"}}, r"actions: scale: there is no 'gain'"),
        ({"actions": {"signal": "u", "scale": "dq"}}, r"scale 'dq' has shape \(7,\); expected a scalar"),
        ({"actions": {"signal": "u", "scale": float("inf")}}, r"scale is inf; expected a finite number"),
        ({"actions": {"signal": "u", "transpose": "yes"}}, r"transpose is 'yes'; expected true or false"),
        ({"time": "time"}, r"time: there is no 'time'"),
        ({"time": ["t", "q"]}, r"time has 2 columns; expected one"),
        ({"episode": "episodes"}, r"episode: there is no 'episodes'; did you mean 'episode'"),
        ({"episode": 3}, r"data: episode is 3; expected text"),
        ({"terminals": "q"}, r"terminals: q is 0\.12573 at row 0 .*expected true/false or 0/1"),
        ({"dt": 0.05}, r"both time and dt are given"),
        ({"dt": 0, "time": None}, r"data: dt is 0; expected a positive number"),
        ({"tolerance": "x"}, r"tolerance is 'x'; expected a positive number"),
        ({"group": "demo_*"}, r"group is an option of HDF5 files"),
        ({"next_observations": ["q"]}, r"next_observations has 1 columns and observations has 2"),
        ({"next_observations": ["q", "dq"], "preprocess": {"dt": 1}}, r"leave next_observations out"),
        ({"preprocess": {"dt": 1, "cut": 3}}, r"preprocess: unknown key 'cut'"),
    ],
)
def test_option_that_does_not_fit_a_table(tmp_path, options, message):
    path, columns = write_csv(tmp_path)
    fails(message, path, **{**columns, **options})


def test_source_that_is_no_path():
    fails(r"data: unknown key 'tim'; did you mean 'time'", {"path": "log.csv", "tim": "t"})
    fails(r"data: there is no key 'path'", {"file": "log.csv"})
    fails(r"data: \[\] given; expected a path, a list of paths", [])
    fails(r"data: 3 given", 3)


def test_missing_file_names_the_nearest(tmp_path):
    path, columns = write_csv(tmp_path)
    fails(r"lgo\.csv: no such file or folder; did you mean 'log\.csv'", path.with_name("lgo.csv"), **columns)
    fails(r"nor is there a folder", tmp_path / "nowhere" / "log.csv")
    (tmp_path / "log.xyz").touch()
    fails(r"log\.xyz: unknown kind of log; expected \.npz", tmp_path / "log.xyz")


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".parquet", ".h5", ".mat"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfejunk\x80" * 50], ids=["empty", "junk"])
def test_corrupt_file(tmp_path, suffix, content):
    path = tmp_path / f"log{suffix}"
    path.write_bytes(content)
    fails(rf"log{re.escape(suffix)}: cannot be read as ", path, observations=["q"], actions=["u"])


@pytest.mark.parametrize("write", [write_npz, write_flagged_parquet, write_d4rl, write_mat, write_mat73])
def test_truncated_file(tmp_path, write):
    path, options = write(tmp_path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    fails(r"cannot be read as ", path, **options)


class Payload:
    """Says so if it is ever unpickled."""

    def __reduce__(self):
        return (exec, ("raise AssertionError('unpickled')",))


def test_pickles_are_never_loaded(tmp_path):
    evil = np.array([Payload()], dtype=object)
    np.savez(tmp_path / "log.npz", **{**arrays(following=True), "observations": evil})
    fails(r"log\.npz: observations: cannot be read .*allow_pickle", tmp_path / "log.npz")
    folder = tmp_path / "folder"
    folder.mkdir()
    write_npy(folder)
    np.save(folder / "hopper_actions.npy", evil)
    fails(r"hopper_actions\.npy: cannot be read as a plain \.npy array .*allow_pickle", folder)


def test_folder_of_npy_files_must_be_one_complete_log(tmp_path):
    fails(r"no \*_observations\.npy in this folder and it is no Minari dataset", tmp_path)
    write_npy(tmp_path)
    (tmp_path / "hopper_actions.npy").unlink()
    fails(r"there is no hopper_actions\.npy beside hopper_observations\.npy", tmp_path)
    np.save(tmp_path / "b_observations.npy", OBSERVATIONS)
    fails(r"2 logs are in this folder; name one, such as .*b_observations\.npy", tmp_path)


def test_arrays_must_fit_together(tmp_path):
    good = arrays(following=True)
    for change, message in (
        ({"actions": ACTIONS}, r"actions has 7 rows and observations has 5"),
        ({"next_observations": OBSERVATIONS}, r"next_observations has 7 rows and observations has 5"),
        ({"terminals": LAST}, r"terminals has 7 rows and observations has 5"),
        ({"observations": np.zeros((2, 2, 2))}, r"observations has shape \(2, 2, 2\); expected \(samples, columns\)"),
        ({"observations": np.array(["a", "b"])}, r"observations is 'a' at row 0 .*a number is expected"),
        ({"observations": 1j * OBSERVATIONS}, r"observations holds complex128 values"),
        ({"observations": np.zeros((0, 2))}, r"the log has no row"),
        ({"actions": np.full((5, 1), np.nan)}, r"actions: actions is nan at row 0 .* and 4 more"),
    ):
        np.savez(tmp_path / "log.npz", **{**good, **change})
        fails(rf"log\.npz: .*{message}", tmp_path / "log.npz")
    del good["actions"]
    np.savez(tmp_path / "log.npz", **good)
    fails(r"log\.npz: there is no 'actions'.*next_observations", tmp_path / "log.npz")


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("dq", 2, "nan", r"dq is nan at row 2 \(counted from 0\)"),
        ("q", 1, "inf", r"q is inf at row 1"),
        ("dq", 3, "oops", r"dq is 'oops' at row 3"),
        ("u", 0, "", r"u is nan at row 0"),
        ("t", 2, "", r"time is nan at row 2"),
        ("t", 2, "0.05", r"time goes from 0\.05 s to 0\.05 s at row 2 .*it must rise within an episode"),
        ("t", 2, "0.11", r"irregular time stamps: 0\.06 s before row 2 .*preprocess: \{dt: SECONDS\}"),
        ("t", 2, "soon", r"(t: cannot be read as dates|t is 'soon' at row 2)"),
        ("episode", 4, "", r"episode has no value at row 4"),
    ],
)
def test_bad_cell_is_named(tmp_path, column, row, value, message):
    table = frame().astype(object)
    table.loc[row, column] = value
    table.to_csv(tmp_path / "log.csv", index=False)
    fails(message, tmp_path / "log.csv", **COLUMNS)


def test_a_row_that_is_told_again_counts_once(tmp_path):
    """All of it, its stamp too; one that differs in anything is refused as a stamp that does not rise."""
    table = frame()
    told = pd.concat([table.iloc[:3], table.iloc[2:3], table.iloc[2:]])
    told.to_csv(tmp_path / "log.csv", index=False)
    table.to_csv(tmp_path / "once.csv", index=False)
    log, once = (read_trajectories(tmp_path / name, **COLUMNS) for name in ("log.csv", "once.csv"))
    np.testing.assert_array_equal(log.observations, once.observations)
    np.testing.assert_array_equal(log.terminals, once.terminals)
    assert log.dt == once.dt
    told.iloc[3, list(told.columns).index("q")] += 1e-6
    told.to_csv(tmp_path / "log.csv", index=False)
    fails(r"time goes from 0\.1 s to 0\.1 s at row 3", tmp_path / "log.csv", **COLUMNS)


def test_time_that_starts_again_needs_an_episode_column(tmp_path):
    path, columns = write_csv(tmp_path)
    fails(r"time goes from 0\.15 s to 0 s at row 4 .*tells episodes apart", path, **{**columns, "episode": None})


def test_decimal_commas_are_read_where_no_comma_separates(tmp_path):
    lines = ["t;q;u"] + [f"0,{i:03d};{1.5 * i:.4f};{i}".replace(".", ",") for i in range(20)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    log = read_trajectories(tmp_path / "log.csv", separator=";", time="t", observations="q", actions="u")
    np.testing.assert_allclose(log.observations[:, 0], 1.5 * np.arange(19))
    assert log.dt == pytest.approx(0.001)
    (tmp_path / "log.csv").write_text("\n".join(["t;q;u"] + [f"{i};{i},000;1,234" for i in range(1, 20)]))
    fails("q is '1,000' at row 0", tmp_path / "log.csv", separator=";", dt=1.0, observations="q", actions="u")


def test_wrong_separator_is_suggested(tmp_path):
    frame().to_csv(tmp_path / "log.csv", index=False, sep=";")
    fails(r"separator: ';' may be what is meant", tmp_path / "log.csv", **COLUMNS)


def test_rows_longer_than_the_header(tmp_path):
    (tmp_path / "log.csv").write_text("t,q,u\n0,1,2,3\n1,1,2,3\n")
    fails(r"log\.csv: cannot be read as a table of text", tmp_path / "log.csv", observations="q", actions="u")


def test_matlab_struct_array_has_numbered_elements(tmp_path):
    runs = np.array([{"q": OBSERVATIONS[:, 0], "note": "a"}, {"q": OBSERVATIONS[:3, 0], "note": "b"}], dtype=object)
    scipy.io.savemat(tmp_path / "log.mat", {"runs": runs})
    log = read_recording(tmp_path / "log.mat", observations={"q": "runs.1.q"}, actions=[])
    np.testing.assert_array_equal(log.observations[:, 0], OBSERVATIONS[:3, 0])
    fails(r"runs\.1\.note holds <U1 values", tmp_path / "log.mat", observations="runs.1.note", actions=[])


def test_no_hdf5_group_matches(tmp_path):
    path, options = write_hdf5_groups(tmp_path)
    fails(r"no group matches 'data/episode_\*'.*data/demo_10", path, **{**options, "group": "data/episode_*"})


def test_matrix_of_another_length_may_be_transposed(tmp_path):
    path, options = write_mat(tmp_path)
    fails(
        r"log\.wide\[0\] has 2 rows and log\.state\[0\] has 7.*transpose: true",
        path,
        **{**options, "observations": ["log.state", "log.wide"]},
    )


def test_log_without_flags_says_that_it_is_one_episode(tmp_path):
    np.savez(tmp_path / "log.npz", observations=OBSERVATIONS, actions=ACTIONS)
    fails(r"there is no 'terminals'; .*\(or terminals: \[\] if all of it is one episode\)", tmp_path / "log.npz")
    assert read_trajectories(tmp_path / "log.npz", terminals=[]).num_episodes == 1


def test_ragged_lists(tmp_path):
    frame(state=[[0.0]] * 6 + [[0.0, 1.0]]).to_parquet(tmp_path / "log.parquet")
    fails(
        r"state is not a list of numbers of one length",
        tmp_path / "log.parquet",
        **{**COLUMNS, "observations": "state"},
    )


def test_single_sample_makes_no_transition(tmp_path):
    frame().iloc[:1].to_csv(tmp_path / "log.csv", index=False)
    fails(r"no episode has two samples, 1 samples in all", tmp_path / "log.csv", **COLUMNS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((6, 1))}, r"actions has shape \(6, 1\); expected \(7, 1\)"),
        ({"observations": np.full((7, 2), np.inf)}, r"q is inf at row 0"),
        ({"episodes": EPISODE[::-1]}, r"episodes must be 7 whole numbers that never fall"),
        ({"time": TIME[:6]}, r"time has shape \(6,\); expected \(7,\)"),
    ],
)
def test_recording_checks_itself(change, message):
    fine = {"observations": OBSERVATIONS, "actions": ACTIONS, "time": TIME, "episodes": EPISODE}
    with pytest.raises(InputError, match=message):
        Recording(**{**fine, **change}, observation_names=("q", "dq"), action_names=("u",))


# -- logs that others published -------------------------------------------------------------------


def test_published_hopper_log():
    folder = Path(os.environ.get("DROPO_DATA", "")) / "dropo_hopper"
    if not folder.is_dir():
        pytest.skip("DROPO_DATA has no dropo_hopper")
    log = read_trajectories(folder)
    assert log.observations.shape == (10000, 11)
    assert log.num_episodes == 20


# --- LeRobot, mujoco.sysid, and what is in memory ---


def test_a_lerobot_dataset_says_what_is_what(tmp_path):
    """Without options: its states, its actions, its time and its episodes."""
    folder, _ = write_lerobot(tmp_path)
    log = read_trajectories(folder)
    np.testing.assert_allclose(log.observations, np.rad2deg(OBSERVATIONS[START, ::-1]))
    assert log.num_episodes == 2
    assert log.dt == pytest.approx(DT, rel=1e-5)
    assert log.origin.observation_names == ("observation.state[elbow.vel]", "observation.state[elbow.pos]")
    both = {"observations": "observation.state", "preprocess": {"dt": DT / 2}, "joints": ["elbow.pos"]}
    np.testing.assert_allclose(read_trajectories(folder, **both, actions=[]).observations[::2, 0],
                               np.rad2deg(OBSERVATIONS[START, 0]), atol=1e-4)  # fmt: skip


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "data" / "chunk-001" / "file-000.parquet").unlink(),
            "total_frames: 7, and .* have 4",
        ),
        (lambda f: shutil.rmtree(f / "data"), "there are no data/chunk-"),
        (lambda f: (f / "meta" / "info.json").write_text("{}"), "cannot be read as a LeRobot dataset's description"),
        (
            lambda f: (f / "meta" / "info.json").write_text('{"features": {"x": {}}}'),
            "say which columns",
        ),
        (lambda f: (f / "data" / "chunk-000" / "file-000.parquet").write_text("version https://git-lfs"), "Parquet"),
    ],
)
def test_a_lerobot_dataset_that_is_not_whole(tmp_path, damage, message):
    folder, _ = write_lerobot(tmp_path)
    damage(folder)
    with pytest.raises(InputError, match=message):
        read_trajectories(folder)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joints": ["wrist"]}, r"observation.state: there is no 'wrist' \(there are: elbow.vel, elbow.pos\)"),
        ({"observations": "observation.state[knee]"}, "there is no 'knee'"),
        ({"observations": "observation.images.front"}, "there is no 'observation.images.front'"),
        ({"stamps": {"/a": "received"}}, "stamps is an option of ROS bag files"),
    ],
)
def test_what_a_lerobot_dataset_has_not(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        read_trajectories(write_lerobot(tmp_path)[0], **options)


SERIES_XML = """
<mujoco>
  <worldbody><body><joint name="elbow" axis="0 1 0"/><geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="elbow"/></actuator>
  <sensor><jointpos name="angle" joint="elbow"/><jointvel name="speed" joint="elbow"/></sensor>
</mujoco>"""


def trajectory(times=TIME[:4], late=0.0):
    """The first episode as mujoco.sysid has it."""
    from mujoco.sysid._src import (
        timeseries as sysid,  # which the package shows only where all of its extra is installed
    )
    from mujoco.sysid._src.trajectory import SystemTrajectory

    model = mujoco.MjModel.from_xml_string(SERIES_XML)
    control = sysid.TimeSeries.from_control_names(times + late, ACTIONS[:4], model)
    seen = sysid.TimeSeries.from_names(times, OBSERVATIONS[:4], model)
    qpos, qvel, _, _ = sysid.TimeSeries.compute_all_state_mappings(model)
    state = sysid.TimeSeries(times, np.column_stack([times, OBSERVATIONS[:4]]), qpos | qvel)
    return SystemTrajectory(model, control, seen, np.zeros(3), state)


SYSID = (
    {"observations": ["angle", "speed"], "actions": "motor_ctrl"},
    {"observations": "sensordata"},
    {"observations": "sensordata[angle, speed]", "actions": "control[motor_ctrl]"},
    {"observations": ["state.elbow_qpos", "state[elbow_qvel]"]},
)


@pytest.mark.parametrize("options", SYSID)
def test_a_trajectory_of_mujoco_sysid_from_memory_and_disk(tmp_path, options):
    given = trajectory()
    given.save_to_disk(tmp_path / "log.npz")
    for source in (given, tmp_path / "log.npz"):
        log = read_trajectories(source, **options)
        np.testing.assert_allclose(log.observations, OBSERVATIONS[:3])
        np.testing.assert_allclose(log.actions, ACTIONS[:3])
        assert log.dt == pytest.approx(DT)


def test_time_series_of_mujoco_sysid(tmp_path):
    series = trajectory().sensordata
    series.save_to_disk(tmp_path / "log.npz")
    for source in (series, tmp_path / "log.npz"):
        log = read_trajectories(source, observations=["speed", "data[angle]"], actions=[])
        np.testing.assert_allclose(log.observations, OBSERVATIONS[:3, ::-1])
    with pytest.raises(InputError, match=r"TimeSeries: there is no signal 'angel'; did you mean 'angle'"):
        read_trajectories(series, observations="angel", actions=[])


def test_series_with_other_stamps_need_preprocessing():
    late = trajectory(late=0.01)
    with pytest.raises(InputError, match="stamps of their own"):
        read_trajectories(late, observations="sensordata")
    with pytest.raises(InputError, match=r"orientations are made of angles in one row, and every signal"):
        read_trajectories(late, observations="a", orientations={"a": {"angles": ["angle", "speed", "motor_ctrl"]}})
    log = read_trajectories(late, observations="angle", preprocess={"dt": DT})
    np.testing.assert_allclose(log.actions, ACTIONS[:2], atol=1e-12)


def test_frames_and_arrays_in_memory():
    check(read_trajectories(frame(), **COLUMNS))
    check(read_trajectories(frame().set_index(["episode", "t"]), **COLUMNS))
    check(read_trajectories({"path": frame(), **COLUMNS}))
    check(read_trajectories(arrays(following=True), dt=DT))
    columns = {name: series.to_numpy() for name, series in frame().items()}
    check(read_trajectories(columns, **COLUMNS))
    check(read_trajectories({"q": torch.tensor(OBSERVATIONS), "u": list(ACTIONS[:, 0]), "k": EPISODE},
                            observations="q", actions="u", episode="k", dt=DT))  # fmt: skip
    halves = [frame()[label == EPISODE] for label in (7, 9)]
    check(read_trajectories(halves, **{**COLUMNS, "episode": None}))


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ({"q": OBSERVATIONS}, {"observations": "p", "actions": []}, r"arrays: .* there is no 'p' \(there are: q\)"),
        ({"q": OBSERVATIONS, "u": ACTIONS[1:]}, {"observations": "q", "actions": "u"}, "actions has 6 rows"),
        ({"q": OBSERVATIONS}, {"separator": ",", "observations": "q"}, "arrays: separator is an option of files"),
        ({"q": [1, 2, 3]}, {}, "no key 'path'"),
        (frame(), {"observations": "angle"}, "data frame: there is no 'actions'"),
        (frame(), {"observations": ["q"], "actions": [], "joints": ["q"]}, "joints: no signal of this log"),
        (3.5, {}, r"3\.5 given; expected a path"),
    ],
)  # fmt: skip
def test_what_is_in_memory_must_fit(source, options, message):
    with pytest.raises(InputError, match=message):
        read_trajectories(source, **options)


def test_a_pause_ends_an_episode_of_a_table(tmp_path):
    table = frame(t=TIME + np.where(EPISODE == 9, 1.0, 0.0)).drop(columns="episode")
    check(read_trajectories(table, observations=["q", "dq"], actions="u", time="t", pause=0.2))
    with pytest.raises(InputError, match="pause needs time stamps"):
        read_trajectories(table, observations=["q", "dq"], actions="u", pause=0.2)


def test_a_data_frame_with_a_column_twice_is_refused() -> None:
    frame = pd.DataFrame(np.zeros((5, 3)), columns=["q", "u", "q"])
    with pytest.raises(InputError, match="two columns are named 'q'; give each a name of its own"):
        read_trajectories(frame, observations=["q"], actions=["u"], dt=0.1)
