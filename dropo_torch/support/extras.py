"""What serves one purpose and is installed for it: ``pip install 'dropo_torch[NAME]'``."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager

from dropo_torch.errors import InputError

#: Extras of the package, and the modules that each is installed for.
EXTRAS = {
    "baselines": ("sbi",),
    "formats": ("h5py", "pandas", "pyarrow"),
    "gymnasium": ("gymnasium",),
    "minari": ("minari",),
    "ray": ("ray",),
    "ros": ("rosbags",),
    "rl": ("torchrl", "tensordict", "gymnasium"),
    "tensorboard": ("tensorboard",),
    "view": ("imageio", "av"),
    "warp": ("warp",),
}


class MissingExtra(InputError, ImportError):
    """A package is needed that is not installed; the message names the command that installs it."""


@contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Import what an extra installs: ``with extra("warp", "backend: warp"): import warp``.

    Args:
        name: the extra.
        purpose: what needs it, as the user knows it.

    Raises:
        MissingExtra: one of the extra's modules is not installed.
    """
    try:
        yield
    except ImportError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRAS[name]:
            raise
        raise MissingExtra(
            f"{purpose} needs {module}, which is not installed: pip install 'dropo_torch[{name}]'"
        ) from None


def require(name: str, purpose: str) -> None:
    """Raise a :class:`MissingExtra` unless all of an extra's modules can be imported; see :func:`extra`."""
    with extra(name, purpose):
        for module in EXTRAS[name]:
            importlib.import_module(module)
