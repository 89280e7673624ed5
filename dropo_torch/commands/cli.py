"""The command line: ``dropo fit``, ``gap``, ``train``, ``sweep-epsilon``, ``compare``, ``reproduce`` and others."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from dropo_torch.commands.claim import claimed
from dropo_torch.errors import InputError, choices

COMMANDS = ("fit", "gap", "train", "sweep-epsilon", "certify", "compare", "reproduce", "demo")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        usage = self.format_usage().removeprefix("usage: ").replace("[-h] ", "")
        raise InputError(f"{message}; usage: {usage}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0 on success, 2 on bad input, 130 when interrupted."""
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
        return 0
    except OSError as error:
        if error.strerror is None:
            raise
        return _fail(f"{error.filename or 'output'}: {error.strerror}", 2)


def _fail(message: str, code: int) -> int:
    """Say in one line why the command ends, and return its exit code."""
    print(f"dropo: {' '.join(message.split())}", file=sys.stderr)
    return code


def _silence() -> None:
    """Send what is still printed nowhere: a fit whose reader has gone is finished all the same."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def _dispatch(given: list[str]) -> int:
    if given and not given[0].startswith("-") and given[0] not in COMMANDS:
        raise InputError(f"unknown command {given[0]!r}" + choices(given[0], COMMANDS))
    if given and given[0].startswith("-") and given[0] not in ("-h", "--help", "--version"):
        raise InputError(f"{given[0]} stands before a command; expected {'|'.join(COMMANDS)} first")
    parsed, rest = _parser().parse_known_args(given)
    if parsed.command is None:
        _parser().print_help()
        return 0
    with claimed(parsed.out):
        _run(parsed, rest)
    return 0


def _run(parsed: argparse.Namespace, rest: Sequence[str]) -> None:
    """Run the command that was given; ``rest`` are overrides of its config."""
    from rich.console import Console

    from dropo_torch.commands import runs
    from dropo_torch.config import load_config, parse_overrides
    from dropo_torch.studies.compare import METHODS
    from dropo_torch.support.parallel import processors

    class Output(Console):
        def on_broken_pipe(self) -> None:
            _silence()

    console = Output()
    overrides = parse_overrides(rest)
    if parsed.command == "demo":
        runs.run_demo(parsed.out, console=console, overrides=overrides, resume=parsed.resume)
        return
    if parsed.command == "reproduce":
        if rest:
            takes = "--out, --resume, --reduced and --workers"
            raise InputError(f"reproduce: {rest[0]} is not understood; it takes {takes}")
        workers = processors() if parsed.workers is None else _count("--workers", parsed.workers)
        runs.run_reproduce(
            parsed.study, parsed.out, console=console, reduced=parsed.reduced, resume=parsed.resume, workers=workers
        )
        return
    config = load_config(parsed.config, overrides)
    if parsed.command == "fit":
        runs.run_fit(config, parsed.out, console=console, resume=parsed.resume, log=parsed.log)
    elif parsed.command == "gap":
        runs.run_gap(config, parsed.out, console=console, source=parsed.config, resume=parsed.resume)
    elif parsed.command == "train":
        from dropo_torch.commands.training import run_train  # TorchRL takes seconds to import

        run_train(config, parsed.out, console=console, resume=parsed.resume, log=parsed.log)
    elif parsed.command == "certify":
        runs.run_certify(config, parsed.out, console=console)
    elif parsed.command == "compare":
        methods = METHODS if parsed.methods is None else [m.strip() for m in parsed.methods.split(",")]
        seeds = _count("--seeds", parsed.seeds)
        runs.run_compare(config, parsed.out, console=console, methods=methods, seeds=seeds, resume=parsed.resume)
    else:
        epsilons = None if parsed.epsilons is None else _numbers(parsed.epsilons)
        runs.run_sweep(
            config, parsed.out, console=console, epsilons=epsilons, noisy_starts=parsed.noisy_starts,
            resume=parsed.resume,
        )  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="dropo",
        description="Fit a distribution over a simulator's parameters to a log of the real robot.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    fit = _command(commands, "fit", "fit the distribution to the log")
    fit.add_argument("--log", metavar="tensorboard", help="write the history as TensorBoard events, too")
    _command(commands, "gap", "find where simulation and log disagree, and name the physical effect that is missing")
    train = _command(commands, "train", "train a policy over the distribution")
    train.add_argument("--log", metavar="tensorboard", help="write the learning curves as TensorBoard events, too")
    sweep = _command(commands, "sweep-epsilon", "fit at several ε and choose one by the elbow")
    sweep.add_argument("--epsilons", metavar="1e-6,1e-5,...", help="the values to try")
    sweep.add_argument(
        "--noisy-starts", action="store_true",
        help="take ε for the variance of every measurement, of the starts of transitions, too",
    )  # fmt: skip
    _command(commands, "certify", "compare the gradients of the warp backend with MuJoCo's own differences")
    comparison = _command(commands, "compare", "fit by several optimizers and backends, side by side")
    comparison.add_argument("--methods", metavar="fisher-warp,...", help="optimizer-backend pairs, all by default")
    comparison.add_argument("--seeds", metavar="N", default="3", help="seeds of each (default 3)")
    study = commands.add_parser("reproduce", help="redo a published study: hopper", allow_abbrev=False)
    study.add_argument("study", metavar="STUDY", help="hopper, the simulated experiments of the DROPO paper")
    study.add_argument("--out", type=_folder, required=True, metavar="DIR", help="folder of the results")
    study.add_argument("--resume", action="store_true", help="go on with an interrupted run in DIR")
    study.add_argument("--reduced", action="store_true", help="short logs and few seeds: minutes instead of hours")
    study.add_argument("--workers", metavar="N", help="fits side by side (default: one a processor)")
    demo = commands.add_parser("demo", help="fit the bundled Hopper's masses", allow_abbrev=False)
    demo.add_argument("--out", type=_folder, default=Path("out/demo"), metavar="DIR", help="folder of the results")
    demo.add_argument("--resume", action="store_true", help="go on with an interrupted run in DIR")
    return parser


def _command(commands: argparse._SubParsersAction, name: str, summary: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=summary.capitalize() + ".",
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_keys_help(),
    )
    parser.add_argument("config", type=Path, metavar="CONFIG", help="YAML file")
    parser.add_argument("--out", type=_folder, required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted run in DIR")
    return parser


def _keys_help() -> str:
    """Every key of the config is an option."""
    from dropo_torch.config import Config

    lines = ["every key of the config is an option too (--epsilon 1e-4, --parameters.mass.bounds '[1, 2]'):"]
    for name, entry in Config.model_fields.items():
        if name != "base":
            default = "" if entry.default in (None, []) else f" (default {entry.default})"
            lines.append(f"  --{name:<22} {entry.description}{default}")
    return "\n".join(lines)


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("no folder given")
    return Path(text)


def _count(option: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise InputError(f"{option}: {text!r} given; expected a whole number, 1 or more")
    return int(text)


def _numbers(text: str) -> list[float]:
    try:
        return [float(x) for x in text.strip("[]").split(",")]
    except ValueError:
        raise InputError(f"--epsilons: {text!r} given; expected numbers such as 1e-6,1e-5,1e-4") from None


def _version() -> str:
    from importlib.metadata import version

    return f"dropo_torch {version('dropo_torch')}"


if __name__ == "__main__":
    sys.exit(main())
