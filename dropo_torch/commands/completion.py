"""Completion of the command line by a shell: a script that it reads once, made by shtab from the commands' parsers."""

from __future__ import annotations

import argparse
from importlib.metadata import entry_points
from pathlib import Path
from typing import get_args

from dropo_torch.config import KEYS, Config
from dropo_torch.models.bundled import GROUP


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return what a shell reads to complete commands, their options, keys of the config, files and folders.

    Args:
        parser: of all commands, with their arguments.
        shell: ``"bash"``, ``"zsh"`` or ``"fish"``.
    """
    import shtab

    for command in _commands(parser):
        if any(action.dest in ("config", "run_folder") for action in command._actions):
            _add_keys(command)
        for action in command._actions:
            if action.metavar == "DIR":
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
            elif action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif action.dest == "study":
                action.choices = sorted(entry_points(group=GROUP).names)
    return shtab.complete(parser, shell)


def _commands(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    lists = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return [command for choices in lists for command in choices.values()]


def _add_keys(command: argparse.ArgumentParser) -> None:
    """Add the keys of the config as options, with their values where these are few."""
    for key in KEYS:
        known = Config.model_fields[key]
        kinds = (known.annotation, *get_args(known.annotation))
        words = ["true", "false"] if bool in kinds else [w for k in kinds for w in get_args(k) if isinstance(w, str)]
        command.add_argument(f"--{key}", choices=words or None, metavar=key.upper(), help=known.description)
