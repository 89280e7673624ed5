"""Do policies that are trained over a fitted distribution work on a robot that the model does not describe?

    python examples/transfer_manipulation.py puck --out out/transfer_puck
    python examples/transfer_manipulation.py push --out out/transfer_push

The robot is a second simulation that has what reality has and the model lacks, and writes what a robot's equipment
would: encoder readings, frames of a late camera, commands. From its log on, everything is what a user would do: check,
gap, fits by each method, a policy over each distribution, and a few rollouts on the robot. ``--resume`` goes on with
what is in the folder; ``--reduced`` is small; ``--methods``, ``--boxes`` and ``--seeds`` choose a part.
"""

from __future__ import annotations

import argparse
import pkgutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dropo_sims.transfer import METHODS, Robot

from dropo_torch.commands.options import workers
from dropo_torch.errors import InputError

ROBOTS = {"puck": "dropo_sims.puck.transfer:ROBOT", "push": "dropo_sims.push.transfer:ROBOT"}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=ROBOTS)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="keep what is finished there")
    parser.add_argument("--reduced", action="store_true", help="a minute or two, which says nothing of the methods")
    parser.add_argument("--seeds", type=int, help="logs")
    parser.add_argument("--boxes", type=int, help="boxes of uniform randomization")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="whose policies are trained")
    parser.add_argument("--workers", type=workers, default=1, metavar="N|ray", help="processes side by side")
    given = parser.parse_args(arguments)
    for name in ("seeds", "boxes"):
        if (value := getattr(given, name)) is not None and value < 1:
            parser.error(f"--{name} {value}: expected 1 or more")
    robot: Robot = pkgutil.resolve_name(ROBOTS[given.robot])
    chosen = {name: getattr(given, name) for name in ("seeds", "boxes") if getattr(given, name) is not None}
    if given.methods:
        chosen["methods"] = tuple(name for name in METHODS if name in given.methods)
    plan = replace(robot.reduced if given.reduced else robot.plan, **chosen)
    try:
        found = robot.run(given.out, plan=plan, resume=given.resume, report=show, workers=given.workers)
    except InputError as error:
        parser.error(str(error))
    for line in found:
        print(f"  - {line}")
    print(f"tables: {given.out / 'tables.md'}; report: {given.out / 'report.html'}")


def show(stage: str, share: float) -> None:
    """Print what is done."""
    print(f"{100 * share:3.0f} %  {stage}", flush=True)


if __name__ == "__main__":
    main()
