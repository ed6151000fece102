"""Sound logs that are warned of as contradicting themselves.

    python -m tests.benchmarks.sound_logs FOLDER...

Each folder is searched for robot logs, as `mapfusion record` and `mapfusion import` write them. To
make some: `mapfusion record SCENARIO -o FOLDER --seed N --set drive.frames=60 --set
render.renderer=raycast` for scenarios of the suite and several seeds, and `mapfusion import mrclam`
for real ones. Each log is compared with its observations, and its truth, if it has any, with its
odometry. A line for each log that is warned of, then how many of all are.
"""

import argparse
import sys
from pathlib import Path

from experiments.evaluation.evaluated_run import finding_of_truth
from experiments.evaluation.truth import truth_or_unknown
from mapfusion.datasets.log_consistency import Finding, check_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.robot_log import read_log


def findings_of(folder: Path) -> list[Finding]:
    """Return the contradictions inside a log, and between the log and its truth."""
    log, noise = read_log(folder), MotionNoise()
    findings = list(check_log(log, noise).findings)
    truth = finding_of_truth(log, truth_or_unknown(folder, log).T_world_robot, noise, not findings)
    return findings if truth is None else [*findings, truth]


def main() -> None:
    """Check the logs of the folders that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="+")
    asked = parser.parse_args()
    logs = sorted(
        {path.parent for folder in asked.folder for path in folder.rglob("frames.parquet")}
    )
    warned = 0
    for folder in logs:
        findings = findings_of(folder)
        warned += bool(findings)
        sys.stdout.writelines(f"{folder}: {finding.text}\n" for finding in findings)
    sys.stdout.write(f"{warned} of {len(logs)} sound logs are warned of\n")


if __name__ == "__main__":
    main()
