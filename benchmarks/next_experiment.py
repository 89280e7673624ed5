"""Score the motions that `dropo gap` proposes where effects tie: record them, add them to the log, and search again.

    python benchmarks/next_experiment.py --cases 60 --jobs 2          # of a fresh seed
    python benchmarks/next_experiment.py --seed 7 --cases 20

The logs are short and slow, so that more effects tie than need to. A case counts where the answer holds the hidden
effect, tied with another one, and proposes a motion. The same truth then moves so; the tie is broken if the answer to
both logs together names the hidden effect, or its exact equivalent, and does not have that pair as a tie any more.
"""

from __future__ import annotations

import argparse
import functools
import re
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden.cases import OPTIONS, drawn
from benchmarks.hidden.systems import SYSTEMS, System
from benchmarks.hidden.truths import Effect, Log, Recording, make_case, make_recording, repeat
from benchmarks.hidden_effects import judge, run_case, share
from dropo_torch.commands.options import workers
from dropo_torch.gap.suggest import COMMANDS, STARTS
from dropo_torch.support.parallel import in_parallel

#: Systems whose searches take seconds.
QUICK = ("servo_arm", "cart_pole", "furuta")
#: A log that shows little: factor of its commands' and its starts' sizes, of the noise, episodes, rows of each.
GENTLE, NOISE, EPISODES, ROWS = 0.2, 3.0, 2, 100
#: Effects that others resemble in a gentle motion.
LIKELY = (
    "actuator_delay", "actuator_lag", "joint_damping", "joint_quadratic_damping", "fluid_drag", "payload",
    "center_of_mass", "inertia", "gravity_tilt", "external_force", "sensor_bias", "actuator_deadband",
    "actuator_backlash",
)  # fmt: skip


def gentle(system: System) -> System:
    """The same system, moved gently."""
    commands = tuple(replace(c, amplitude=GENTLE * c.amplitude) for c in system.commands)
    start = {j: (GENTLE * q, GENTLE * v) for j, (q, v) in system.start.items()}
    return replace(system, commands=commands, start=start)


def attempt(number: int, seed: int, backend: str, threads: int = 0) -> dict[str, Any]:
    """One case: a draw of a system and an effect, its answer, and that with the proposed motion, if there is one."""
    rng = np.random.default_rng([seed, number])
    effect = str(rng.choice([e for e in LIKELY if set(OPTIONS[e]) & set(QUICK)]))
    name = str(rng.choice([s for s in QUICK if s in OPTIONS[effect]]))
    result: dict[str, Any] = {"name": f"{number}-{name}-{effect}"}
    try:
        system, own = gentle(SYSTEMS[name]), [seed, number, 1]
        effects = [drawn(system, effect, rng, own)]
        recording = make_recording(system, effects, own, episodes=EPISODES, transitions=ROWS)
        first = _answer(system, effects, recording, backend, threads)
        result |= {"said": first["next_experiment"] or "", "named": first["named"]}
        told = proposal(first)
        if told is None or not first["right"]:
            return result
        pair, motion = told
        vary, faster = COMMANDS.get(motion, _same), STARTS.get(motion, 1.0)
        more = repeat(system, recording.declared, effects, recording.log, vary, faster)
        both = replace(recording, log=Log(*(a + b for a, b in zip(_parts(recording.log), _parts(more), strict=True))))
        second = _answer(system, effects, both, backend, threads)
        broken = second["right"] and not tied(second, pair)
        result |= {"second": second["named"], "right": second["right"], "broken": broken}
    except Exception:  # a case that fails must not stop the others
        result["failure"] = traceback.format_exc()
    return result


def _same(commands: np.ndarray) -> np.ndarray:
    return commands


def _parts(log: Log) -> tuple[tuple[np.ndarray, ...], ...]:
    return log.states, log.commands, log.unlogged


def _answer(
    system: System, effects: Sequence[Effect], recording: Recording, backend: str, threads: int
) -> dict[str, Any]:
    case = make_case(system, effects, recording, noise=NOISE, ties=[()] * len(effects))
    document = run_case(case, backend, threads)
    return document | {"right": judge(case, document)["right"], "named": judge(case, document)["named"]}


Pair = frozenset[str]


def proposal(answer: Mapping[str, Any]) -> tuple[Pair, str] | None:
    """The pair that a proposed motion is to tell apart, as it is called, and the motion; ``None`` without one."""
    words = re.match(r"To tell (.*) from (.*), record (.*): over", answer["next_experiment"] or "")
    return None if words is None else (frozenset(words.group(1, 2)), words.group(3))


def tied(answer: Mapping[str, Any], pair: Pair) -> bool:
    """Whether an answer still has a pair of effects as a tie."""
    for entry in answer["effects"]:
        for other in entry.get("indistinguishable_from") or []:
            if frozenset(map(called, (entry, other))) == pair:
                return True
    return False


def called(entry: Mapping[str, Any]) -> str:
    """An effect as proposals call it."""
    return entry["effect"] + (f" of {entry['target']}" if entry.get("target") else "")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, help="fresh from the clock where absent")
    parser.add_argument("--cases", type=int, default=60, help="draws of a system and an effect")
    parser.add_argument("--jobs", type=workers, default=1, metavar="N|ray", help="processes")
    parser.add_argument("--backend", choices=("mujoco", "warp"), default="mujoco")
    given = parser.parse_args(arguments)
    seed = int(time.time()) % 1_000_000 if given.seed is None else given.seed
    print(f"seed {seed}: {given.cases} cases", flush=True)
    work = functools.partial(attempt, seed=seed, backend=given.backend)
    results = []
    for _, r in in_parallel(work, range(given.cases), given.jobs):
        results.append(r)
        verdict = r["failure"].strip().splitlines()[-1] if "failure" in r else ""
        if "broken" in r:
            verdict = ("broken" if r["broken"] else f"NOT BROKEN, now {r['second']}") + f": {r['said']}"
        print(f"{r['name']}: {verdict or 'no motion proposed, ' + str(r.get('named'))}", flush=True)
    asked = [r["broken"] for r in results if "broken" in r]
    print(f"\nties that the proposed motion broke  {share(asked)}")
    print(f"failed cases  {sum('failure' in r for r in results)}")


if __name__ == "__main__":
    main()
