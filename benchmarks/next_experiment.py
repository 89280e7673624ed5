"""Score the motions that `dropo gap` proposes where effects tie: record them, add them to the log, and search again.

    python benchmarks/next_experiment.py --cases 60 --jobs 2          # of a fresh seed
    python benchmarks/next_experiment.py --seed 7 --cases 20
    python benchmarks/next_experiment.py --cases 20 --plan 4          # motions of 4 s by `dropo plan --gap` instead

The logs are short and slow, so that more effects tie than need to. A case counts where the answer holds the hidden
effect, tied with another one, and proposes a motion. The same truth then moves so; the tie is broken if the answer to
both logs together names the hidden effect, or its exact equivalent, and does not have that pair as a tie any more.

With --plan, `dropo plan --gap` plans the motion, within the limits of a robot that moves as fast and as far as these
systems do when they are not gentle, and all pairs of the plan must be told apart.
"""

from __future__ import annotations

import argparse
import functools
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden.cases import OPTIONS, drawn
from benchmarks.hidden.systems import SYSTEMS, System, load
from benchmarks.hidden.truths import Case, Effect, Log, Recording, make_case, make_recording, repeat
from benchmarks.hidden_effects import judge, run_case, share
from dropo_torch.commands.options import workers
from dropo_torch.config import load_config
from dropo_torch.gap import add, find_gap
from dropo_torch.gap.suggest import COMMANDS, STARTS
from dropo_torch.planning import make_plan, prepare
from dropo_torch.problem import make_problem
from dropo_torch.support.files import write_json
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


Pair = frozenset[str]


@dataclass(frozen=True)
class Motion:
    """A motion to record: commands that a log's are varied to, from its starts, and the pairs to tell apart."""

    vary: Callable[[np.ndarray], np.ndarray]
    faster: float
    pairs: tuple[Pair, ...]
    said: str


def attempt(number: int, seed: int, backend: str, plan: float, threads: int = 0) -> dict[str, Any]:
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
        motion = None
        if first["right"]:
            motion = planned(name, _case(system, effects, recording), plan, [*own, 2]) if plan else proposal(first)
        if motion is None:
            return result
        log = recording.log
        if plan:  # one recording of one motion, begun at rest
            log = Log(*(part[:1] for part in _parts(log)))
        more = repeat(system, recording.declared, effects, log, motion.vary, motion.faster)
        both = replace(recording, log=Log(*(a + b for a, b in zip(_parts(recording.log), _parts(more), strict=True))))
        second = _answer(system, effects, both, backend, threads)
        broken = second["right"] and not any(tied(second, pair) for pair in motion.pairs)
        result |= {"second": second["named"], "right": second["right"], "broken": broken, "said": motion.said}
    except Exception:  # a case that fails must not stop the others
        result["failure"] = traceback.format_exc()
    return result


def _same(commands: np.ndarray) -> np.ndarray:
    return commands


def _parts(log: Log) -> tuple[tuple[np.ndarray, ...], ...]:
    return log.states, log.commands, log.unlogged


def _case(system: System, effects: Sequence[Effect], recording: Recording) -> Case:
    return make_case(system, effects, recording, noise=NOISE, ties=[()] * len(effects))


def _answer(
    system: System, effects: Sequence[Effect], recording: Recording, backend: str, threads: int
) -> dict[str, Any]:
    case = _case(system, effects, recording)
    document = run_case(case, backend, threads)
    return document | {"right": judge(case, document)["right"], "named": judge(case, document)["named"]}


def proposal(answer: Mapping[str, Any]) -> Motion | None:
    """The motion that an answer proposes, and the pair that it is to tell apart; ``None`` without one."""
    words = re.match(r"To tell (.*) from (.*), record (.*): over", answer["next_experiment"] or "")
    if words is None:
        return None
    name, pair = words.group(3), frozenset(words.group(1, 2))
    return Motion(COMMANDS.get(name, _same), STARTS.get(name, 1.0), (pair,), answer["next_experiment"])


def planned(name: str, case: Case, seconds: float, seed: Sequence[int]) -> Motion | None:
    """The motion that `dropo plan --gap` finds for a case's answer; ``None`` where nothing ties, or nothing drives."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "gap"
        problem = make_problem(load_config(case.write(place)), general=True)
        if not problem.simulator.model.nu:
            return None
        gap = find_gap(problem)
        if not any(e.indistinguishable_from for e in gap.effects):
            return None
        folder.mkdir()
        add(problem, gap, folder)
        write_json(folder / "gap.json", gap.document() | {"config": problem.config.portable()})
        config = problem.config.model_copy(update={"plan": limits(name, seed), "seed": int(seed[1])})
        plan = make_plan(prepare(config, seconds, gap=folder))
    ties = plan.ground.ties.ties if plan.ground.ties else ()
    told = ", ".join(f"{t.one} from {t.other} at {s:.3g} σ" for t, s in zip(ties, plan.apart, strict=True))
    return Motion(lambda _: plan.commands[None], 0.0, tuple(frozenset((t.one, t.other)) for t in ties), told)


def limits(name: str, seed: Sequence[int]) -> dict[str, Any]:
    """Limits of a robot that moves as a system does when it is not gentle: positions, velocities and forces."""
    system, model = SYSTEMS[name], load(SYSTEMS[name].xml)
    log = make_recording(system, [], seed, episodes=EPISODES, transitions=ROWS).log
    states, commands = (np.abs(np.concatenate(part)).max(0) for part in (log.states, log.commands))
    driven = [model.joint(int(j)) for j in model.actuator_trnid[:, 0]]
    return {
        "position": {j.name: [-float(states[j.qposadr[0]]), float(states[j.qposadr[0]])] for j in driven},
        "velocity": {j.name: float(states[model.nq + j.dofadr[0]]) for j in driven},
        "force": {
            model.actuator(a).name: float(commands[a]) for a in range(model.nu) if not model.actuator_biastype[a]
        },
    }  # fmt: skip


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
    parser.add_argument("--plan", type=float, default=0.0, metavar="SECONDS", help="motions of dropo plan, so long")
    given = parser.parse_args(arguments)
    seed = int(time.time()) % 1_000_000 if given.seed is None else given.seed
    print(f"seed {seed}: {given.cases} cases", flush=True)
    work = functools.partial(attempt, seed=seed, backend=given.backend, plan=given.plan)
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
