"""How long the program keeps its user waiting: CPU time of importing it and of its help, wall time of a dry run.

Each is given beside the bare interpreter's start in the same run, since the machine decides both:

    python -m benchmarks.program_speed
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from statistics import median

REPEATS = 9


def spent(*arguments: str) -> tuple[float, float]:
    """Return the median CPU time and wall time of a command, s."""
    cpu, wall = [], []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            begun = time.perf_counter()
            subprocess.run(arguments, cwd=folder, check=True, capture_output=True)  # noqa: S603 - fixed commands
            wall.append(time.perf_counter() - begun)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return median(cpu), median(wall)


def main() -> None:
    bench = [sys.executable, "-c", "from bench.cli.program import main; main()"]
    commands = {
        "python -c pass": [sys.executable, "-c", "pass"],
        "import bench": [sys.executable, "-c", "import bench"],
        "bench --help": [*bench, "--help"],
        "bench run paper --dry-run": [*bench, "run", "paper", "--dry-run"],
    }
    print(f"{'command':30} {'CPU / s':>10} {'wall / s':>10}   (median of {REPEATS})")
    for name, command in commands.items():
        cpu, wall = spent(*command)
        print(f"{name:30} {cpu:10.3f} {wall:10.3f}")


if __name__ == "__main__":
    main()
