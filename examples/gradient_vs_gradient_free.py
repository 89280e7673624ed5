"""Gradients against none, as the number of parameters grows: 4, 13, 30 and 60.

    python examples/gradient_vs_gradient_free.py --out out/gradients                  # all four
    python examples/gradient_vs_gradient_free.py --out out/gradients --systems chain20

Hopper masses (4), Walker2d masses and dampings (13), chains of 10 and 20 links with mass, damping and armature each
(30, 60). Every log has 200 transitions with known truth; measured next states carry noise of the variance ε that the
likelihood assumes. Each optimizer fits the same objective on the same log; CMA-ES gets at least ten times the simulated
transitions of Adam. ``gradients.png`` shows how far each is from the best, against what it has simulated.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from dropo_sims.hopper import SIM
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import dropo_torch as dropo
from dropo_torch.commands.folder import versions
from dropo_torch.optimizers import AdamSettings
from dropo_torch.report import write_compare_report
from dropo_torch.studies.compare import Comparison, Run, compare

EPSILON = 1e-6
#: Smallest difference of the figure, in nats; curves that reach the best end there.
SMALLEST = 0.1
COLORS = {
    "fisher-mujoco": "#56b4e9",
    "fisher-warp": "#0072b2",
    "adam-warp": "#d55e00",
    "cma-mujoco": "#9aa0a6",
    "cma-warp": "#5f6368",
}
NAMES = {"fisher": "Fisher scoring", "adam": "Adam", "cma": "CMA-ES", "mujoco": "MuJoCo", "warp": "Warp"}
#: Evaluations of CMA-ES of K samples each, by the number of parameters.
BUDGET = {4: 150, 13: 150, 30: 160, 60: 200}


@dataclass(frozen=True)
class System:
    """A model, what varies in it, and the physics steps of a logged transition."""

    model: mujoco.MjModel
    parameters: dict[str, dict[str, Any]]
    frame_skip: int


def hopper() -> System:
    return System(mujoco.MjModel.from_xml_path(str(SIM.model)), dict(SIM.parameters), 4)


def walker() -> System:
    """Gymnasium's Walker2d: seven masses, six dampings."""
    path = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "walker2d_v5.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    joints = [model.joint(j).name for j in range(3, model.njnt)]
    masses = {f"{b}_mass": {"field": "body_mass", "name": b, "bounds": [0.5, 12.0]} for b in bodies}
    dampings = {f"{j}_damping": {"field": "dof_damping", "name": j, "bounds": [0.01, 1.0]} for j in joints}
    return System(model, masses | dampings, 4)


def chain(links: int) -> System:
    """A motorized chain that hangs from a point, in three dimensions: its axes alternate."""
    bodies, motors = "", ""
    for i in range(links):
        axis = "0 1 0" if i % 2 == 0 else "1 0 0"
        bodies += (
            f'<body name="link{i}" pos="0 0 {0 if i == 0 else -0.2}">'
            f'<joint name="joint{i}" axis="{axis}" damping="0.1" armature="0.02"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03" mass="0.5" contype="0"/>'
        )
        motors += f'<motor joint="joint{i}" gear="4"/>'
    xml = (
        '<mujoco><option timestep="0.005" integrator="implicitfast"/>'
        f"<worldbody>{bodies}{'</body>' * links}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    parameters: dict[str, dict[str, Any]] = {}
    inertia = {"scale_inertia": True}
    for i in range(links):
        parameters[f"mass{i}"] = {"field": "body_mass", "name": f"link{i}", "bounds": [0.1, 1.5]} | inertia
        parameters[f"damping{i}"] = {"field": "dof_damping", "name": f"joint{i}", "bounds": [0.01, 0.5]}
        parameters[f"armature{i}"] = {"field": "dof_armature", "name": f"joint{i}", "bounds": [0.005, 0.1]}
    return System(mujoco.MjModel.from_xml_string(xml), parameters, 4)


SYSTEMS = {"hopper": hopper, "walker": walker, "chain10": lambda: chain(10), "chain20": lambda: chain(20)}


def record(system: System, seed: int, steps: int) -> tuple[dropo.Transitions, dropo.Observation, dict[str, float]]:
    """Simulate two episodes under smooth random controls, with masses and so on that the model does not have."""
    generator = np.random.default_rng(seed)
    space = dropo.ParameterSpace(system.model, system.parameters)
    truth = space.nominal * generator.uniform(0.75, 1.3, len(space))
    model = space.apply(truth)
    simulator = dropo.make_simulator("mujoco", system.model, parameters=space, frame_skip=system.frame_skip)
    observation = dropo.parse_observation(system.model, ["qpos", "qvel"])
    noise = generator.standard_normal((2, steps, model.nu))
    controls = np.zeros_like(noise)
    for step in range(1, steps):
        controls[:, step] = np.clip(0.9 * controls[:, step - 1] + 0.35 * noise[:, step], -1, 1)
    starts = np.tile(np.concatenate([model.qpos0, np.zeros(model.nv)]), (2, 1))
    starts += generator.uniform(-0.02, 0.02, starts.shape)
    path = simulator.rollout(torch.from_numpy(starts), torch.from_numpy(controls), torch.from_numpy(truth[None]))[:, 0]
    states = np.concatenate([starts[:, None], path.numpy()], 1)
    measured = states[:, 1:] + np.sqrt(EPSILON) * generator.standard_normal(states[:, 1:].shape)
    rows = np.arange(2 * steps)
    flat = [x.reshape(2 * steps, *x.shape[2:]) for x in (states[:, :-1], controls[:, :, None], measured)]
    return dropo.Transitions(*flat, rows=rows, episodes=rows // steps), observation, space.named(truth)


def compare_on(
    name: str, *, methods: Sequence[str], seeds: int, steps: int, samples: int, adam: AdamSettings, budget: int | None
) -> Comparison:
    system = SYSTEMS[name]()
    transitions, observation, truth = record(system, 0, steps)

    def fit_with(optimizer: str, backend: str, seed: int, *, threads: int) -> tuple[dropo.Fit, dropo.Objective]:
        space = dropo.ParameterSpace(system.model, system.parameters)
        about = {"parameters": space, "frame_skip": system.frame_skip, "num_threads": threads}
        simulator = dropo.make_simulator(backend, system.model, **about)
        objective = dropo.Objective(simulator, transitions, observation, epsilon=EPSILON)
        evaluations = budget or BUDGET[len(space)]
        settings = dropo.FitSettings(optimizer, samples=samples, seed=seed, adam=adam, budget=evaluations)
        fit = dropo.fit(objective, settings)
        return fit, objective

    def show(run: Run) -> None:
        print(
            f"{name}: {run.method}, seed {run.seed}: log-likelihood {run.log_likelihood:.1f}, "
            f"{run.simulated_transitions:,} simulated transitions, {run.seconds:.1f} s ({run.stop_reason})",
            flush=True,
        )

    return compare(fit_with, methods=methods, seeds=range(seeds), reference=truth, on_run=show)


def table(comparison: Comparison, title: str) -> Table:
    found = Table("method", "log-likelihood", "to 1 %", "in all", "seconds", title=title, title_justify="left")
    for method in dict.fromkeys(r.method for r in comparison.runs):
        runs = [r for r in comparison.runs if r.method == method]
        reached = [r.to_percent for r in runs if r.to_percent is not None]
        found.add_row(
            method,
            f"{np.median([r.log_likelihood for r in runs]):.1f}",
            f"{np.median(reached):,.0f}" if len(reached) == len(runs) else "–",
            f"{np.median([r.simulated_transitions for r in runs]):,.0f}",
            f"{np.median([r.seconds for r in runs]):.1f}",
        )
    return found


def draw(comparisons: Mapping[str, Comparison], path: Path) -> None:
    """Draw the log-likelihood that is missing to the best against simulated transitions, a panel a system."""
    figure = Figure(figsize=(2.9 * max(2, len(comparisons)), 3.4), dpi=160, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(comparisons), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (name, comparison) in zip(panels, comparisons.items(), strict=True):
        best = max(run.log_likelihood for run in comparison.runs)
        for run in comparison.runs:
            draw_run(axes, run, best)
        axes.axhline(2, color="#9aa0a6", lw=0.8, ls=":", zorder=0)
        axes.set(xscale="log", yscale="log", xlabel="simulated transitions", ylim=(SMALLEST / 1.6, 1e9))
        axes.minorticks_off()
        axes.set_title(f"{name}: {len(comparison.reference)} parameters", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("log-likelihood below the best (nats)")
    panels[0].text(0.02, 2.3, "2 nats", color="#6b7075", fontsize=8, transform=panels[0].get_yaxis_transform())
    powers = range(0, 9, 2)
    panels[0].set_yticks([SMALLEST, *(10.0**k for k in powers)], [f"≤ {SMALLEST:g}", *(f"$10^{k}$" for k in powers)])
    handles = {line.get_label(): line for axes in panels for line in axes.get_lines() if line.get_label()[0] != "_"}
    figure.legend(
        handles.values(), handles.keys(), frameon=False, ncols=4 if len(panels) > 2 else 2, loc="outside upper center"
    )
    figure.savefig(path)


def draw_run(axes: Axes, run: Run, best: float) -> None:
    """Draw one run's way, and where it ended."""
    points = [(p.simulated_transitions, p.log_likelihood) for p in run.curve]
    cost, found = np.array([*points, (run.simulated_transitions, run.log_likelihood)]).T
    short = np.maximum(best - found, SMALLEST)
    optimizer, backend = run.method.split("-")
    label = f"{NAMES[optimizer]} ({NAMES[backend]})"
    color, style = COLORS[run.method], "--" if run.method == "fisher-mujoco" else "-"
    axes.plot(cost, short, style, color=color, lw=1.4, label=label, zorder=3 if style == "--" else 2)
    axes.plot(cost[-1], short[-1], "o", color=color, ms=5, clip_on=False)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--systems", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--methods", nargs="+", default=["fisher-mujoco", "fisher-warp", "adam-warp", "cma-warp"])
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each method")
    parser.add_argument("--steps", type=int, default=100, help="transitions of each of the two episodes")
    parser.add_argument("--samples", type=int, default=50, help="K")
    parser.add_argument("--adam-steps", type=int, default=200, help="of each of its two stages")
    parser.add_argument("--budget", type=int, help="evaluations of CMA-ES")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    comparisons = {}
    for name in given.systems:
        comparisons[name] = comparison = compare_on(
            name,
            methods=given.methods,
            seeds=given.seeds,
            steps=given.steps,
            samples=given.samples,
            adam=AdamSettings(steps=given.adam_steps),
            budget=given.budget,
        )
        (given.out / f"{name}.json").write_text(json.dumps(comparison.document(), indent=2) + "\n")
        title = f"{name}, {len(comparison.reference)} parameters"
        write_compare_report(given.out / f"{name}.html", comparison, config=None, versions=versions(), title=title)
        Console().print(table(comparison, title))
    draw(comparisons, given.out / "gradients.png")


if __name__ == "__main__":
    main()
