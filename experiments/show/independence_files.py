"""What the study `independence` leaves behind: tables for machines and people, and its figure."""

import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from experiments.run.code_version import library_versions
from experiments.run.frames import write_rows
from experiments.scenario.settings import AnyScenario
from experiments.show.export import to_markdown, write_text
from experiments.show.figures import independence_figure
from experiments.show.figures.drawing import save_figure
from experiments.show.figures.result_tables import NothingToDraw
from experiments.study.independence.independence_trial import COSTS, TEAMS, Independence, at_the_end
from experiments.study.independence.strategies import STRATEGIES
from mapfusion.storage import write_json

SCHEMA_VERSION = 1
FIGURE = "independence"
# Columns of `at_the_end` that people are shown: headings of a page and of a screen.
SHOWN = {
    "robots_s": ("robots' own work, CPU s", "robots'\nCPU s"),
    "busiest_robot_s": ("of the busiest robot", "busiest\nCPU s"),
    "team_s": ("team's work, CPU s", "team's\nCPU s"),
    "robot_peak_mb": ("peak of a robot, MB", "robot\nMB"),
    "team_peak_mb": ("peak of the team's, MB", "team\nMB"),
    "sent_mb": ("sent by all, MB", "sent\nMB"),
    "landmark_rmse_m": ("map in its frame, mm", "map\nmm"),
    "fitted_rmse_m": ("map after a fit, mm", "fitted\nmm"),
    "path_rmse_m": ("paths after a fit, mm", "paths\nmm"),
}
_MM_A_M = 1000.0


def write_independence(
    folder: Path, scenarios: Sequence[AnyScenario], found: Independence
) -> list[str]:
    """Write `teams`, `costs` (Parquet), `summary` (CSV, Markdown), the figure and provenance.

    Returns why there is no figure, if there is none.
    """
    summary = at_the_end(found)
    write_rows(folder / "teams.parquet", TEAMS, found.teams)
    write_rows(folder / "costs.parquet", COSTS, found.costs)
    write_text(folder / "summary.csv", summary.to_csv(index=False))
    write_text(folder / "summary.md", markdown(scenarios, summary))
    write_json(folder / "provenance.json", _provenance(scenarios))
    try:
        save_figure(folder, FIGURE, independence_figure.draw, found.teams, found.costs)
    except NothingToDraw as reason:
        return [f"{FIGURE}: {reason}"]
    return []


def _provenance(scenarios: Sequence[AnyScenario]) -> dict[str, object]:
    return {
        "schema_version": SCHEMA_VERSION,
        "scenarios": [scenario.resolved() for scenario in scenarios],
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def markdown(scenarios: Sequence[AnyScenario], summary: pd.DataFrame) -> str:
    """The table for people: one section for each size of team."""
    seeds = ", ".join(str(scenario.seed) for scenario in scenarios)
    parts = [
        f"# What independence costs\n\n"
        f"Scenario {scenarios[0].name}, seeds {seeds}: medians over the seeds, of the map at the "
        "last iteration. Each team is the first robots of the scenario. CPU times and memory are "
        f"those of one machine ({platform.machine()}), measured one piece of work after the other; "
        "compare them with each other. Errors are root mean squares, of landmarks without the "
        "gross ones. `experiments/docs/independence.md` defines all of it.\n"
    ]
    for n_robots, rows in summary.groupby("n_robots"):
        whole, n = rows["n_whole"].min(), rows["n_seeds"].max()
        parts += [
            f"## {n_robots} robots\n",
            f"All robots' maps became one in {whole} of {n} runs.\n",
            to_markdown(_for_people(rows)),
        ]
    return "\n".join(parts)


def _for_people(rows: pd.DataFrame) -> pd.DataFrame:
    labels = {strategy.name: strategy.label for strategy in STRATEGIES}
    shown = {heading: shown_numbers(rows, name) for name, (heading, _) in SHOWN.items()}
    return pd.DataFrame({"way to one map": rows["strategy"].map(labels)} | shown)


def shown_numbers(rows: pd.DataFrame, name: str) -> pd.Series:
    """A column of `SHOWN` in the unit of its headings: errors in mm."""
    return rows[name] * (_MM_A_M if name.endswith("rmse_m") else 1.0)
