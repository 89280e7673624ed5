"""The options that commands share, and how wrong ones are told."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NoReturn

from dropo_torch.errors import InputError


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise an :class:`InputError` that ends with the usage."""
        usage = self.format_usage().removeprefix("usage: ").replace("[-h] ", "")
        raise InputError(f"{message}; usage: {usage}")


def add_config(parser: argparse.ArgumentParser, *, out_required: bool = True) -> None:
    """Add the config, the folder of the results, and to the help every key of the config, as each is an option."""
    from dropo_torch.config import Config

    parser.add_argument("config", type=Path, metavar="CONFIG", help="YAML file")
    if out_required:
        add_folder(parser)
    else:
        parser.add_argument("--out", type=_folder, metavar="DIR", help="folder of the results")
    lines = ["every key of the config is an option too (--epsilon 1e-4, --parameters.mass.bounds '[1, 2]'):"]
    for name, entry in Config.model_fields.items():
        if name != "base":
            default = "" if entry.default in (None, [], {}) else f" (default {entry.default})"
            lines.append(f"  --{name:<22} {entry.description}{default}")
    parser.epilog = "\n".join(lines)


def add_folder(parser: argparse.ArgumentParser, default: Path | None = None) -> None:
    """Add the folder of the results, which must be given where there is no default, and ``--resume``."""
    parser.add_argument(
        "--out", type=_folder, required=default is None, default=default, metavar="DIR", help="folder of the results"
    )
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted run in DIR")


def add_log(parser: argparse.ArgumentParser, curves: str) -> None:
    """Add ``--log tensorboard``, which writes curves as events, too."""
    parser.add_argument("--log", type=_log, metavar="tensorboard", help=f"write {curves} as TensorBoard events, too")


def count(text: str) -> int:
    """Return a whole number, 1 or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} given; expected a whole number, 1 or more")
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
