"""The command line: ``dropo fit``, ``gap``, ``train``, ``sweep-epsilon``, ``compare``, ``reproduce`` and others.

A command is a module of this folder, imported when it is called. It has ``add_arguments(parser)``, among them ``out``,
and ``run(given, overrides, console)``: the arguments, the config's keys that were given as options, where to print. It
may return an exit code.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import io
import os
import sys
from collections.abc import Collection, Sequence
from typing import NamedTuple

from dropo_torch.commands.options import Parser
from dropo_torch.errors import InputError, choices, one_line


class Command(NamedTuple):
    """A command: its module, what it does, and how it is called."""

    module: str
    summary: str
    examples: tuple[str, ...]


#: Commands by what they are for, in the order in which one comes to need them.
GROUPS = {
    "begin": {
        "demo": Command("demo", "fit the bundled Hopper's masses", ("dropo demo",)),
        "init": Command(
            "init", "write a config for a model and a log",
            ("dropo init robot.xml log.csv", "dropo init arm.urdf run.parquet --out arm.yaml --interactive"),
        ),
        "check": Command(
            "check", "examine the log before anything is fitted to it",
            ("dropo check robot.yaml", "dropo check robot.yaml --out out/check"),
        ),
    },
    "answers": {
        "gap": Command(
            "gap", "find where simulation and log disagree, and name the physical effect that is missing",
            ("dropo gap robot.yaml --out out/gap", "dropo gap robot.yaml --out out/gap --time-limit 120"),
        ),
        "fit": Command(
            "fit", "fit the distribution to the log",
            ("dropo fit robot.yaml --out out/robot", "dropo fit out/gap/config.yaml --out out/robot --epsilon 1e-4"),
        ),
        "view": Command(
            "view", "show measured and simulated motion side by side",
            ("dropo view out/robot", "dropo view out/gap --episode 2 --start 4 --seconds 3"),
        ),
        "plan": Command(
            "plan", "propose the motion to record next, by what it is to tell",
            (
                "dropo plan robot.yaml --out out/plan --seconds 20",
                "dropo plan robot.yaml --out out/plan --at out/robot/fit.json --plan.velocity 1.5",
            ),
        ),
        "train": Command(
            "train", "train a policy over the distribution",
            ("dropo train robot.yaml --out out/policy --task arm.py:Reach --distribution out/robot/fit.json",),
        ),
    },
    "studies": {
        "sweep-epsilon": Command(
            "sweep", "fit at several ε and choose one by the elbow",
            ("dropo sweep-epsilon robot.yaml --out out/sweep",),
        ),
        "compare": Command(
            "compare", "fit by several optimizers and backends, side by side",
            ("dropo compare robot.yaml --out out/compare",),
        ),
        "certify": Command(
            "certify", "compare the gradients of the warp backend with MuJoCo's own differences",
            ("dropo certify robot.yaml --out out/certify",),
        ),
        "reproduce": Command(
            "reproduce", "redo a published study: hopper, push or puck",
            ("dropo reproduce hopper --out out/hopper", "dropo reproduce push --reduced --out out/push"),
        ),
    },
}  # fmt: skip
#: Shells whose command line is completed.
SHELLS = ("bash", "zsh", "fish")
#: Commands of several fits, which workers do side by side.
SHARED = ("sweep-epsilon", "compare", "reproduce")
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0 on success, 2 on bad input, 3 after a hopeless fit, 130 when interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters is no reason to stop
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(given)
    except InputError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:  # the reader of help or results has seen enough
        _silence()
    except OSError as error:
        if error.strerror is None:
            raise
        return _fail(f"{error.filename or 'output'}: {error.strerror}", 2)
    return 0


def _fail(message: str, code: int) -> int:
    """Say in one line why the command ends, and return its exit code."""
    print(f"dropo: {one_line(message)}", file=sys.stderr)
    return code


def _silence() -> None:
    """Send what is still printed nowhere: a fit whose reader has gone is finished all the same."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def _dispatch(given: list[str]) -> int:
    """Run the command that was given, and return its exit code; what it does not know are overrides of its config."""
    command = given[0] if given else ""
    if command.partition("=")[0] not in (*COMMANDS, "", "-h", "--help", "--version", "--completion"):
        if command.startswith("-"):
            raise InputError(f"unknown option {command}; a command comes first: {', '.join(COMMANDS)}")
        raise InputError(f"unknown command {command!r}" + choices(command, COMMANDS))
    parser = _parser([command])
    parsed, rest = parser.parse_known_args(given)
    if parsed.version:
        print(f"dropo_torch {importlib.metadata.version('dropo_torch')}")
    elif parsed.completion is not None:
        from dropo_torch.commands.completion import script

        print(script(_parser(COMMANDS, "what to do"), parsed.completion))
    elif parsed.command is None:
        parser.print_help()
    else:
        from rich.console import Console

        from dropo_torch.commands.folder import claimed
        from dropo_torch.config import parse_overrides

        overrides = parse_overrides(rest)
        if "workers" in overrides and command not in SHARED:
            raise InputError(
                f"{command}: --workers is not understood, as its work is not divided; {', '.join(SHARED)} take it, and "
                "--threads is how many processors a simulator uses"
            )
        console = Console(highlight=False, markup=False, emoji=False)  # names are the user's, and no markup
        console.on_broken_pipe = _silence  # type: ignore[method-assign]
        with claimed(parsed.out) if parsed.out is not None else contextlib.nullcontext():
            try:
                return parsed.run(parsed, overrides, console) or 0
            except KeyboardInterrupt:
                advice = "; the same command with --resume continues from there" if hasattr(parsed, "resume") else ""
                return _fail(f"interrupted{advice}", 130)
    return 0


def _parser(called: Collection[str], about: str = argparse.SUPPRESS) -> argparse.ArgumentParser:
    """The parser of the commands that are called; of the others it knows the names. ``about`` is the list's help."""
    parser = Parser(
        prog="dropo", usage="dropo COMMAND ...", description=_OVERVIEW.format("\n\n".join(map(_group, GROUPS))),
        allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--version", action="store_true", help="show the version and exit")
    parser.add_argument(
        "--completion",
        choices=SHELLS,
        help="print what makes a shell complete command lines: docs/install.md",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser, help=about)
    for name, (module, summary, examples) in COMMANDS.items():
        shown = "\n".join(f"  {line}" for line in examples)
        command = commands.add_parser(
            name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.\n\nexamples:\n{shown}",
            allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, prog=f"dropo {name}",
        )  # fmt: skip
        if name in called:
            verb = importlib.import_module(f"dropo_torch.commands.{module}")
            verb.add_arguments(command)
            command.set_defaults(run=verb.run)
    return parser


_OVERVIEW = """\
Where do simulator and robot disagree, what does the model lack, and over which parameters should a policy be trained?

{}

Begin with `dropo demo`, which needs no robot. `dropo COMMAND --help` shows how each is used."""


def _group(name: str) -> str:
    """The commands of a group, a line each."""
    return "\n".join([f"{name}:", *(f"  {command:<15}{GROUPS[name][command].summary}" for command in GROUPS[name])])


if __name__ == "__main__":
    sys.exit(main())
