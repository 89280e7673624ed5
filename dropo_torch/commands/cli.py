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
from collections.abc import Sequence

from dropo_torch.commands.options import Parser
from dropo_torch.errors import InputError, choices, one_line

#: Commands, each with its module and what it does.
COMMANDS = {
    "check": ("check", "examine the log before anything is fitted to it"),
    "fit": ("fit", "fit the distribution to the log"),
    "gap": ("gap", "find where simulation and log disagree, and name the physical effect that is missing"),
    "train": ("train", "train a policy over the distribution"),
    "sweep-epsilon": ("sweep", "fit at several ε and choose one by the elbow"),
    "certify": ("certify", "compare the gradients of the warp backend with MuJoCo's own differences"),
    "compare": ("compare", "fit by several optimizers and backends, side by side"),
    "reproduce": ("reproduce", "redo a published study: hopper, push or puck"),
    "demo": ("demo", "fit the bundled Hopper's masses"),
}  # fmt: skip


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
        return _fail("interrupted; the same command with --resume goes on where it stopped", 130)
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
    if command not in (*COMMANDS, "", "-h", "--help", "--version"):
        if command.startswith("-"):
            raise InputError(f"unknown option {command}; a command comes first: {', '.join(COMMANDS)}")
        raise InputError(f"unknown command {command!r}" + choices(command, COMMANDS))
    parser = _parser(command)
    parsed, rest = parser.parse_known_args(given)
    if parsed.version:
        print(f"dropo_torch {importlib.metadata.version('dropo_torch')}")
    elif parsed.command is None:
        parser.print_help()
    else:
        from rich.console import Console

        from dropo_torch.commands.folder import claimed
        from dropo_torch.config import parse_overrides

        console = Console(highlight=False, markup=False, emoji=False)  # names are the user's, and no markup
        console.on_broken_pipe = _silence  # type: ignore[method-assign]
        with claimed(parsed.out) if parsed.out is not None else contextlib.nullcontext():
            return parsed.run(parsed, parse_overrides(rest), console) or 0
    return 0


def _parser(called: str) -> argparse.ArgumentParser:
    """The parser of the command that is called; of the others it knows the names."""
    purpose = "Fit a distribution over a simulator's parameters to a log of the real robot."
    parser = Parser(prog="dropo", description=purpose, allow_abbrev=False)
    parser.add_argument("--version", action="store_true", help="show the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    for name, (module, summary) in COMMANDS.items():
        command = commands.add_parser(
            name, help=summary, description=summary[0].upper() + summary[1:] + ".", allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        if name == called:
            verb = importlib.import_module(f"dropo_torch.commands.{module}")
            verb.add_arguments(command)
            command.set_defaults(run=verb.run)
    return parser


if __name__ == "__main__":
    sys.exit(main())
