"""Time of each stage in two groups of runs, side by side.

`python -m tests.benchmarks.where_time_goes results/sweeps/full --before old/sweeps/full`; of single
runs the folders of their results.

The floor is that of `floors`, measured where this runs.

Seconds of work as the stages measured them: of one process where runs had `--jobs 1`, and longer
where others worked beside them. What single runs need beyond their stages (start, tables, timing
the aligners, figures) has rows of its own. Sweeps do not measure it.
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
    "start": "start: imports, scenario",
    "tables": "write the tables",
    "timing the aligners": "time the aligners",
    "figures": "draw the figures",
}


def times(result: Path) -> pd.DataFrame:
    """Return the time of stages in all runs of a folder; columns stage, figure, seconds."""
    if (sweep := result / "run_times").is_dir():
        return pd.read_parquet(sweep)
    rows = pd.read_parquet(result / "tables" / "timings.parquet")
    return rows.assign(figure=rows["name"].str.partition(":")[2], seconds=rows["elapsed_s"])


def robots(result: Path) -> pd.DataFrame:
    """One row a robot's frame, in all runs of a folder."""
    sweep = result / "robots"
    return pd.read_parquet(sweep if sweep.is_dir() else result / "tables" / "robots.parquet")


def n_runs(results: list[Path]) -> int:
    """Return the number of runs in the folders."""
    rows = (robots(result) for result in results)
    return sum(each["run_id"].nunique() if "run_id" in each else 1 for each in rows)


def seconds(results: list[Path]) -> pd.Series:
    """Mean seconds of a run by stage; drawing is a part of its own."""
    rows = pd.concat([times(result) for result in results])
    rows = rows[rows["figure"].isin(["elapsed_s", "rendering_s"])]
    rows = rows.assign(stage=rows["stage"].where(rows["figure"] == "elapsed_s", "rendering"))
    total = rows.groupby("stage")["seconds"].sum() / n_runs(results)
    total["features"] -= total.get("rendering", 0.0)
    return total.reindex(list(_NAMES)).fillna(0.0)


def frames(results: list[Path]) -> float:
    """Mean number of robots' frames in a run."""
    return sum(len(robots(result)) for result in results) / n_runs(results)


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
