"""What a person waits for before anything is computed: imports, help, and the first use of a function.

    python benchmarks/import_time.py [--repeats 5]

Each is a fresh interpreter's; the fastest of the repeats counts. Wall time in seconds, and CPU time (user and system)
of all its threads.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

CASES = {
    "python": ["-c", "pass"],
    "import dropo_torch": ["-c", "import dropo_torch"],
    "dropo --help": ["-m", "dropo_torch", "--help"],
    "dropo fit --help": ["-m", "dropo_torch", "fit", "--help"],
    "dropo_torch.load_config": ["-c", "import dropo_torch; dropo_torch.load_config"],
    "dropo_torch.fit": ["-c", "import dropo_torch; dropo_torch.fit"],
    "dropo_torch.make_problem": ["-c", "import dropo_torch; dropo_torch.make_problem"],
    "dropo_torch.gap": ["-c", "import dropo_torch; dropo_torch.gap"],
    "dropo_torch.load_policy": ["-c", "import dropo_torch; dropo_torch.load_policy"],
}


def measure(arguments: Sequence[str]) -> tuple[float, float]:
    """Seconds of wall and of CPU time of a Python process."""
    before, begun = os.times(), time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - begun, os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args(arguments)
    table = Table("", "wall, s", "CPU, s")
    for name, command in CASES.items():
        measure(command)  # reads the files, and compiles what is not
        wall, cpu = (min(column) for column in zip(*(measure(command) for _ in range(given.repeats)), strict=True))
        table.add_row(name, f"{wall:.2f}", f"{cpu:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
