"""Starting Warp: once in a process, without its remarks about GPUs on a machine that has none."""

from __future__ import annotations

import os
import sys
import tempfile
import threading

import warp as wp

#: Held while Warp starts, a device is looked up or tables are made.
LOADING = threading.Lock()
_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Initialize Warp.

    Its C code writes straight to the process's standard error; what it says there is passed on, but for the line
    that a CPU-only machine always gets.
    """
    with LOADING:
        sys.stderr.flush()
        kept = os.dup(2)
        with tempfile.TemporaryFile() as said:
            os.dup2(said.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(kept, 2)
                os.close(kept)
                said.seek(0)
                lines = [line for line in said.read().splitlines(keepends=True) if _NO_DRIVER not in line]
                os.write(2, b"".join(lines))
