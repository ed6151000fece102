"""Two bags in, a report out: what it takes, command by command.

    python -m tests.benchmarks.two_bags --frames 1000 --folder results/two_bags

Two simulated robots' drives are written as bags first, which is not counted. A bag then has
pictures alone: the odometry is theirs. Seconds of the clock say something on a quiet machine; those
of processors on any, with `--jobs 1`: what worker processes use is not counted. Bags that are in
the folder already are taken as they are.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

SCENARIO = """
schema_version: 1
name: two_bags
logs: [logs/R1, logs/R2]
"""
TOPICS = ("--left", "/left/image_rect", "--right", "/right/image_rect")


def timed(name: str, *words: object) -> tuple[float, float]:
    """Seconds by the clock and of processors that `mapfusion` takes with these words."""
    command = [sys.executable, "-m", "experiments", *map(str, words)]
    clock, before = time.perf_counter(), os.times()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after, took = os.times(), time.perf_counter() - clock
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    used = sum(after[2:4]) - sum(before[2:4])
    say(f"{name:8s} {took:7.1f} s by the clock, {used:7.1f} s of processors")
    return took, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--folder", type=Path, required=True, help="What is made goes there.")
    parser.add_argument("--jobs", type=int, default=2, help="Processes; 1 to count processors.")
    asked = parser.parse_args()
    root, jobs = asked.folder, ("--jobs", asked.jobs)
    bags = [root / "bags" / f"{robot}.bag" for robot in ("R1", "R2")]
    if not all(bag.is_file() for bag in bags):
        drawn = ("--set", "render.renderer=raycast", "--set", f"drive.frames={asked.frames}")
        given = ("-o", root / "bags", "--format", "rosbag", "--results", root / "drives", *drawn)
        timed("record", "record", "quick", *given, *jobs)
    logs, results = root / "logs", root / "results"
    for outdated in (logs, results):
        shutil.rmtree(outdated, ignore_errors=True)
    (root / "two_bags.yaml").write_text(SCENARIO)
    taken = [
        timed("import", "import", "rosbag", *bags, "-o", logs, *TOPICS, *jobs),
        timed("run", "run", root / "two_bags.yaml", "--results", results, *jobs),
        timed("report", "report", results / "two_bags-0"),
    ]
    clock, used = (sum(each) for each in zip(*taken, strict=True))
    say(f"{'together':8s} {clock:7.1f} s by the clock, {used:7.1f} s of processors")


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
