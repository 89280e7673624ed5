"""Score `dropo check`: whether it tells what is wrong with wrong logs, and leaves good ones in peace.

python benchmarks/wrong_logs.py --seed 11                    # 40 wrong logs of ten kinds, 30 good ones
python benchmarks/wrong_logs.py --seed 11 --out out/wrong    # and the table as JSON
DROPO_DATA=FOLDER python benchmarks/wrong_logs.py            # measured logs among the good ones, see docs/check.md

A wrong log counts as told where a finding has the name of its fault and nothing surer another one. A cure counts where
the log, read by the config lines of that finding, has no sure finding left.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden import cases as hidden
from benchmarks.hidden.systems import DT, SYSTEMS, load
from benchmarks.hidden.truths import make_recording, measured
from dropo_torch.config import make_config
from dropo_torch.data.examination import Finding
from dropo_torch.logged import read_log

#: A box with three thrusters, thrown: every column of a free joint, and a quaternion that turns about all axes.
THROWN = """
<mujoco model="thrown">
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="box" pos="0 0 2">
      <freejoint name="root"/>
      <geom type="box" size=".1 .15 .05" mass="1.2"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="lift" joint="root" gear="0 0 10 0 0 0"/>
    <motor name="roll" joint="root" gear="0 0 0 .15 0 0"/>
    <motor name="yaw" joint="root" gear="0 0 0 0 0 .15"/>
  </actuator>
</mujoco>"""


@dataclass(frozen=True)
class Log:
    """A log and the config that reads it.

    Attributes:
        system: what it is of.
        model: MJCF.
        frame_skip: physics steps of a row.
        observation: what the columns are.
        arrays: ``observations``, ``next_observations``, ``actions``, ``terminals``, and ``time`` where it has stamps.
        keys: further keys of the config.
    """

    system: str
    model: str
    frame_skip: int
    observation: tuple[str, ...]
    arrays: Mapping[str, np.ndarray]
    keys: Mapping[str, Any] = field(default_factory=dict)

    @property
    def compiled(self) -> mujoco.MjModel:
        """The model."""
        return load(self.model)

    def changed(self, **arrays: np.ndarray) -> Log:
        """Return the log with other arrays."""
        return replace(self, arrays={**self.arrays, **arrays})

    def columns(self, change: Callable[[np.ndarray], np.ndarray]) -> Log:
        """Return the log with changed observations, before and after."""
        both = {name: change(np.array(self.arrays[name])) for name in ("observations", "next_observations")}
        return self.changed(**both)

    def config(self, folder: Path) -> dict[str, Any]:
        """Write the log and its model; return the config."""
        (folder / "model.xml").write_text(self.model)
        np.savez(folder / "log.npz", **self.arrays)
        data: dict[str, Any] = {"path": "log.npz"}
        if "time" in self.arrays:
            data["time"] = "time"
        return {
            "model": "model.xml", "data": data, "frame_skip": self.frame_skip, "observation": list(self.observation),
            **self.keys,
        }  # fmt: skip


def examined(config: Mapping[str, Any], folder: Path) -> tuple[tuple[Finding, ...], float]:
    """Return what is found in a log, and in how many seconds of a processor, reading included."""
    began = time.process_time()
    found = read_log(make_config(config, base=folder), uneven=True).examined()
    return found, time.process_time() - began


# --- good logs ------------------------------------------------------------------------------------------------


def good(system: str, seed: Sequence[int]) -> Log:
    """Return a log of a system with a declared parameter off, and noise."""
    if system == "thrown":
        return _thrown(seed)
    known = SYSTEMS[system]
    recording = make_recording(known, (), seed, episodes=6, transitions=150, substeps=20)
    return _written(system, measured(known, recording.log, recording.noise, recording.rng))


def imperfect(spec: hidden.CaseSpec) -> Log:
    """Return a log in which the model lacks something: nothing is wrong with it."""
    return _written(spec.system, spec.make().trajectories)


def _written(system: str, log: Any) -> Log:
    known = SYSTEMS[system]
    names = ("observations", "next_observations", "actions", "terminals")
    arrays = {name: getattr(log, name) for name in names}
    return Log(system, known.xml, known.frame_skip, known.observation, arrays)


def _thrown(seed: Sequence[int], episodes: int = 8, steps: int = 80) -> Log:
    model, rng = load(THROWN), np.random.default_rng(seed)
    data, skip = mujoco.MjData(model), round(DT / model.opt.timestep)
    before, after, actions = [], [], []
    for _ in range(episodes):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = rng.uniform(-1, 1, 6) * [1, 1, 3, 4, 4, 4]
        mujoco.mju_axisAngle2Quat(data.qpos[3:7], _unit(rng.standard_normal(3)), rng.uniform(0, np.pi))
        waves = rng.uniform(0.5, 4, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))
        path = [np.concatenate([data.qpos, data.qvel])]
        for row in range(steps):
            data.ctrl[:] = 0.5 * np.sin(2 * np.pi * waves[0] * row * DT + waves[1]).sum(axis=1)
            actions.append(data.ctrl.copy())
            mujoco.mj_step(model, data, skip)
            path.append(np.concatenate([data.qpos, data.qvel]))
        noise = np.array([2e-4] * 3 + [5e-4] * 4 + [2e-3] * 6)
        noisy = np.array(path) + noise * rng.standard_normal((steps + 1, 13))
        before.append(noisy[:-1])
        after.append(noisy[1:])
    ends = np.tile(np.arange(steps) == steps - 1, episodes)
    arrays = {
        "observations": np.concatenate(before), "next_observations": np.concatenate(after),
        "actions": np.array(actions), "terminals": ends,
    }  # fmt: skip
    return Log("thrown", THROWN, skip, ("qpos", "qvel"), arrays)


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


# --- what can be wrong ----------------------------------------------------------------------------------------

Maker = Callable[[Log, np.random.Generator], Log]
ARM, CART, LEG, BOX = "servo_arm", "cart_pole", "hopper", "thrown"


@dataclass(frozen=True)
class Fault:
    """Something that can be wrong with a log.

    Attributes:
        kind: one of ten kinds.
        name: what it is.
        told: names of findings that tell it.
        make: makes the wrong log of a good one.
        systems: where it can be.
    """

    kind: str
    name: str
    told: tuple[str, ...]
    make: Maker
    systems: tuple[str, ...]


def places(log: Log) -> list[int]:
    """Return the state column of each observed one."""
    from dropo_torch.data.observation import parse_observation

    return list(parse_observation(log.compiled, list(log.observation)).columns)


def hinges(log: Log, velocities: bool) -> list[int]:
    """Return the log's columns of hinges' positions, or velocities."""
    model, found = log.compiled, []
    for i, place in enumerate(places(log)):
        for j in range(model.njnt):
            if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
                continue
            if place == (model.nq + model.jnt_dofadr[j] if velocities else model.jnt_qposadr[j]):
                found.append(i)
    return found


def scalars(log: Log, velocities: bool) -> list[int]:
    """Return the log's columns of positions, or velocities, of hinges and slides of which both are observed."""
    model, where, found = log.compiled, places(log), []
    for j in range(model.njnt):
        first, dof = int(model.jnt_qposadr[j]), model.nq + int(model.jnt_dofadr[j])
        if model.jnt_type[j] in (2, 3) and first in where and dof in where:
            found.append(where.index(dof if velocities else first))
    return found


def _scaled(log: Log, columns: Sequence[int], factor: float) -> Log:
    def change(values: np.ndarray) -> np.ndarray:
        values[:, list(columns)] *= factor
        return values

    return log.columns(change)


def _degrees(log: Log, rng: np.random.Generator) -> Log:
    return _scaled(log, hinges(log, False) + hinges(log, True), 180 / np.pi)


def _velocity_degrees(log: Log, rng: np.random.Generator) -> Log:
    return _scaled(log, hinges(log, True), 180 / np.pi)


def _position_degrees(log: Log, rng: np.random.Generator) -> Log:
    return _scaled(log, hinges(log, False), 180 / np.pi)


def _millimetres(log: Log, rng: np.random.Generator) -> Log:
    slides = [c for c in scalars(log, False) if c not in hinges(log, False)]
    return _scaled(log, slides or range(3), 1e3)


def _sign(log: Log, rng: np.random.Generator) -> Log:
    return _scaled(log, [int(rng.choice(scalars(log, True) or range(7, 10)))], -1.0)


def _swapped(log: Log, rng: np.random.Generator, velocities: bool = True) -> Log:
    turning = hinges(log, velocities)
    first, second = rng.choice(turning if len(turning) > 1 else scalars(log, velocities), 2, replace=False)

    def change(values: np.ndarray) -> np.ndarray:
        values[:, [first, second]] = values[:, [second, first]]
        return values

    return log.columns(change)


def _swapped_positions(log: Log, rng: np.random.Generator) -> Log:
    return _swapped(log, rng, velocities=False)


def _interleaved(log: Log, rng: np.random.Generator) -> Log:
    order = np.arange(log.arrays["observations"].shape[1]).reshape(2, -1).T.reshape(-1)
    return log.columns(lambda values: values[:, order])


def _late_velocity(log: Log, rng: np.random.Generator) -> Log:
    columns = scalars(log, True) or [7, 8, 9]
    ends = np.flatnonzero(log.arrays["terminals"]) + 1
    before, after = (np.array(log.arrays[n]) for n in ("observations", "next_observations"))
    for a, b in zip([0, *ends[:-1]], ends, strict=True):
        path = np.concatenate([before[a:b], after[b - 1 : b]])
        path[1:, columns] = path[:-1, columns]
        before[a:b], after[a:b] = path[:-1], path[1:]
    return log.changed(observations=before, next_observations=after)


def _wrapped(log: Log, rng: np.random.Generator) -> Log:
    columns, span = hinges(log, False), rng.choice([0.0, np.pi])
    wide = [c for c in columns if np.ptp(log.arrays["observations"][:, c]) > 0.5]
    middle = {c: float(np.median(log.arrays["observations"][:, c])) for c in wide}

    def change(values: np.ndarray) -> np.ndarray:
        for c in wide:  # a range that ends in the middle of the motion, as 0 or ±π may
            low = np.round((middle[c] - span) / np.pi) * np.pi if abs(middle[c]) > 2 else 0.0
            values[:, c] = low + np.mod(values[:, c] - low, 2 * np.pi)
        return values

    return log.columns(change)


def _xyzw(log: Log, rng: np.random.Generator) -> Log:
    first = places(log).index(3)
    order = list(range(first)) + [first + 1, first + 2, first + 3, first] + list(range(first + 4, len(places(log))))
    return log.columns(lambda values: values[:, order])


def _world_rates(log: Log, rng: np.random.Generator) -> Log:
    def change(values: np.ndarray) -> np.ndarray:
        turned = np.empty(3)
        for row in values:
            mujoco.mju_rotVecQuat(turned, row[10:13].copy(), row[3:7] / np.linalg.norm(row[3:7]))
            row[10:13] = turned
        return values

    return log.columns(change)


def _percent(log: Log, rng: np.random.Generator) -> Log:
    limited = log.model
    for actuator in ("motor", "position"):
        limited = limited.replace(f"<{actuator} ", f'<{actuator} ctrllimited="true" ctrlrange="-2 2" ')
    limited = limited.replace('ctrllimited="true" ctrlrange="-2 2" ctrllimited="true"', 'ctrllimited="true"')
    return replace(log, model=limited).changed(actions=100 * log.arrays["actions"])


def _shifted(rows: int) -> Maker:
    def make(log: Log, rng: np.random.Generator) -> Log:
        actions = np.array(log.arrays["actions"])
        ends = np.flatnonzero(log.arrays["terminals"]) + 1
        for a, b in zip([0, *ends[:-1]], ends, strict=True):
            actions[a:b] = actions[np.clip(np.arange(a, b) - rows, a, b - 1)]
        return log.changed(actions=actions)

    return make


def _negated(log: Log, rng: np.random.Generator) -> Log:
    actions = np.array(log.arrays["actions"])
    actions[:, int(rng.integers(actions.shape[1]))] *= -1
    return log.changed(actions=actions)


def _exchanged(log: Log, rng: np.random.Generator) -> Log:
    order = np.arange(log.arrays["actions"].shape[1])
    i, j = rng.choice(len(order), 2, replace=False)
    order[[i, j]] = order[[j, i]]
    return log.changed(actions=log.arrays["actions"][:, order])


def _joined(log: Log, rng: np.random.Generator) -> Log:
    return log.changed(terminals=np.arange(len(log.arrays["terminals"])) == len(log.arrays["terminals"]) - 1)


def _samples(log: Log) -> Log:
    """The log with next rows for next observations, as a table of samples has it."""
    return replace(log, arrays={k: v for k, v in log.arrays.items() if k != "next_observations"})


def _joined_samples(log: Log, rng: np.random.Generator) -> Log:
    return _samples(_joined(log, rng))


def _frame_skip(log: Log, rng: np.random.Generator) -> Log:
    return replace(log, frame_skip=int(log.frame_skip * rng.choice([2, 3, 4])))


def _one_step(log: Log, rng: np.random.Generator) -> Log:
    return replace(log, frame_skip=1)


def _stamped(log: Log, times: Callable[[np.ndarray], np.ndarray]) -> Log:
    return _samples(log).changed(time=times(DT * np.arange(len(log.arrays["terminals"]))))


def _milliseconds(log: Log, rng: np.random.Generator) -> Log:
    return _stamped(log, lambda t: 1e3 * t)


def _jitter(log: Log, rng: np.random.Generator) -> Log:
    return _stamped(log, lambda t: t + rng.uniform(-0.3, 0.3, len(t)) * DT)


def _dropouts(log: Log, rng: np.random.Generator) -> Log:
    kept = rng.uniform(size=len(log.arrays["terminals"])) > 0.03
    kept |= log.arrays["terminals"]
    stamped = _stamped(log, lambda t: t)
    return replace(stamped, arrays={k: v[kept] for k, v in stamped.arrays.items()})


def _other_rate(log: Log, rng: np.random.Generator) -> Log:
    return replace(_stamped(log, lambda t: t), frame_skip=int(log.frame_skip * rng.choice([2, 5])))


def _held(log: Log, rng: np.random.Generator) -> Log:
    taken = np.arange(len(log.arrays["terminals"])) // 2 * 2
    return _samples(log).changed(observations=log.arrays["observations"][taken])


def _frozen(log: Log, rng: np.random.Generator) -> Log:
    ends = np.flatnonzero(log.arrays["terminals"]) + 1
    column = int(rng.choice(scalars(log, False) or range(3)))
    observations = np.array(log.arrays["observations"])
    for a, b in zip([0, *ends[:-1]], ends, strict=True):
        middle = (a + b) // 2
        observations[middle : min(middle + 40, b), column] = observations[middle, column]
    return _samples(log).changed(observations=observations)


def _no_velocity(log: Log, rng: np.random.Generator) -> Log:
    return _scaled(log, [int(rng.choice(scalars(log, True) or range(7, 10)))], 0.0)


def _spiked(log: Log, rng: np.random.Generator) -> Log:
    column = int(rng.choice(scalars(log, False) or range(3)))
    inside = np.flatnonzero(~log.arrays["terminals"][:-1]) + 1
    row, out = int(rng.choice(inside)), {n: np.array(log.arrays[n]) for n in ("observations", "next_observations")}
    far = 2 * np.ptp(out["observations"][:, column])
    out["observations"][row, column] += far
    out["next_observations"][row - 1, column] += far
    return log.changed(**out)


def _quantised(log: Log, rng: np.random.Generator) -> Log:
    columns = scalars(log, False) or [0, 1, 2]

    def change(values: np.ndarray) -> np.ndarray:
        values[:, columns] = np.round(values[:, columns], 1)
        return values

    return log.columns(change)


def _same_row(log: Log, rng: np.random.Generator) -> Log:
    return log.changed(next_observations=log.arrays["observations"])


FAULTS = (
    Fault("units", "angles in degrees", ("degrees",), _degrees, (ARM, CART, LEG)),
    Fault("units", "velocities in degrees per second", ("units",), _velocity_degrees, (ARM, CART, LEG)),
    Fault("units", "positions alone in degrees", ("units",), _position_degrees, (ARM, CART, LEG)),
    Fault("units", "positions in millimetres", ("units",), _millimetres, (CART, BOX)),
    Fault("columns", "a velocity's sign", ("sign",), _sign, (ARM, CART, LEG, BOX)),
    Fault("columns", "two velocities exchanged", ("order",), _swapped, (ARM, LEG)),
    Fault("columns", "two positions exchanged", ("order",), _swapped_positions, (ARM, LEG)),
    Fault("columns", "positions and velocities in turn", ("order",), _interleaved, (ARM, CART)),
    Fault("velocity late", "velocities a row late", ("delay",), _late_velocity, (ARM, CART, LEG, BOX)),
    Fault("wraps", "angles that wrap", ("wraps",), _wrapped, (ARM, CART)),
    Fault("quaternion", "quaternion in the order x, y, z, w", ("quaternion_order",), _xyzw, (BOX, "puck")),
    Fault("quaternion", "angular velocity in the world's frame", ("angular_frame",), _world_rates, (BOX,)),
    Fault("commands", "commands in percent", ("ctrlrange",), _percent, (ARM, CART, BOX)),
    Fault("commands", "a command's sign", ("action_sign",), _negated, (ARM, CART, LEG, BOX)),
    Fault("commands", "two commands exchanged", ("action_order",), _exchanged, (ARM, LEG, BOX)),
    Fault("rows of commands", "the previous command", ("action_shift",), _shifted(1), (ARM, CART, LEG, BOX)),
    Fault("rows of commands", "the next command", ("action_shift",), _shifted(-1), (ARM, CART, LEG, BOX)),
    Fault("joined", "episodes joined", ("joined",), _joined, (ARM, CART, LEG, BOX)),
    Fault("joined", "tables of samples joined", ("joined",), _joined_samples, (ARM, CART, LEG, BOX)),
    Fault("joined", "next observations of the same row", ("next_observations",), _same_row, (ARM, CART, LEG, BOX)),
    Fault("time step", "another frame_skip", ("frame_skip",), _frame_skip, (ARM, CART, LEG, BOX)),
    Fault("time step", "frame_skip left at 1", ("frame_skip",), _one_step, (ARM, CART, LEG, BOX)),
    Fault("time step", "frame_skip against stamps", ("frame_skip",), _other_rate, (ARM, CART, LEG, BOX)),
    Fault("stamps", "milliseconds", ("time_unit",), _milliseconds, (ARM, CART, LEG, BOX)),
    Fault("stamps", "jitter", ("jitter",), _jitter, (ARM, CART, LEG, BOX)),
    Fault("stamps", "dropouts", ("dropouts",), _dropouts, (ARM, CART, LEG, BOX)),
    Fault("columns stuck", "every other row a copy", ("repeated",), _held, (ARM, CART, LEG, BOX)),
    Fault("columns stuck", "a position that freezes", ("frozen",), _frozen, (ARM, CART, LEG)),
    Fault("columns stuck", "a velocity that was not measured", ("frozen",), _no_velocity, (ARM, CART, LEG, BOX)),
    Fault("columns stuck", "a spike in a position", ("spike",), _spiked, (ARM, CART, LEG, BOX)),
    Fault("columns stuck", "positions to a tenth", ("quantised",), _quantised, (ARM, CART, LEG)),
)  # fmt: skip


# --- scoring --------------------------------------------------------------------------------------------------


def wrong_logs(seed: int, each: int) -> list[tuple[Fault, str]]:
    """Return which faults in logs of which systems, so many of each fault where its systems suffice."""
    rng = np.random.default_rng([seed, 1])
    return [
        (fault, str(system)) for fault in FAULTS
        for system in rng.permutation(fault.systems)[: min(each, len(fault.systems))]
    ]  # fmt: skip


def score_wrong(fault: Fault, system: str, seed: int) -> dict[str, Any]:
    """Return what is found in a wrong log."""
    number = zlib.crc32(f"{fault.name} {system}".encode())
    log = fault.make(good(system, (seed, number)), np.random.default_rng([seed, number]))
    with tempfile.TemporaryDirectory() as place:
        config = log.config(Path(place))
        found, seconds = examined(config, Path(place))
        named = [f for f in found if f.name in fault.told]
        told = bool(named) and (named[0].sure or not any(f.sure for f in found))
        left = None
        if named and named[0].cure:
            left = [f.name for f in _after(config, named[0].cure, Path(place)) if f.sure]
    return {
        "kind": fault.kind, "fault": fault.name, "system": system, "told": told,
        "sure": bool(named) and named[0].sure, "cured": None if left is None else not left, "left": left,
        "found": [f"{f.name} ({f.confidence})" for f in found], "seconds": seconds,
        "cure": named[0].cure_line if named else "",
    }  # fmt: skip


def _after(config: Mapping[str, Any], cure: Mapping[str, Any], folder: Path) -> Sequence[Finding]:
    """What is found once a cure is in the config."""
    merged = {**config, **cure, "data": {**config["data"], **cure.get("data", {})}}
    stamps = merged["data"].get("time")
    if isinstance(stamps, dict):
        merged["data"]["time"] = {**stamps, "signal": "time"}
    try:
        return examined(merged, folder)[0]
    except ValueError as error:
        return (Finding("refused", (), str(error), "sure"),)


def good_logs(seed: int, count: int) -> list[tuple[str, Callable[[], Log]]]:
    """Return good logs: of each system as the model has it, then with something that the model lacks."""
    found: list[tuple[str, Callable[[], Log]]] = []
    for system in (ARM, CART, LEG, BOX, "torque_arm", "furuta", "puck"):
        found.append((system, lambda system=system: good(system, (seed, 7))))
    specs = [s for s in hidden.cases(seed) if s.effects]
    rng = np.random.default_rng([seed, 2])
    picked = rng.permutation(len(specs))[: max(0, count - len(found))]
    return found + [(specs[i].name, lambda spec=specs[i]: imperfect(spec)) for i in picked]


def score_good(name: str, make: Callable[[], Log]) -> dict[str, Any]:
    """Return what is found in a good log."""
    log = make()
    with tempfile.TemporaryDirectory() as place:
        found, seconds = examined(log.config(Path(place)), Path(place))
    return _good(name, found, seconds)


def _good(name: str, found: Sequence[Finding], seconds: float) -> dict[str, Any]:
    alarms = [f.name for f in found if f.sure]
    return {"log": name, "alarms": alarms, "doubts": [f.name for f in found if not f.sure], "seconds": seconds,
            "what": [f.what for f in found]}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--each", type=int, default=2, help="logs of each fault")
    parser.add_argument("--good", type=int, default=30, help="good logs, measured ones not counted")
    parser.add_argument("--only", default="", help="faults whose name holds this")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(arguments)
    wrong = []
    for fault, system in wrong_logs(given.seed, given.each):
        if given.only not in fault.name:
            continue
        row = score_wrong(fault, system, given.seed)
        wrong.append(row)
        cured = {None: "", True: "cured", False: f"left: {row['left']}"}[row["cured"]]
        print(f"{'told' if row['told'] else 'MISSED':<7}{fault.name:<40}{system:<11}{row['seconds']:5.2f} s  "
              f"{', '.join(row['found']):<60} {cured}", flush=True)  # fmt: skip
    right = []
    for name, make in good_logs(given.seed, given.good) if given.good else []:
        right.append(score_good(name, make))
        _print_good(right[-1])
    if given.good and "DROPO_DATA" in os.environ:
        from benchmarks.measured_logs import measured_logs

        for name, config, folder in measured_logs(Path(os.environ["DROPO_DATA"])):
            right.append(_good(name, *examined(config, folder)))
            _print_good(right[-1])
    _summary(wrong, right)
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "wrong_logs.json").write_text(json.dumps({"wrong": wrong, "good": right}, indent=1))


def _print_good(row: Mapping[str, Any]) -> None:
    words = "ALARM " + ", ".join(row["alarms"]) if row["alarms"] else "quiet"
    doubts = f"; doubts: {', '.join(row['doubts'])}" if row["doubts"] else ""
    print(f"good   {row['log']:<52}{row['seconds']:5.2f} s  {words}{doubts}", flush=True)


def _summary(wrong: Sequence[Mapping[str, Any]], right: Sequence[Mapping[str, Any]]) -> None:
    told = sum(row["told"] for row in wrong)
    sure = sum(row["told"] and row["sure"] for row in wrong)
    cures = [row["cured"] for row in wrong if row["cured"] is not None]
    kinds, slowest = {row["kind"] for row in wrong}, max([r["seconds"] for r in [*wrong, *right]], default=0.0)
    print(f"\n{told} of {len(wrong)} wrong logs of {len(kinds)} kinds told, {sure} of them surely; {sum(cures)} of "
          f"{len(cures)} cures leave nothing sure")  # fmt: skip
    alarms, doubts = sum(bool(row["alarms"]) for row in right), sum(bool(row["doubts"]) for row in right)
    print(f"{alarms} of {len(right)} good logs stopped, {doubts} with doubts; slowest {slowest:.2f} s of a processor")


if __name__ == "__main__":
    main()
