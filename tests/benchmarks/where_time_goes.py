"""Where the time of runs goes, stage by stage, beside that of others.

`python -m tests.benchmarks.where_time_goes results/rooms_high-0 --before old/rooms_high-0`

The floor is that of `floors`, measured where this runs.

Seconds of work as the stages measured them: of one process where runs had `--jobs 1`, and longer
where others worked beside them. What a run needs beyond its stages (starting, compiling what a
stage does not, tables, figures) is in none of them.
"""

import argparse
import sys
from pathlib import Path

import pandas as pd

from tests.benchmarks.floors import floors_ms

_A_FRAME = "ms a robot's frame"
# Stages in the order of the data, and what they are called here.
_NAMES = {
    "drive": "drive",
    "faces": "paint the walls",
    "rendering": "draw the pictures",
    "features": "find features, write them",
    "observed": "read them, follow tracks",
    "log": "log",
    "slam": "FastSLAM",
    "match": "match descriptors, find rivals",
    "aligner": "all aligners, refined",
    "align": "join estimates",
    "smooth": "smooth the logs",
    "fuse": "all fusers",
    "judge": "compare with the truth",
}


def seconds(results: list[Path]) -> pd.Series:
    """Mean seconds of a run by stage; drawing is a part of its own."""
    tables = [pd.read_parquet(result / "tables" / "timings.parquet") for result in results]
    rows = pd.concat(tables)
    figure = rows["name"].str.partition(":")[2]
    rows = rows.assign(stage=rows["stage"].where(figure == "elapsed_s", "rendering"))
    total = rows.groupby("stage")["elapsed_s"].sum() / len(results)
    total["features"] -= total.get("rendering", 0.0)
    return total.reindex(list(_NAMES)).fillna(0.0)


def frames(results: list[Path]) -> float:
    """Mean number of robots' frames in a run."""
    robots = [pd.read_parquet(result / "tables" / "robots.parquet") for result in results]
    return sum(map(len, robots)) / len(results)


def table(results: list[Path], before: list[Path]) -> str:
    """Markdown."""
    columns = {"now, s": seconds(results)}
    columns[f"now, {_A_FRAME}"] = 1e3 * columns["now, s"] / frames(results)
    if before:
        columns = {"before, s": seconds(before)} | columns
    columns["floor, ms"] = pd.Series(floors_ms()).reindex(list(_NAMES))
    shown = pd.DataFrame(columns)
    shown = pd.concat([shown, shown.sum().to_frame("together").T])
    lines = [f"| stage | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
    for stage, row in shown.iterrows():
        figures = " | ".join(_shown(value) for value in row)
        lines.append(f"| {_NAMES.get(str(stage), stage)} | {figures} |")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return "-" if pd.isna(value) else f"{value:.1f}" if value >= 1 else f"{value:.2g}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", nargs="+", type=Path)
    parser.add_argument("--before", nargs="*", type=Path, default=[])
    given = parser.parse_args()
    sys.stdout.write(table(given.results, given.before) + "\n")


if __name__ == "__main__":
    main()
