"""Drawing by OpenGL without a display: programs of their own, since a broken driver ends the process that asks it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

#: Seconds without a picture after which drawing is given up.
PATIENCE = 120.0
REMEDY = (
    "OpenGL cannot draw without a display here; install EGL (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri) or "
    "OSMesa (apt install libosmesa6) and set MUJOCO_GL=egl or MUJOCO_GL=osmesa."
)


def draw_offscreen(program: Path, arguments: Sequence[str], on_line: Callable[[str], None] = lambda line: None) -> bool:
    """Run a Python program that draws, by each way in turn that OpenGL may have here; return whether one did.

    ``MUJOCO_GL`` decides what draws; where it is not set, a display, EGL and OSMesa are tried. A program that prints
    nothing for :data:`PATIENCE` seconds is ended.

    Args:
        program: the program's file.
        arguments: what it is called with.
        on_line: called with every line that it prints, such as how far it is.
    """
    command = [sys.executable, "-P", str(program), *arguments]
    return any(_drew(command, backend, on_line) for backend in _backends())


def _drew(command: Sequence[str], backend: str, on_line: Callable[[str], None]) -> bool:
    environment = {**os.environ, **({"MUJOCO_GL": backend} if backend else {})}
    silent = {"stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
    try:
        child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, **silent)  # type: ignore[call-overload]
    except OSError:
        return False
    with child, contextlib.ExitStack() as stack:
        stack.callback(child.kill)
        while True:
            timer = threading.Timer(PATIENCE, child.kill)
            timer.start()
            line = child.stdout.readline()
            timer.cancel()
            if not line:
                return bool(child.wait() == 0)
            on_line(line.rstrip("\n"))


def _backends() -> list[str]:
    """Values of ``MUJOCO_GL`` to try; empty for the one that is set, or the system's own."""
    if os.environ.get("MUJOCO_GL") or not sys.platform.startswith("linux"):
        return [""]
    return [*([""] if os.environ.get("DISPLAY") else []), "egl", "osmesa"]
