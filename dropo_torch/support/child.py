"""Reading by libraries that a damaged file may crash or hang: in a process of its own, with limits."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import subprocess
import sys

from dropo_torch.errors import InputError

#: Seconds and bytes that reading may take.
SECONDS, BYTES = 60, 6 * 2**30


def read_in_child(function: str, *arguments: object, where: object, kind: str) -> bytes:
    """Return the bytes that ``module:function`` returns, called with texts in another process.

    Args:
        function: of a module's top level, ``(*str) -> bytes``.
        arguments: what it is called with, as text.
        where: what is read, for messages.
        kind: what it should be.

    Raises:
        InputError: it raised, crashed, or took more than :data:`SECONDS` or :data:`BYTES`.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import answer; answer()"
    command = [sys.executable, "-c", code, function, *map(str, arguments)]
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # a pool of threads is slow to start
    try:
        found = subprocess.run(command, capture_output=True, timeout=SECONDS, env=alone, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(f"{where}: cannot be read as {kind} (not in {SECONDS} s; it is damaged)") from None
    if found.returncode:
        words = found.stderr.decode(errors="replace").strip().splitlines()
        crash = f"the reader dies: {_signal(-found.returncode)}; it is damaged"
        reason = crash if found.returncode < 0 or not words else words[-1]
        raise InputError(f"{where}: cannot be read as {kind} ({reason[:300]})")
    return found.stdout


def answer() -> None:
    """Write what the called function returns; end with what it raised as the last line of stderr."""
    name, *arguments = sys.argv[1:]
    with contextlib.suppress(ImportError, ValueError):  # Windows has no limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    module, _, function = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), function)(*arguments)
    except Exception as error:
        print("\n" + (" ".join(str(error).split()) or type(error).__name__), file=sys.stderr)
        sys.exit(1)
    sys.stdout.buffer.write(found)
    sys.stdout.buffer.flush()
    os._exit(0)  # what is damaged may also crash as it is taken down


def limit_memory(more: int) -> None:
    """Let this process take so many bytes more than it has; where it may take less already, that stays."""
    with contextlib.suppress(ImportError, OSError, ValueError):  # not on every system
        import resource

        with open("/proc/self/statm", encoding="ascii") as stream:
            taken = int(stream.read().split()[0]) * resource.getpagesize()
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        wanted = taken + more
        resource.setrlimit(resource.RLIMIT_AS, (wanted if soft == resource.RLIM_INFINITY else min(soft, wanted), hard))


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"exit code {-number}"
