"""What does a model of the EMPS drive lack that has the carriage's mass and nothing else?

    python examples/emps/gap.py path/to/DATA_EMPS.mat

Names the missing effects from the first three quarters of the measured log, and compares their strengths and the
open-loop prediction of the unseen quarter with the published reference model (see emps.py). The report of the same
search is made by `dropo gap examples/emps/gap.yaml --data.path /path/to/DATA_EMPS.mat --out out/emps`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import dropo_torch as dropo
from dropo_torch.gap import Gap, find_gap

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


def tell(stage: str, share: float) -> None:
    """Say what the search does as it begins."""
    if share == 0:
        print(stage, file=sys.stderr, flush=True)


def search(data: Path, backend: str) -> Gap:
    """Look for what the model lacks."""
    config = dropo.load_config(CONFIG, {"data.path": str(data.resolve()), "backend": backend})
    return find_gap(dropo.make_problem(config, general=True), report=tell)


def found_values(gap: Gap) -> dict[str, float]:
    """Return the found numbers by their published names; what was not named is zero."""
    values = dict.fromkeys(emps.REFERENCE, 0.0) | {"mass": gap.declared["mass"][2]}
    for effect in gap.effects:
        if effect.effect in PUBLISHED:
            values[PUBLISHED[effect.effect]] = next(iter(effect.parameters.values())).value
    return values


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="DATA_EMPS.mat")
    parser.add_argument("--backend", choices=["mujoco", "warp"], default="warp")
    given = parser.parse_args(arguments)
    gap = search(given.data, given.backend)
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
    before, after = 1e3 * gap.before.rollout_rmse, 1e3 * gap.after.rollout_rmse
    print(f"open-loop error over {gap.rollout_seconds:g} s of the unseen quarter: {before:.1f} mm with the mass alone, "
          f"{after:.2f} mm with the effects")  # fmt: skip
    print(f"over its disjoint windows, as in emps.py: {ours:.2f} mm with the found values, {theirs:.2f} mm published")
    print(f"{gap.seconds:.0f} s, {gap.simulated_transitions} simulated transitions")


if __name__ == "__main__":
    main()
