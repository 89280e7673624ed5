"""What does a model of the EMPS drive lack that has the carriage's mass and nothing else?

    python examples/emps/gap.py path/to/DATA_EMPS.mat

Names the missing effects from the first three quarters of the measured log, and compares their strengths and
open-loop predictions of the unseen quarter, over windows of several lengths, with the published reference model (see
emps.py), which was identified from all of it. The report of the same search is made by
`dropo gap examples/emps/gap.yaml --data.path /path/to/DATA_EMPS.mat --out out/emps`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import dropo_torch as dropo
from dropo_torch.effects import Placed, find_effect
from dropo_torch.gap import Gap, Hypothesis, Scene, find_gap, open_loop, prepare

sys.path.insert(0, str(Path(__file__).parent))
import emps

CONFIG = Path(__file__).parent / "gap.yaml"
#: Which published number each effect stands for; joint and actuator are the same thing on a single drive.
PUBLISHED = {
    "joint_damping": "viscous_friction",
    "actuator_damping": "viscous_friction",
    "joint_friction": "coulomb_friction",
    "actuator_bias": "force_offset",
}
#: Seconds of open-loop predictions.
SECONDS = (0.1, 0.3, 1.0, 3.0)


def tell(stage: str, share: float) -> None:
    """Say what the search does as it begins."""
    if share == 0:
        print(stage, file=sys.stderr, flush=True)


def prepared(data: Path, backend: str) -> Scene:
    """Return what the search works on, of the model as it is given."""
    config = dropo.load_config(CONFIG, {"data.path": str(data.resolve()), "backend": backend})
    return prepare(dropo.make_problem(config, general=True))


def found_values(gap: Gap) -> dict[str, float]:
    """Return the found numbers by their published names; what was not named is zero."""
    values = dict.fromkeys(emps.REFERENCE, 0.0) | {"mass": gap.declared["mass"][2]}
    for effect in gap.effects:
        if effect.effect in PUBLISHED:
            values[PUBLISHED[effect.effect]] = next(iter(effect.parameters.values())).value
    return values


def drive(scene: Scene, values: Mapping[str, float]) -> Hypothesis:
    """Return the drive with numbers by their published names."""
    effects = (("joint_damping", "viscous_friction"), ("joint_friction", "coulomb_friction"),
               ("actuator_bias", "force_offset"))  # fmt: skip
    known = [(find_effect(effect), values[name]) for effect, name in effects]
    return Hypothesis(
        (values["mass"],), tuple(Placed(e, e.targets(scene.setting)[0], (value,)) for e, value in known if value)
    )


def print_errors(scene: Scene, gap: Gap) -> None:
    """Print the open-loop errors of the unseen quarter, in mm, over all lengths of windows."""
    rows = {"model as given": scene.begin, "published model": drive(scene, emps.REFERENCE),
            "with what was found": drive(scene, found_values(gap))}  # fmt: skip
    found = {label: [open_loop(scene, h, s) for s in SECONDS] for label, h in rows.items()}
    found = {"constant velocity": [(constant, 0.0) for _, constant in found["model as given"]], **found}
    print(f"open-loop error of positions, mm, over {', '.join(f'{s:g}' for s in SECONDS)} s of the unseen quarter")
    for label, errors in found.items():
        print(f"{label:<44}" + "".join(f"{1e3 * error:>9.3g}" for error, _ in errors))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="DATA_EMPS.mat")
    parser.add_argument("--backend", choices=["mujoco", "warp"], default="warp")
    given = parser.parse_args(arguments)
    scene = prepared(given.data, given.backend)
    gap = find_gap(scene.problem, report=tell, scene=scene)
    for effect in gap.effects:
        ties = ", ".join(f"{e} of {t}" for e, t in effect.indistinguishable_from)
        numbers = ", ".join(
            f"{n} {s.value:.4g} ({s.low:.4g} to {s.high:.4g}) {s.unit}" for n, s in effect.parameters.items()
        )
        print(f"{effect.effect} of {effect.target}: {numbers}" + (f"; cannot be told from {ties}" if ties else ""))
    values = found_values(gap)
    for name, published in emps.REFERENCE.items():
        print(f"{name:<18}{values[name]:>10.2f}{published:>10.1f}{100 * (values[name] / published - 1):>+9.2f} %")
    problem = dropo.make_problem(dropo.load_config(emps.CONFIG, {"data.path": str(given.data.resolve())}))
    vectors = np.stack([problem.space.vector(v) for v in (values, emps.REFERENCE)])
    ours, theirs = 1e3 * emps.open_loop_error(problem, vectors)
    print_errors(scene, gap)
    print(f"over its disjoint windows of 3 s, as in emps.py: {ours:.2f} mm with the found values, "
          f"{theirs:.2f} mm published")  # fmt: skip
    print(f"{gap.seconds:.0f} s, {gap.simulated_transitions} simulated transitions")


if __name__ == "__main__":
    main()
