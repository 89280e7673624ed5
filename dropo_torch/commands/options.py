"""The options that commands share, and how wrong ones are told."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from dropo_torch.errors import InputError

if TYPE_CHECKING:
    from dropo_torch.config import Config
    from dropo_torch.support.parallel import Workers


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise an :class:`InputError` that ends with the usage."""
        usage = self.format_usage().removeprefix("usage: ").replace("[-h] ", "")
        raise InputError(f"{message}; usage: {usage}")


def add_config(parser: argparse.ArgumentParser, *about: str, out_required: bool = True, resumes: bool = True) -> None:
    """Add the config, the folder of the results, and to the help the keys of the config that matter to the command.

    Args:
        parser: of the command.
        about: which groups of keys these are, besides those of model and log and of the machine.
        out_required: whether there must be a folder.
        resumes: whether an interrupted run in it can be continued.
    """
    from dropo_torch.config import GROUPS, Config

    parser.add_argument("config", type=Path, metavar="CONFIG", help="YAML file")
    if out_required:
        add_folder(parser, resumes=resumes)
    else:
        add_out(parser, "folder of the results")
    lines = ["each key of the config is an option too, such as --epsilon 1e-4 or --parameters.mass.bounds '[1, 2]':"]
    for group in GROUPS:
        if group in ("model and log", "machine", *about):
            lines += ["", f"{group}:", *_keys(Config, group)]
    parser.epilog = "\n".join(lines)


def _keys(config: type[Config], group: str) -> list[str]:
    """A line for each key of a group, with its default."""
    return [
        f"  --{name:<22} {entry.description}"
        + ("" if entry.default in (None, [], {}) else f" (default {entry.default})")
        for name, entry in config.model_fields.items()
        if isinstance(entry.json_schema_extra, dict) and entry.json_schema_extra["about"] == group
    ]


def add_out(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add a folder that need not be given."""
    parser.add_argument("--out", type=_folder, metavar="DIR", help=purpose)


def add_folder(parser: argparse.ArgumentParser, default: Path | None = None, *, resumes: bool = True) -> None:
    """Add the folder of the results, which must be given where there is no default, and ``--resume`` if it resumes."""
    parser.add_argument(
        "--out", type=_folder, required=default is None, default=default, metavar="DIR", help="folder of the results"
    )
    if resumes:
        parser.add_argument("--resume", action="store_true", help="continue an interrupted run in DIR")


def add_log(parser: argparse.ArgumentParser, curves: str) -> None:
    """Add ``--log tensorboard``, which writes curves as events, too."""
    parser.add_argument("--log", type=_log, metavar="tensorboard", help=f"write {curves} as TensorBoard events, too")


def count(text: str) -> int:
    """Return a whole number, 1 or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected a whole number, 1 or more")
    return int(text)


def workers(text: str) -> Workers:
    """Return how many processes work side by side, 1 or more, or ``"ray"``."""
    if text == "ray":
        return "ray"
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected a whole number, 1 or more, or ray")
    return int(text)


def seconds(text: str) -> float:
    """Return a time in seconds, above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected seconds, above 0")
    return value


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("no folder given")
    return Path(text)


def _log(text: str) -> str:
    if text != "tensorboard":
        raise argparse.ArgumentTypeError(f"unknown {text!r}; expected tensorboard")
    return text
