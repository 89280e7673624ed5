"""What do the joints of two measured pendulums have that their models lack?

    python examples/pendulums/pendulums.py double FOLDER
    python examples/pendulums/pendulums.py simple FOLDER

FOLDER holds the publishers' files (see docs/real-robots.md): trajectory_00.csv to 03 and identified_model_*.yml, or
ddp.csv. The search sees the first three of the four trajectories, or the first three quarters of the one; the table
compares open-loop predictions of the rest. The publishers' own identified models of the double pendulum stand beside.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import yaml

import dropo_torch as dropo
from dropo_torch.gap import Hypothesis, Naming, Scene, name, open_loop, prepare

HERE = Path(__file__).parent
LOGS = {"double": [f"trajectory_0{i}.csv" for i in range(4)], "simple": ["ddp.csv"]}
SECONDS = (0.1, 0.3, 1.0)
TORQUES = {"commanded": "tau_con", "measured": "tau_meas"}
#: Least moment of inertia about the center of mass, as a share of that about the joint.
LEAST = 0.1


def scene_of(kind: str, folder: Path, **overrides: object) -> Scene:
    """Return what a search works on, of the model as it is given."""
    given = {"data.path": [str((folder / log).resolve()) for log in LOGS[kind]], **overrides}
    return prepare(dropo.make_problem(dropo.load_config(HERE / f"{kind}.yaml", given), general=True))


def scenes_of(kind: str, folder: Path) -> dict[str, Scene]:
    """Return what is searched, by what is added to its label: of the double pendulum, with either torque."""
    if kind == "simple":
        return {"": scene_of(kind, folder)}
    return {
        f", {torque} torque": scene_of(kind, folder, **{"data.actions": [f"{column}1", f"{column}2"]})
        for torque, column in TORQUES.items()
    }


def published_model(numbers: Mapping[str, float]) -> str:
    """Return the double pendulum's MJCF with the numbers of an identified model.

    Its moments of inertia are about the joints. What moves depends on the second link's mass only through its first
    moment and what it adds to the first link, so where the mass would need a negative inertia, a larger one nearer to
    the joint takes its place.
    """
    n = dict(numbers)
    mass = max(n["m2"], (n["m2"] * n["r2"]) ** 2 / ((1 - LEAST) * n["I2"]))
    more, reach = mass - n["m2"], n["m2"] * n["r2"] / mass
    upper = (n["m1"], (n["m1"] * n["r1"] - more * n["l1"]) / n["m1"], n["I1"] - more * n["l1"] ** 2)
    spec = mujoco.MjSpec.from_file(str(HERE / "double.xml"))
    for link, (weight, at, inertia) in (("upper", upper), ("lower", (mass, reach, n["I2"]))):
        body = spec.body(link)
        own = inertia - weight * at**2
        body.mass, body.ipos, body.inertia = weight, [0, 0, -at], [own, own, 0.5 * own]
    for joint, end in (("shoulder", "1"), ("elbow", "2")):
        pivot = spec.joint(joint)
        pivot.armature = n["Ir"] * n["gr"] ** 2
        pivot.frictionloss = n["cf" + end]
        pivot.damping[0] = n["b" + end]
    spec.compile()
    return str(spec.to_xml())


def published(folder: Path, out: Path) -> dict[str, Scene]:
    """Return the scenes of the publishers' models, each with commanded and with measured torques."""
    found = {}
    for path in sorted(folder.glob("identified_model_*.yml")):
        model = out / f"{path.stem}.xml"
        model.write_text(published_model(yaml.safe_load(path.read_text())))
        for torque, column in TORQUES.items():
            columns = {"data.actions": [f"{column}1", f"{column}2"], "model": str(model.resolve())}
            found[f"{path.stem}, {torque} torque"] = scene_of("double", folder, **columns)
    return found


def errors(scene: Scene, hypothesis: Hypothesis) -> list[float]:
    """Return the errors over all horizons, in thousandths."""
    return [1e3 * open_loop(scene, hypothesis, s)[0] for s in SECONDS]


def tell(scene: Scene, naming: Naming) -> None:
    """Print what was named, and the declared parameters beside it."""
    for placed in naming.final.hypothesis.placed:
        numbers = placed.summary(scene.setting)
        print(f"{placed.effect.name} of {placed.target}: " + ", ".join(f"{k} {v:.4g}" for k, v in numbers.items()))
    declared = dict(zip(scene.problem.space.names, naming.final.hypothesis.declared, strict=True))
    print("".join(f"{parameter}: {value:.4g}\n" for parameter, value in declared.items()), end="")
    if not naming.named:
        print(f"nothing has a name: {naming.refused or 'no known effect accounts for the misfit'}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(LOGS))
    parser.add_argument("folder", type=Path, help="holds the publishers' files")
    parser.add_argument("--out", type=Path, default=Path("out/pendulums"))
    given = parser.parse_args(arguments)
    for log in LOGS[given.kind]:
        if not (path := given.folder / log).is_file():
            parser.error(f"{path}: no such file; expected the folder of the publishers' {given.kind} pendulum")
    given.out.mkdir(parents=True, exist_ok=True)
    scenes = scenes_of(given.kind, given.folder)
    scene, found = next(iter(scenes.values())), {}
    for label, own in scenes.items():
        print(f"looking for what the model lacks{label}", file=sys.stderr, flush=True)
        found[label] = name(own)
        print(f"found{label}:")
        tell(own, found[label])
    print(f"\nopen-loop error of positions, mrad, over {', '.join(f'{s:g}' for s in SECONDS)} s of unseen motion")
    rows = {
        "constant velocity": [1e3 * open_loop(scene, scene.begin, s)[1] for s in SECONDS],
        "model as given": errors(scene, scene.begin),
    }
    if given.kind == "double":
        rows |= {label: errors(s, s.begin) for label, s in published(given.folder, given.out).items()}
    for label, naming in found.items():
        if scene.begin.declared:
            rows[f"with the declared parameters fitted{label}"] = errors(scenes[label], naming.base.hypothesis)
        if naming.named:
            rows[f"with what was found{label}"] = errors(scenes[label], naming.final.hypothesis)
    for label, values in rows.items():
        print(f"{label:<44}" + "".join(f"{v:>9.1f}" for v in values))


if __name__ == "__main__":
    main()
