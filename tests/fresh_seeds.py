"""Checks of scenarios without common ground, on seeds that no earlier check used.

    python -m tests.fresh_seeds            # two scenarios, chosen by today's date
    python -m tests.fresh_seeds --day 2026-11-27 --count 7

Every day has its own scenarios and seeds, so that the verdicts are watched where nothing was tuned.
The exit code is that of `mapfusion check`: 1 if any method merges maps without common ground.
"""

import argparse
import subprocess
import sys
from datetime import UTC, date, datetime
from pathlib import Path

SCENARIOS = Path("scenarios")
_FIRST_SEED = 10_000  # above the seeds that documented figures use


def chosen(day: date, count: int) -> list[tuple[Path, int]]:
    """Return `count` scenarios without common ground and their seeds for a day."""
    known = sorted(SCENARIOS.glob("*apart.yaml"))
    first = day.toordinal() * count
    return [(known[k % len(known)], _FIRST_SEED + k) for k in range(first, first + count)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--day", type=date.fromisoformat, default=datetime.now(UTC).date())
    parser.add_argument("--count", type=int, default=2, help="number of runs")
    asked = parser.parse_args()
    failed = 0
    for scenario, seed in chosen(asked.day, asked.count):
        command = [sys.executable, "-m", "experiments", "check", str(scenario)]
        # the bound on the path holds for the documented seeds
        options = ["--seeds", str(seed), "--set", "expect.path_over_odometry.max=100"]
        failed |= subprocess.run([*command, *options], check=False).returncode
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
