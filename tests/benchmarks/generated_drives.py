"""Drives of generated scenarios: which seeds give a world that robots do not get through.

    python -m tests.benchmarks.generated_drives --seeds 0..199 --jobs 2
    python -m tests.benchmarks.generated_drives --seeds 0..199 --robots 4 --wheels-alone

Every generated scenario of `scenarios/` is driven with each seed, and nothing else is done with it.
Scenarios that drive the same routes between the same walls are driven once.
With `--wheels-alone` robots go as their wheels turn, without physics, which takes a tenth of the
time. Prints a line for each seed that fails, then a line for each scenario: how many drives there
were, how many had to begin anew because robots waited for each other, how many asked for a world
that cannot be drawn, and how many failed. Exit code 1 if one failed.
"""

import argparse
import itertools
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import cast
from unittest.mock import patch

from experiments.pipeline.stages import drive
from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.pipeline.workers import single_threaded
from experiments.scenario.loading import load_scenario
from experiments.scenario.suite import parse_seeds
from mapfusion.errors import InputError
from sim.routes import resolve_deadlock
from tests.benchmarks.generated_runs import REPOSITORY, generated_scenarios
from tests.helpers.wheels_alone import wheels_alone

REFUSED, DRIVEN = "cannot be drawn", "driven"
PROGRESS_EVERY = 20  # drives, a line


def drive_settings(path: Path, seed: int, overrides: Sequence[str]) -> drive.DriveSettings | None:
    """Return what a scenario and seed drive; None if the world cannot be drawn."""
    try:
        scenario = load_scenario(REPOSITORY / path, overrides, seed)
    except InputError:
        return None
    (stage,) = (each for each in build_pipeline(scenario).stages() if each.name == "drive")
    return cast(drive.DriveSettings, stage.settings)


def outcome(settings: drive.DriveSettings | None, without_physics: bool) -> tuple[str, int]:
    """Return `DRIVEN`, or why not, and how often the drive began anew."""
    if settings is None:
        return REFUSED, 0
    with (
        wheels_alone() if without_physics else nullcontext(),
        patch("sim.driver.resolve_deadlock", side_effect=resolve_deadlock) as asked_for,
    ):
        try:
            drive.drive_robots(settings)
        except InputError as error:
            return str(error), asked_for.call_count
    return DRIVEN, asked_for.call_count


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Drive them all; print what fails, then the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="0..199", help="A number, a range or a list.")
    parser.add_argument("--robots", type=int, help="In place of each scenario's own number.")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--wheels-alone", action="store_true", help="Without physics.")
    asked = parser.parse_args()
    overrides = [] if asked.robots is None else [f"generate.robots={asked.robots}"]
    by_settings: dict[str, tuple[drive.DriveSettings | None, list[tuple[str, int]]]] = {}
    for path, seed in itertools.product(generated_scenarios(), parse_seeds(asked.seeds)):
        settings = drive_settings(path, seed, overrides)
        by_settings.setdefault(repr(settings), (settings, []))[1].append((path.stem, seed))
    drives = list(by_settings.values())
    counts: dict[str, Counter[str]] = {}
    drive_one = partial(outcome, without_physics=asked.wheels_alone)
    with ProcessPoolExecutor(asked.jobs, initializer=single_threaded) as pool:
        outcomes = pool.map(drive_one, [settings for settings, _ in drives])
        for k, ((how, n_anew), (_, runs)) in enumerate(zip(outcomes, drives, strict=True)):
            known = how in (DRIVEN, REFUSED)
            for name, seed in runs:
                if not known:
                    _say(f"{name}, seed {seed}: {how}")
                found = counts.setdefault(name, Counter())
                found.update({how if known else "failed": 1, "began anew": n_anew > 0})
            if (k + 1) % PROGRESS_EVERY == 0:
                _say(f"{k + 1} of {len(drives)} drives")
    for name, found in counts.items():
        told = (DRIVEN, "began anew", REFUSED, "failed")
        _say(f"{name}: {', '.join(f'{found[each]} {each}' for each in told)}")
    sys.exit(1 if any(found["failed"] for found in counts.values()) else 0)


if __name__ == "__main__":
    main()
