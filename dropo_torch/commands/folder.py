"""The folder of a run: one run at a time in it, an earlier run's results moved aside, nothing of the user's touched."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dropo_torch.config import Config
from dropo_torch.errors import InputError

#: Files by which a folder is known to hold a run, as patterns.
_MARKS = (
    "fit.json", "sweep.json", "compare.json", "certificate.json", "gap.json", "train.json", "checkpoint.bin",
    "check.json", "gap-progress*.bin", "sweep-progress.json", "compare-progress.json", "train-progress.bin",
    "plan.json", "plan-progress.bin",
)  # fmt: skip
#: What runs write, as patterns; an earlier run's are moved aside together.
_RESULTS = (
    *_MARKS, "policy.pt", "distribution.yaml", "fitted_config.yaml", "config.yaml", "model.xml", "report.html",
    "picture.png", "tensorboard", "commands.csv", "expected.csv", "motion.mp4",
)  # fmt: skip
#: What ``dropo view`` writes beside a run's results, and goes with them.
_VIEWS = ("view.html", "view.mp4")
_PACKAGES = ("dropo_torch", "torch", "mujoco", "warp-lang", "numpy", "scipy", "cma", "gymnasium")


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other processes' runs out of a folder, which is made, until this one ends, however it ends.

    A folder made in vain is taken away again; one that cannot be made, opened or locked (as on NFS, or on Windows) is
    left to whoever writes there.

    Raises:
        InputError: another run is using it.
    """
    import filelock

    with contextlib.ExitStack() as stack:
        stack.enter_context(made_for_use(folder))
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            if not filelock.lock_descriptor(handle, blocking=False):  # a FileLock would leave its file in the folder
                raise InputError(f"--out: another run is using {folder}; wait for it, or name another folder")
        yield


@contextlib.contextmanager
def made_for_use(folder: Path) -> Iterator[None]:
    """Take a folder, and those around it, away again where they are made within and nothing is put into them."""
    absent = [p for p in (folder, *folder.parents) if not os.path.lexists(p)]
    try:
        yield
    finally:
        for path in absent:
            with contextlib.suppress(OSError):
                path.rmdir()


def prepare_folder(out: Path, model_path: Path | None, *, resume: bool) -> None:
    """Make the folder; move an earlier run's files aside unless it is to be continued. Nothing else is touched.

    Raises:
        InputError: a folder that cannot be written, or in which a result would replace one of the user's files.
    """
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"--out: {out} is a file; expected a folder")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise InputError(f"--out: cannot write to folder {out}: {error.strerror}") from None
    for name in _RESULTS:
        for stale in out.glob(f".{name}.*.tmp"):  # a write that kill -9 cut short
            stale.unlink()
    present = _present(out, _RESULTS)
    if not (out / "gap.json").exists() and "config.yaml" in present:
        present.remove("config.yaml")  # one of the user's own
    if model_path is not None and model_path.resolve() in [(out / name).resolve() for name in present]:
        raise InputError(
            f"--out: {out / model_path.name} is the model of this run, which would replace it; name another folder"
        )
    if resume or not present:
        return
    if not _present(out, _MARKS):
        raise InputError(f"--out: {out / present[0]} is no result of an earlier run; name another folder, or move it")
    number = next(i for i in range(1, 10_000) if not (out / f"previous-{i}").exists())
    aside = out / f"previous-{number}"
    aside.mkdir()
    beside = _present(out, _VIEWS)
    for name in (*beside, *reversed(present)):  # the marks last: what is cut short here is still known as a run
        shutil.move(str(out / name), aside / name)


def _present(folder: Path, patterns: Sequence[str]) -> list[str]:
    """Names in a folder that match patterns, in the patterns' order."""
    return [path.name for pattern in patterns for path in sorted(folder.glob(pattern))]


def provenance(config: Config) -> dict[str, Any]:
    """Return what every report says of where it comes from: the config, and the versions of what it depends on."""
    return {"config": config.document(), "versions": versions()}


def versions() -> dict[str, str]:
    """Return the versions of what a result depends on."""
    found = {"python": platform.python_version()} | dict.fromkeys(_PACKAGES, "not installed")
    for package in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
