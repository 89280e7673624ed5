"""Loading the user's own functions and classes, with errors that say where their code fails."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dropo_torch.errors import InputError, choices


@contextmanager
def user_code(key: str, name: str) -> Iterator[None]:
    """Turn what the user's own code raises into an :class:`InputError` that says where.

    Args:
        key: the config's key that names the code.
        name: what it names.
    """
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        ours = str(Path(__file__).parents[1])
        frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith((ours, "<"))]
        place = f", {frames[-1].filename} line {frames[-1].lineno}" if frames else ""
        raise InputError(f"{key}: {name} fails{place}: {type(error).__name__}: {error}") from error


def load_callable(key: str, name: str, *, path: Callable[[str], Path], what: str, example: str) -> Callable[..., Any]:
    """Load ``file.py:function`` or ``module:function``.

    Args:
        key: the config's key that names it.
        name: what it names.
        path: resolves a path that stands in the config.
        what: what is looked for, with ``{}`` for its name, such as "function {} that makes an adapter".
        example: what would be right instead of a name without a colon.

    Raises:
        InputError: a missing file or function, or one whose module fails.
    """
    where, _, function = name.rpartition(":")
    if not where:
        raise InputError(f"{key}: {name!r} given; expected {example}")
    with user_code(key, name):
        if where.endswith(".py"):
            file = path(where).resolve()
            if not file.is_file():
                raise InputError(f"{key}: no file {file}; expected {example}")
            if str(file.parent) not in sys.path:
                sys.path.append(str(file.parent))  # as for a script: it may import what lies beside it
            spec = importlib.util.spec_from_file_location(f"dropo_{key}_{file.stem}", file)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[spec.name] = module
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(where)
    if not callable(getattr(module, function, None)):
        names = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise InputError(f"{key}: {where} has no {what.format(repr(function))}" + choices(function, names))
    return getattr(module, function)
