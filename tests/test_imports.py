"""What importing the package loads, which way its imports point, and what it says where an extra is missing."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from arm import Folder

import dropo_torch as dropo
from dropo_torch.commands.cli import COMMANDS, main
from dropo_torch.errors import InputError
from dropo_torch.support.extras import EXTRAS, MissingExtra, extra

ROOT = Path(__file__).parents[1]

#: What nobody waits for who asks for help: seconds of import each, or an extra that may not be there.
HEAVY = (
    "torch", "mujoco", "scipy", "matplotlib", "cma", "jinja2", "pysindy",
    *{module for modules in EXTRAS.values() for module in modules},
)  # fmt: skip


def loaded(code: str) -> set[str]:
    """The top-level modules that a fresh interpreter has after running some code."""
    shown = f"{code}\nimport sys; print('LOADED', *{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.rpartition("LOADED")[2].split())


@pytest.mark.parametrize(
    "code",
    [
        "import dropo_torch",
        "import dropo_torch as d; d.Config, d.load_config, d.InputError",
        "from dropo_torch.commands.cli import main; main([]); main(['--unknown']); main(['unknown'])",
        *(
            f"from dropo_torch.commands.cli import main\ntry: main([{name!r}, '--help'])\nexcept SystemExit: pass"
            for name in COMMANDS
        ),
    ],
)
def test_nothing_heavy_is_loaded_before_it_is_needed(code: str) -> None:
    assert not loaded(code) & set(HEAVY)


PUBLIC = {
    "Config", "Diagnostics", "Distribution", "Effect", "Fit", "FitSettings", "InputError", "Objective", "Observation",
    "Parameter", "ParameterSpace", "Placed", "Preprocess", "Problem", "Proposal", "Quantity", "Recording", "Simulator",
    "Trajectories", "Transitions", "baselines", "diagnose", "export_model", "fit", "fit_problem", "gap", "load_config",
    "load_policy", "log_likelihood", "make_config", "make_problem", "make_simulator", "make_transitions",
    "parse_observation", "preprocess", "propose_config", "read_recording", "read_trajectories",
}  # fmt: skip


def test_public_names_are_there() -> None:
    assert set(dropo.__all__) == set(dir(dropo)) == PUBLIC
    for name in PUBLIC - {"baselines", "gap"}:
        assert not isinstance(getattr(dropo, name), ModuleType), name
    assert dropo.gap.find_gap
    assert dropo.baselines.fit_problem


@pytest.mark.parametrize("first", ["import dropo_torch.fit", "import dropo_torch.problem", "d.fit", "d.baselines"])
def test_fit_is_the_function_whatever_is_imported_before(first: str) -> None:
    code = f"import dropo_torch as d; {first}; from dropo_torch import fit; from dropo_torch.fit import Fit"
    subprocess.run(
        [sys.executable, "-c", f"{code}; assert fit is d.fit and callable(fit) and Fit is d.Fit"], check=True
    )


# --- which way imports point ---

#: Modules and folders of the package: each imports what stands before it, its own folder aside. The more exact entry
#: counts: a MuJoCo model is loaded by what parameters need, and written with parameters' values.
LAYERS = (
    "errors", "support", "models.constants", "models.load", "models.bundled", "models",
    "parameters", "models.export", "data",
    "distribution", "likelihood", "simulators",
    "evaluator", "initial_noise", "objective", "excitation",
    "optimizers",
    "diagnostics", "verdict",
    "certify", "fit",
    "config",
    "logged",
    "effects",
    "problem",
    "shooting",
    "baselines", "gap", "rl", "view",
    "proposal", "studies", "planning",
    "report",
    "commands", "__main__",
    "testing",
)  # fmt: skip


@dataclass(frozen=True)
class Arrow:
    """An import: by which module, of which, where it stands, and whether importing the one runs it."""

    source: str
    target: str
    line: int
    runs: bool


def modules() -> dict[str, Path]:
    """The package's modules by name, folders by the name of their ``__init__``."""
    found = {}
    for path in sorted((ROOT / "dropo_torch").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(tree: ast.AST, runs: bool = True) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """The imports in a syntax tree, and whether each runs with the module: not in functions, nor for type checkers."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, runs
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from ((found, False) for found, _ in imports(node))
        else:
            inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from imports(node, runs and not inside)


def arrows(source: str) -> Iterator[Arrow]:
    """All imports of a module, of whatever package."""
    for node, runs in imports(ast.parse(MODULES[source].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        else:
            assert node.level == 0, f"{source}, line {node.lineno}: an import relative to the folder"
            assert node.module is not None
            named = [f"{node.module}.{alias.name}" for alias in node.names]
            targets = [name if name in MODULES else node.module for name in named]
        for target in dict.fromkeys(targets):
            yield Arrow(source, target, node.lineno, runs)


ARROWS = [arrow for source in MODULES for arrow in arrows(source)]
OWN = [arrow for arrow in ARROWS if arrow.target.partition(".")[0] == "dropo_torch"]


def layer(module: str) -> int:
    """Where a module stands in the order."""
    name = module.removeprefix("dropo_torch.")
    while name not in LAYERS:
        name, dot, _ = name.rpartition(".")
        assert dot, f"{module} has no place in the order of layers"
    return LAYERS.index(name)


def test_every_layer_is_there() -> None:
    assert [name for name in LAYERS if f"dropo_torch.{name}" not in MODULES] == []


def test_imports_point_one_way() -> None:
    wrong = [
        f"{a.source}, line {a.line}, imports {a.target}"
        for a in OWN
        if a.source != "dropo_torch" and (a.target == "dropo_torch" or layer(a.target) > layer(a.source))
    ]
    assert wrong == []


def parents(module: str) -> set[str]:
    """The folders that a module lies in."""
    parts = module.split(".")
    return {".".join(parts[:i]) for i in range(1, len(parts))}


def test_no_module_runs_itself_by_its_imports() -> None:
    """Importing a module runs its folders' ``__init__`` first, unless they are being run already."""
    graph: dict[str, set[str]] = {module: set() for module in MODULES}
    for a in OWN:
        if a.runs:
            graph[a.source] |= ({a.target} | parents(a.target)) - parents(a.source) - {a.source}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_the_package_knows_none_of_the_simulations_that_come_with_it() -> None:
    assert [a for a in ARROWS if a.target.startswith(("dropo_sims", "sims"))] == []


def test_the_objective_knows_no_backend() -> None:
    known = {a.target for a in OWN if a.source == "dropo_torch.objective"}
    assert {name for name in known if name.startswith("dropo_torch.simulators")} <= {"dropo_torch.simulators.base"}


# --- extras ---


def test_extras_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    assert set(optional) == set(EXTRAS) | {"all", "dev", "docs", "coverage-models"}
    assert set(optional["all"][0].partition("[")[2].rstrip("]").split(",")) == set(EXTRAS)
    needed = " ".join(project["dependencies"])
    assert not [module for modules in EXTRAS.values() for module in modules if module in needed]


def test_an_import_that_fails_by_itself_is_no_missing_extra() -> None:
    with pytest.raises(ImportError, match="other") as caught, extra("warp", "this"):
        raise ImportError("other", name="numpy")
    assert not isinstance(caught.value, MissingExtra)
    assert issubclass(MissingExtra, InputError)


MISSING = {
    "warp": ("warp", {"backend": "warp"}, "fit", "backend: warp needs warp"),
    "baselines": ("sbi", {"method": "bayessim"}, "fit", "method: bayessim needs sbi"),
    "gymnasium": (
        "gymnasium", {"backend": "gymnasium", "environment": "Hopper-v5", "model": None}, "fit",
        "environment: Hopper-v5 needs gymnasium",
    ),
    "rl": ("torchrl", {}, "train", "a policy needs torchrl"),
    "minari": ("minari", {"data": "minari:arm/log-v0"}, "fit", "a Minari dataset needs minari"),
    "tensorboard": ("tensorboard", {}, "fit --log tensorboard", "--log tensorboard needs tensorboard"),
    "csv": ("pandas", {"data": "log.csv"}, "fit", "log.csv needs pandas"),
    "parquet": ("pyarrow", {"data": "log.parquet"}, "fit", "log.parquet needs pyarrow"),
    "hdf5": ("h5py", {"data": "log.h5"}, "fit", "log.h5 needs h5py"),
    "ros": ("rosbags", {"data": "log.mcap"}, "fit", "log.mcap needs rosbags"),
    "ray": ("ray", {"workers": "ray"}, "sweep-epsilon", "workers: ray needs ray"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISSING)
def test_a_missing_extra_is_told_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    module, changes, command, words = MISSING[name]
    folder = Folder(tmp_path)
    config = folder.config()
    config.write_text(yaml.safe_dump({**yaml.safe_load(config.read_text()), **changes}))
    for kind in ("csv", "parquet", "h5", "mcap"):
        (tmp_path / f"log.{kind}").touch()
    verb, *options = command.split()
    arguments = [verb, str(config), "--out", str(tmp_path / "out"), *options]
    if name in ("warp", "rl", "ros"):  # what needs these may have been imported already
        run = f"from dropo_torch.commands.cli import main; sys.exit(main({arguments}))"
        absent = f"import sys; sys.modules[{module!r}] = None; {run}"
        code = subprocess.run([sys.executable, "-c", absent], check=False, cwd=ROOT).returncode
    else:
        monkeypatch.setitem(sys.modules, module, None)
        code = main(arguments)
    output, error = capfd.readouterr()
    installs = name if name in EXTRAS else "formats"
    assert (code, output) == (2, ""), error
    assert error.startswith("dropo: ")
    assert words in error
    assert error.endswith(f"which is not installed: pip install 'dropo_torch[{installs}]'\n")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_demo_needs_no_extra(tmp_path: Path) -> None:
    absent = sorted({module for modules in EXTRAS.values() for module in modules})
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({absent}))\n"
        "import dropo_torch as d; d.make_problem, d.fit, d.gap, d.baselines, d.export_model, d.read_trajectories\n"
        f"from dropo_torch.commands.cli import main; sys.exit(main(['demo', '--out', {str(tmp_path)!r}]))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
