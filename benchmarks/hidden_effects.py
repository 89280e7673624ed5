"""Score `dropo gap` on logs in which effects are hidden: what it names, how strong it says it is, what it leaves.

python benchmarks/hidden_effects.py --out out/hidden --jobs 2        # all cases of a fresh seed
python benchmarks/hidden_effects.py --seed 7 --cases '*friction*'    # some of them
python benchmarks/hidden_effects.py --out out/hidden --resume        # go on where it stopped
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.hidden.cases import CaseSpec, cases, select
from benchmarks.hidden.systems import SYSTEMS
from benchmarks.hidden.truths import Case, Effect, observed
from dropo_torch.commands.options import workers
from dropo_torch.errors import InputError
from dropo_torch.support.parallel import in_parallel

KINDS = ("null", "single", "double", "outside")
#: The parameters that say how strong an effect is, with their neutral value; all of an effect's where not listed.
STRENGTH = {
    "joint_stiffness": ("stiffness",), "joint_cogging": ("amplitude",), "payload": ("mass",),
    "joint_stribeck": ("coulomb", "static"), "contact_stiffness": ("time_constant",),
    "joint_elasticity": ("compliance",),
}  # fmt: skip
NEUTRAL = {"gain": 1.0, "factor": 1.0}
#: Parameters that need not be told: structure, or angles that are equal modulo a turn.
UNSCORED = {"poles", "phase", "reference", "velocity", "damping_ratio"}
#: What the told noise of a column may be off, relative to the true one.
NOISE_WITHIN = 0.15


def run_case(case: Case, backend: str, threads: int = 0) -> dict[str, Any]:
    """Return the answer of the workflow to a case, the document of its gap.json; what Warp refuses runs on MuJoCo."""
    from dropo_torch.config import load_config
    from dropo_torch.errors import UnsupportedModel
    from dropo_torch.gap import find_gap
    from dropo_torch.problem import make_problem

    with tempfile.TemporaryDirectory() as folder:
        path = case.write(folder)
        try:
            problem = make_problem(load_config(path, {"backend": backend, "threads": threads}), general=True)
        except UnsupportedModel:
            problem = make_problem(load_config(path, {"backend": "mujoco", "threads": threads}), general=True)
        return find_gap(problem).document()


# --- judging one answer ---------------------------------------------------------------------------------------

Pair = tuple[str, str | None]


def judge(case: Case, document: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is right and wrong in an answer."""
    entries = [e for e in document.get("effects") or [] if e["effect"] != "unnamed"]
    unnamed = any(e["effect"] == "unnamed" for e in document.get("effects") or [])
    matches = _matches(case, entries, document.get("verdict") == "explained")
    scored = [_strength(case, h, entries[m]) for h, m in matches.items()]
    scored = [s for s in scored if s is not None]
    complete = len(matches) == len(case.effects) and len(entries) == len(case.effects)
    noise = noise_ratios(case, document)
    return {
        "named": [[e["effect"], e.get("target")] for e in entries],
        "unnamed": unnamed,
        "right": complete and not unnamed if case.kind != "outside" else unnamed and not entries,
        "found": len(matches),
        "errors": [s["error"] for s in scored],
        "covered": [c for s in scored for c in s["covered"]],
        "deviations": {k: v for s in scored for k, v in s["deviations"].items()},
        "noise": noise,
        "noise_right": all(abs(r - 1) <= NOISE_WITHIN for r in noise.values()) if noise else None,
        "ties_missing": [
            sorted({*case.ties[h], (case.effects[h].name, case.effects[h].target)} - _names(entries[m]), key=str)
            for h, m in matches.items()
            if case.ties[h]
        ],
        "chi2": (document.get("chi2_per_degree") or {}).get("after"),
        "left": _left(document.get("gap") or {}),
        "reduction": reductions(document.get("gap") or {}),
    }


def noise_ratios(case: Case, document: Mapping[str, Any]) -> dict[str, float]:
    """Told noise by true noise, feature by feature; a rotation's is twice that of its quaternion's numbers."""
    labels = observed(SYSTEMS[case.system]).labels
    true = dict(zip(labels, case.noise, strict=True))
    found = {}
    for label, told in (document.get("noise") or {}).items():
        stem, _, part = label.partition(".rotation[")
        level = 2 * true[f"{stem}[q{part}"] if part else true[label]
        found[label] = float(told) / level
    return found


def _left(gap: Mapping[str, Any]) -> float | None:
    """The held-out one-step mean square after, by that of noise alone."""
    try:
        return float(gap["after"]["mse"]) / float(gap["noise_floor"]["mse"])
    except (KeyError, TypeError, ZeroDivisionError):
        return None


def _names(entry: Mapping[str, Any], ties: bool = True) -> set[Pair]:
    """An answer's (effect, target) and, if ties count, what it says cannot be told from it."""
    others = (ties and entry.get("indistinguishable_from")) or []
    return {(e["effect"], e.get("target")) for e in (entry, *others)}


def _matches(case: Case, entries: Sequence[Mapping[str, Any]], explained: bool) -> dict[int, int]:
    """Which entry names each hidden effect: an effect's own name first, then its equivalents.

    What an answer says to be as good as its names counts only where these leave nothing that must be said.
    """
    found: dict[int, int] = {}
    for hidden, (effect, equals) in enumerate(zip(case.effects, case.equivalents, strict=True)):
        own = (effect.name, effect.target)
        for accepted in (lambda e, own=own: own == (e["effect"], e.get("target")),
                         lambda e, own=own, equals=equals: bool(_names(e, explained) & {own, *equals})):  # fmt: skip
            free = [n for n, e in enumerate(entries) if n not in found.values() and accepted(e)]
            if free and hidden not in found:
                found[hidden] = free[0]
    return found


def _strength(case: Case, hidden: int, entry: Mapping[str, Any]) -> dict[str, Any] | None:
    """Relative error, coverage of all numbers, and their deviations in half widths of the 90 % intervals.

    Only where an effect is called by its own name: the numbers of another one mean something else.
    """
    effect = case.effects[hidden]
    if entry["effect"] != effect.name or entry.get("target") != effect.target or effect.name == "integration":
        return None
    told = _aligned(entry.get("parameters") or {}, effect)
    hidden_by_plane = {k for k in ("y", "roll") if effect.parameters.get(k) == 0.0}
    known = {k: v for k, v in effect.parameters.items() if k in told and k not in hidden_by_plane}
    keys = [k for k in STRENGTH.get(effect.name, tuple(known)) if k in known and k not in UNSCORED]
    if not keys:
        return None
    off = np.array([told[k]["value"] - known[k] for k in keys])
    size = np.array([known[k] - NEUTRAL.get(k, 0.0) for k in keys])
    halves = {k: max(0.5 * (told[k]["high"] - told[k]["low"]), 1e-300) for k in known}
    return {
        "error": float(np.linalg.norm(off) / np.linalg.norm(size)),
        "covered": [bool(told[k]["low"] <= v <= told[k]["high"]) for k, v in known.items()],
        "deviations": {f"{effect.name}.{k}": (told[k]["value"] - v) / halves[k] for k, v in known.items()},
    }


def _aligned(told: Mapping[str, Any], effect: Effect) -> dict[str, Any]:
    """Told numbers with an amplitude above 0 and a phase within half a turn of the true one: it is the same wave."""
    told = {k: dict(v) for k, v in told.items()}
    flipped = "amplitude" in told and told["amplitude"]["value"] < 0
    if flipped:
        a = told["amplitude"]
        told["amplitude"] = {"value": -a["value"], "low": -a["high"], "high": -a["low"]}
    if "phase" in told and "phase" in effect.parameters:
        shift = math.pi if flipped else 0.0
        turns = round((told["phase"]["value"] + shift - effect.parameters["phase"]) / (2 * math.pi))
        shift -= 2 * math.pi * turns
        told["phase"] = {k: told["phase"][k] + shift for k in ("value", "low", "high")}
    return told


def reductions(gap: Mapping[str, Any]) -> dict[str, float]:
    """The share of the gap above the noise floor that is gone: of the mean square, and of the rollout's rms."""
    found = {}
    for key in ("mse", "rollout_rmse"):
        try:
            before, after, floor = (float(gap[k][key]) for k in ("before", "after", "noise_floor"))
        except (KeyError, TypeError, ValueError):
            continue
        if before > floor:
            found[key] = (before - max(after, floor)) / (before - floor)
    return found


# --- running them ---------------------------------------------------------------------------------------------


def attempt(spec: CaseSpec, backend: str, threads: int = 0) -> dict[str, Any]:
    """Make a case, run it and judge the answer; what fails is recorded with its traceback."""
    result: dict[str, Any] = {
        "name": spec.name, "kind": spec.kind, "trait": spec.trait, "system": spec.system, "seed": spec.seed[0],
    }  # fmt: skip
    try:
        case = spec.make()
        result["hidden"] = [[e.name, e.target, dict(e.parameters)] for e in case.effects]
        result["equivalents"], result["ties"], result["gap_ratio"] = case.equivalents, case.ties, case.gap_ratio
        started, used = time.perf_counter(), time.process_time()
        document = run_case(case, backend, threads)
        result["seconds"], result["cpu_seconds"] = time.perf_counter() - started, time.process_time() - used
        result.update(judge(case, document), document=document)
    except Exception:  # a case that fails must not stop the others
        result["failure"] = traceback.format_exc()
    return json.loads(json.dumps(result, default=_plain))


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


# --- the summary ----------------------------------------------------------------------------------------------


def share(flags: Sequence[bool]) -> str:
    """A share as text, with its counts."""
    return f"{100 * sum(flags) / len(flags):5.1f} %  ({sum(flags)} of {len(flags)})" if flags else "-"


def interval(count: int, total: int, z: float = 1.645) -> tuple[float, float]:
    """The 90 % interval of a share (Wilson's), of ``count`` among ``total``."""
    share, spread = count / total, z * z / total
    middle = (share + 0.5 * spread) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / total + 0.25 * spread / total)
    return middle - half, middle + half


def with_interval(flags: Sequence[bool]) -> str:
    """A share with the 90 % interval of what many more cases would give."""
    if not flags:
        return "-"
    low, high = interval(sum(flags), len(flags))
    return f"{share(flags)}, {100 * low:.0f} to {100 * high:.0f} %"


def confusion(results: Sequence[Mapping[str, Any]]) -> str:
    """What is named where one effect, or nothing, is hidden: a line for each hidden effect."""
    rows: dict[str, Counter[str]] = {}
    for r in results:
        if "failure" in r:
            said = "FAILED"
        else:
            names = [e for e, _ in r["named"]] + ["unnamed"] * r["unnamed"]
            said = "as hidden" if r["right"] else " + ".join(sorted(names)) or "nothing"
        hidden = " + ".join(e for e, _, _ in r.get("hidden", [])) or ("nothing" if r["kind"] == "null" else r["name"])
        rows.setdefault(f"{r['kind']:8s}{hidden}", Counter())[said] += 1
    width = max(map(len, rows), default=0)
    return "\n".join(
        f"{hidden:{width}s}  " + ", ".join(f"{n} × {said}" for said, n in told.most_common())
        for hidden, told in sorted(rows.items())
    )


def scores(results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The scores by name."""
    done = [r for r in results if "failure" not in r]
    of = {k: [r for r in done if r["kind"] == k] for k in KINDS}
    hidden = of["single"] + of["double"]
    errors = [e for r in hidden for e in r["errors"]]
    seconds = [r["seconds"] for r in of["single"]]
    table = {f"named right, {k}": share([r["right"] for r in of[k]]) for k in ("single", "double")}
    table |= {
        "false alarms where nothing is missing": share([bool(r["named"] or r["unnamed"]) for r in of["null"]]),
        "names claimed for outsiders": share([bool(r["named"]) for r in of["outside"]]),
        "outsiders reported as unnamed": share([r["unnamed"] for r in of["outside"]]),
        "strength within 5 %": share([e <= 0.05 for e in errors]),
        "true value in the 90 % interval": with_interval([c for r in hidden for c in r["covered"]]),
        "noise within 15 %, effects named right": share(_known([r["noise_right"] for r in hidden if r["right"]])),
        "noise within 15 %, nothing missing": share(_known([r["noise_right"] for r in of["null"]])),
        "exact ties all told": share([not missing for r in hidden for missing in r["ties_missing"]]),
        "χ²/ν left after the right name": spread_of([r["chi2"] for r in hidden if r["right"]]),
        "held-out mse by noise alone, right name": spread_of([r["left"] for r in hidden if r["right"]]),
    }
    for key, what in (("mse", "mean square"), ("rollout_rmse", "rollout")):
        gone = [r["reduction"][key] >= 0.95 for r in hidden if key in r["reduction"]]
        table[f"held-out gap reduced by 95 %, {what}"] = share(gone)
    table["median seconds of a single-effect case"] = f"{np.median(seconds):.1f}" if seconds else "-"
    table["CPU seconds of a case"] = spread_of([r.get("cpu_seconds") for r in done], "{:.0f}")
    table["failed cases"] = str(len(results) - len(done))
    return table


def told_ties(r: Mapping[str, Any]) -> str:
    """The ties that an answer keeps to itself."""
    return ", ".join(f"{e} {t or ''}".strip() for missing in r["ties_missing"] for e, t in missing)


def _known(flags: Sequence[bool | None]) -> list[bool]:
    return [f for f in flags if f is not None]


def spread_of(values: Sequence[float | None], form: str = "{:.2f}") -> str:
    """Least, median and largest of some numbers."""
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    return " ".join(f"{n} {form.format(v)}" for n, v in zip(("least", "median", "largest"), _ends(known), strict=True))


def _ends(values: Sequence[float]) -> tuple[float, float, float]:
    return min(values), float(np.median(values)), max(values)


#: Heads of the table of traits.
TRAITS = ("trait", "right", "false names", "noise", "intervals", "ties", "χ²/ν largest", "CPU s median, max")


def by_trait(results: Sequence[Mapping[str, Any]]) -> str:
    """A line for each trait: counts of cases named right, of false names, of noises, intervals and ties."""
    rows = [TRAITS]
    for trait in dict.fromkeys(r.get("trait", "") for r in results):
        own = [r for r in results if r.get("trait", "") == trait]
        done = [r for r in own if "failure" not in r]
        right = [r for r in done if r["right"] and r["kind"] != "outside"]
        flags = {
            "right": [r in done and r["right"] for r in own],
            "false": [len(r["named"]) > r["found"] for r in done],
            "noise": _known([r["noise_right"] for r in right]),
            "covered": [c for r in done for c in r["covered"]],
            "ties": [not missing for r in done for missing in r["ties_missing"]],
        }
        chi2 = [r["chi2"] for r in right if r["chi2"] is not None]
        seconds = [r["cpu_seconds"] for r in done if "cpu_seconds" in r]
        rows.append((
            trait or "plain", *(f"{sum(f)} of {len(f)}" for f in flags.values()),
            f"{max(chi2):.2f}" if chi2 else "-", f"{np.median(seconds):.0f}, {max(seconds):.0f}" if seconds else "-",
        ))  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(f"{c:{w}s}" for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def one_line(r: Mapping[str, Any]) -> str:
    """A result as a line of progress."""
    if "failure" in r:
        return f"{r['name']}: FAILED: {r['failure'].strip().splitlines()[-1]}"
    named = ", ".join(f"{e} {t or ''}".strip() for e, t in r["named"]) + (" unnamed" if r["unnamed"] else "")
    hidden = ", ".join(f"{e} {t or ''}".strip() for e, t, _ in r["hidden"])
    error = f", strength {100 * max(r['errors']):.1f} % off" if r["errors"] else ""
    error += f", χ²/ν {r['chi2']:.2f}" if r["chi2"] is not None else ""
    ratios = r["noise"].values()
    error += f", noise × {min(ratios):.2f} to {max(ratios):.2f}" if ratios else ""
    error += f", ties not told: {told_ties(r)}" if any(r["ties_missing"]) else ""
    gap = f", gap {r['gap_ratio']:.0f} × noise" if math.isfinite(r["gap_ratio"]) and r["hidden"] else ""
    verdict = "right" if r["right"] else "WRONG"
    asked, told = f"[{hidden or 'nothing'}{gap}]", named.strip() or "nothing"
    return f"{verdict} {r['name']} {asked} → {told}{error}, {r['seconds']:.0f} s"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, help="of targets, strengths and logs; fresh from the clock where absent")
    parser.add_argument("--cases", default="*", metavar="PATTERN", help="only the cases whose name matches")
    parser.add_argument("--only", choices=KINDS, help="only the cases of one kind")
    parser.add_argument("--small", action="store_true", help="a short list")
    parser.add_argument("--jobs", type=workers, default=1, metavar="N|ray", help="processes")
    parser.add_argument("--backend", choices=("mujoco", "warp"), default="mujoco")
    parser.add_argument("--out", type=Path, help="folder of results.jsonl, written as results come")
    parser.add_argument("--resume", action="store_true", help="skip the cases that are in results.jsonl; its seed")
    parser.add_argument("--list", action="store_true", help="print the cases' names and stop")
    given = parser.parse_args(arguments)
    if given.resume and given.out is None:
        parser.error("--resume needs --out")
    path = None if given.out is None else given.out / "results.jsonl"
    before = read_results(path) if path is not None else []
    if before and not (given.resume or given.list):
        parser.error(f"--out: {path} holds results; add --resume to go on with them, or name another folder")
    seed = given.seed if given.seed is not None else (before[0]["seed"] if before else int(time.time()) % 1_000_000)
    specs = select(cases(seed, "small" if given.small else "all"), given.cases, given.only)
    if given.list:
        print("\n".join(s.name for s in specs))
        return
    kept = [r for r in before if r["seed"] == seed and "failure" not in r]
    results = [r for r in kept if r["name"] in {s.name for s in specs}]
    print(f"seed {seed}: {len(specs)} cases, {len(results)} of them done before", flush=True)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(r) + "\n" for r in kept), encoding="utf-8")
    waiting = [s for s in specs if s.name not in {r["name"] for r in results}]
    work = functools.partial(attempt, backend=given.backend)
    try:
        for number, (_, result) in enumerate(in_parallel(work, waiting, given.jobs), len(results) + 1):
            results.append(result)
            print(f"{number}/{len(specs)} {one_line(result)}", flush=True)
            if path is not None:
                with path.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(result) + "\n")
    except InputError as error:
        missing = [s.name for s in specs if s.name not in {r["name"] for r in results}]
        print(f"{error}; not done: {', '.join(missing)}", flush=True)
    print("\n" + confusion(results) + "\n")
    print(by_trait(results) + "\n")
    for name, value in scores(results).items():
        print(f"{name:45s} {value}")


def read_results(path: Path) -> list[dict[str, Any]]:
    """Return the results of an earlier run; a line that was cut off is left out."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return found


if __name__ == "__main__":
    main()
