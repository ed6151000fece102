"""The calibration set of the verdicts: short runs without common ground, of all kinds.

    python -m tests.benchmarks.runs_without_common_ground FOLDER --seeds 2000..2300 --jobs 4

The seeds are dealt to the seven scenarios `scenarios/*apart.yaml` in turn: 301 seeds are 43 runs of
each, with small pictures and short drives. No two runs have a seed in common. Scenarios share
walls, routes and textures of a seed, so that such runs would not be independent. The runs accept
with `align.evidence.least_ratio=1`, so that `mapfusion study verdicts` can judge every threshold;
its tables go to FOLDER/guarantee. The same command continues
an interrupted sweep. On these maps every accepted alignment is wrong.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.scenario.suite import parse_seeds

_SCENARIOS = Path(__file__).parents[2] / "scenarios"
# The focal length is that of the default camera at half its resolution.
_SETTINGS = (
    "drive.frames=120",
    "render.renderer=raycast",
    "camera.width_px=320",
    "camera.height_px=240",
    "camera.focal_px=288.5",
    "align.evidence.least_ratio=1",
    "align.repetitions=1",
)


def commands(folder: Path, seeds: Sequence[int], jobs: int) -> list[list[str]]:
    """Return the words of the sweeps, one for each scenario, and of the study."""
    scenarios = sorted(_SCENARIOS.glob("*apart.yaml"))
    settings = [word for setting in _SETTINGS for word in ("--set", setting)]
    where = ["--jobs", str(jobs), "-o", str(folder / "sweep"), "--results", str(folder)]
    made = []
    for number, scenario in enumerate(scenarios):
        if own := ",".join(map(str, seeds[number :: len(scenarios)])):
            made.append(["sweep", str(scenario), "--seeds", own, *settings, *where])
    return [*made, ["study", "verdicts", str(folder / "sweep"), "-o", str(folder / "guarantee")]]


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the runs, then print what they certify; exit with the code of a command that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="2000..2300", type=parse_seeds)
    parser.add_argument("--jobs", type=int, default=1, help="Processes.")
    given = parser.parse_args(arguments)
    for words in commands(given.folder.resolve(), given.seeds, given.jobs):
        done = subprocess.run([sys.executable, "-m", "experiments", *words], check=False)
        if done.returncode:
            sys.exit(done.returncode)


if __name__ == "__main__":
    main()
