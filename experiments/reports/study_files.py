"""Files that studies write: tables and figures."""

import math
import platform
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.evaluation.alignment_criteria import RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.evaluation.tables import table_path
from experiments.pipeline.stage import library_versions
from experiments.pipeline.tables import FLOAT, INT, TEXT, fields, write_rows
from experiments.plugins.discovery import find_method
from experiments.reports.export import publish_json, to_markdown, write_tables, write_text
from experiments.reports.figures import study_figures
from experiments.reports.figures.drawing import draw_figure, save_figure
from experiments.reports.figures.result_tables import NothingToDraw, ResultTables
from experiments.scenario.settings import AnyScenario
from experiments.studies.benchmark import (
    CROSSING,
    SIGMA_M,
    SIZE_M,
    SUMMARY,
    TRIALS,
    BenchmarkDesign,
    crossings,
)
from experiments.studies.independence_trial import (
    COST_HEADINGS,
    COSTS,
    STRATEGIES,
    TEAMS,
    Independence,
    medians_at_last_iteration,
    shown_numbers,
)
from experiments.studies.paper_claims import READINGS, VALUES, claims_table
from experiments.studies.refusal_rates import (
    SHARES,
    THRESHOLDS,
    VERDICTS,
    Guarantee,
    Rate,
    first_right_answers,
    of_any_method,
    ordinary,
)
from experiments.studies.run_tables import find_runs
from experiments.studies.statistics import ALL_SCENARIOS, Summary, configurations, summarise
from mapfusion.align.alignment import Status
from mapfusion.errors import InputError
from mapfusion.files import schema, write_json

_FIGURES = ("fig04_translation_error", "fig05_rotation_error", "fig06_aligner_time")


def run_statistics(
    paths: Sequence[Path], output: Path | None, as_json: bool = False
) -> tuple[Summary, list[str]]:
    """Write all tables and figures 4 to 6 into an output folder, and the tables as JSON if asked.

    Returns:
        The tables, and lines about figures that could not be drawn.

    Raises:
        InputError: a path has no runs, no run knows the truth, or a table is damaged.
    """
    summary = summarise(find_runs(paths))
    if not {"success_at_the_end", "paths"} & summary.tables.keys():
        where = ", ".join(map(str, paths))
        raise InputError(f"{where}: no truth is known, so there are no errors to count")
    skipped: list[str] = []
    if output is not None:
        write_tables(output, summary.tables)
        # Each configuration with several runs has its figures, in a folder of its own if there are
        # several configurations.
        drawn = {
            "-".join([labels.pop("scenario"), *(f"{key}={labels[key]}" for key in labels)]): medians
            for labels, medians in configurations(summary.run_medians)
            if labels["scenario"] != ALL_SCENARIOS
        }
        for name, medians in drawn.items():
            runs, timings = medians["run_id"].unique(), summary.timings
            if len(runs) < 2:
                skipped.append(f"{name}: one run alone; `mapfusion report --figures` draws it")
                continue
            if len(timings):
                timings = timings[timings["run_id"].isin(runs)]
            folder = output / "figures"
            if len(drawn) > 1:  # settings may contain any character, but file names may not
                folder /= re.sub(r"[^\w.=-]", "_", name)[:120]
            data = ResultTables(folder, {"errors": medians, "aligner_timings": timings})
            for figure in _FIGURES:
                lines = draw_figure(data, figure, folder).skipped
                skipped += [f"{name}, {line}" for line in lines]
    if as_json:
        contents = {"n_runs": summary.n_runs, "n_configurations": summary.n_configurations}
        contents |= {"missing_tables": summary.missing, "failed_runs": summary.failed}
        publish_json(
            "statistics", contents | {"written": output, "tables": summary.tables}, is_printed=True
        )
    return summary, skipped


SCHEMA_VERSION = 1


def write_benchmark(
    folder: Path, design: BenchmarkDesign, trials: pd.DataFrame, summary: pd.DataFrame
) -> None:
    """Write `trials`, `summary` (Parquet and CSV), `summary.md`, `benchmark.*` and provenance."""
    write_rows(folder / "trials.parquet", TRIALS, trials)
    write_rows(folder / "summary.parquet", SUMMARY, summary)
    write_text(folder / "summary.csv", summary.to_csv(index=False))
    write_text(folder / "summary.md", benchmark_markdown(design, summary))
    provenance = {
        "seed": design.seed,
        "trials": design.trials,
        "budget_s": design.budget_s,
        "unpaired_share": design.unpaired_share,
        "aligners": [
            entry.model_dump(mode="json") | {"origin": find_method(entry.method).origin()}
            for entry in design.aligners
        ],
    }
    write_provenance(folder, provenance)
    save_figure(folder, "benchmark", study_figures.draw_benchmark, summary)


def write_provenance(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the content with the versions of Python and of libraries, the machine and the time."""
    environment = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    provenance = {"schema_version": SCHEMA_VERSION, **content, **environment}
    write_json(folder / "provenance.json", provenance)


def benchmark_markdown(design: BenchmarkDesign, summary: pd.DataFrame) -> str:
    """Return the whole table in Markdown, one section for each number of pairs."""
    unpaired_share = design.unpaired_share
    unpaired_text = (
        f"{unpaired_share:.0%} of each map's landmarks without a partner; "
        if unpaired_share
        else ""
    )
    parts = [
        f"# Aligners on made-up maps\n\n"
        f"Planar maps of landmarks uniform in {SIZE_M:g} x {SIZE_M:g} m, residuals of true pairs "
        f"{SIGMA_M:g} m per axis, false pairs uniform; {unpaired_text}"
        f"{design.trials} trials a cell, seed {design.seed}, the same maps for all methods.\n\n"
        f"Each cell: successes in % (accepted and within {RIGHT_WITHIN_M:g} m and "
        f"{RIGHT_WITHIN_RAD:g} rad as estimated) with Wilson's 95 % interval; the median "
        "translation error of the successes over the oracle's (least squares on the true pairs) on "
        "the same maps, as estimated / after the common least squares; the median time of one "
        "call, serial and warmed. `wrong` counts, where there are any, trials accepted though "
        "outside the tolerance. Below 3 true pairs no motion is determined: there the right answer "
        "is a refusal.\n"
    ]
    for n_pairs, rows in summary.groupby("n_pairs", sort=False):
        columns = {
            f"{unpaired_share:.0%} outliers ({cells['n_true'].iloc[0]} true)": cells.set_index(
                "method"
            ).apply(cell_text, axis=1)
            for unpaired_share, cells in rows.groupby("outlier_share", sort=False)
        }
        table = pd.DataFrame(columns).reset_index(names="method")
        parts += [f"## {n_pairs} pairs\n", to_markdown(table)]
    return "\n".join(parts)


def cell_text(cell: pd.Series) -> str:
    """Write one cell: success, error over the oracle, time."""
    if cell["status"] == Status.ABSENT:
        return "absent"
    low, high = (f"{100 * cell[name]:.0f}" for name in ("success_low", "success_high"))
    parts = [f"**{100 * cell['success']:.0f}** ({low}-{high})"]
    if cell["n_success"]:
        ratios = (cell["ratio_m"], cell["refined_ratio_m"])
        parts.append(" / ".join("-" if math.isnan(r) else f"{r:.2f}" for r in ratios))
    if not math.isnan(cell["elapsed_s"]):
        elapsed_ms = 1e3 * cell["elapsed_s"]
        parts.append(f"{elapsed_ms:.0f} ms" if elapsed_ms >= 100 else f"{elapsed_ms:.3g} ms")
    parts += [f"{cell[f'n_{what}']} {what}" for what in ("wrong", "failed") if cell[f"n_{what}"]]
    return ", ".join(parts)


FIGURE = "independence"


def write_independence(
    folder: Path, scenarios: Sequence[AnyScenario], found: Independence
) -> list[str]:
    """Write `teams`, `costs` (Parquet), `summary` (CSV, Markdown), the figure and provenance.

    Returns:
        The reason if there is no figure, else an empty list.
    """
    summary = medians_at_last_iteration(found)
    write_rows(folder / "teams.parquet", TEAMS, found.teams)
    write_rows(folder / "costs.parquet", COSTS, found.costs)
    write_text(folder / "summary.csv", summary.to_csv(index=False))
    write_text(folder / "summary.md", independence_markdown(scenarios, summary))
    write_provenance(folder, {"scenarios": [scenario.resolved() for scenario in scenarios]})
    try:
        save_figure(folder, FIGURE, study_figures.draw_independence, found.teams, found.costs)
    except NothingToDraw as reason:
        return [f"{FIGURE}: {reason}"]
    return []


def independence_markdown(scenarios: Sequence[AnyScenario], summary: pd.DataFrame) -> str:
    """Return the table in Markdown, one section for each size of team."""
    seeds = ", ".join(str(scenario.seed) for scenario in scenarios)
    parts = [
        f"# What independence costs\n\n"
        f"Scenario {scenarios[0].name}, seeds {seeds}: medians over the seeds, of the map at the "
        "last iteration. Each team is the first robots of the scenario. CPU times and memory are "
        f"those of one machine ({platform.machine()}), measured one piece of work after the other; "
        "compare them with each other. Errors are root mean squares, of landmarks without the "
        "gross ones. `mapfusion docs independence` defines all of it.\n"
    ]
    labels = {strategy.name: strategy.label for strategy in STRATEGIES}
    for n_robots, rows in summary.groupby("n_robots"):
        whole, n = rows["n_whole"].min(), rows["n_seeds"].max()
        shown = {heading: shown_numbers(rows, name) for name, (heading, _) in COST_HEADINGS.items()}
        table = pd.DataFrame({"way to one map": rows["strategy"].map(labels)} | shown)
        parts += [
            f"## {n_robots} robots\n",
            f"All robots' maps became one in {whole} of {n} runs.\n",
            to_markdown(table),
        ]
    return "\n".join(parts)


_RATES = ("false_runs", "false_pairs", "false_by_chance", "wrong_pairs", "on_ground", "ambiguous")
_RATES += tuple(f"right_{verdict}" for verdict in VERDICTS)
_FIRST = ("first_iteration", "first_true_pairs")
# One row for each kind of world and method: NAME of NAME_of, with Wilson's interval (`by_kind`).
KINDS = schema(
    "refusal.kinds",
    1,
    fields(
        **dict.fromkeys(("kind", "aligner"), TEXT),
        **{
            f"{name}{end}": kind
            for name in _RATES
            for end, kind in (("", INT), ("_of", INT), ("_low", FLOAT), ("_high", FLOAT))
        },
        **dict.fromkeys([*_FIRST, *(f"{name}_by_chance" for name in _FIRST)], FLOAT),
    ),
)


def write_kinds(folder: Path, refusals: pd.DataFrame, rows: list[dict[str, Any]]) -> Path:
    """Write rows of `by_kind` as the table `kinds` and as the page `kinds.md`.

    The page begins with the rates over all methods (`of_any_method`) and with the iteration of the
    first right answer in ordinary worlds (`first_of_ordinary`).
    """
    flat_rows = []
    for row in rows:
        flat: dict[str, Any] = {}
        for name, value in row.items():
            if isinstance(value, Rate):
                low, high = value.interval
                flat |= {name: value.hits, f"{name}_of": value.n}
                flat |= {f"{name}_low": low, f"{name}_high": high}
            else:
                flat[name] = value
        flat_rows.append(flat)
    write_rows(table_path(folder, "kinds"), KINDS, flat_rows)
    page, text = folder / "kinds.md", "# Verdicts by kind of world\n"
    parts = {"Any method": of_any_method(refusals)}
    if first := first_right_answers(refusals):
        parts["First right answers in worlds that do not repeat themselves"] = first
    parts["Each method"] = rows
    for title, part in parts.items():
        shown = [
            {
                name: f"{value.hits}/{value.n}" if isinstance(value, Rate) else value
                for name, value in row.items()
            }
            for row in part
        ]
        text += f"\n## {title}\n\n{to_markdown(pd.DataFrame(shown))}\n"
    write_text(page, text)
    return page


def draw_refusals(
    folder: Path,
    refusals: pd.DataFrame,
    calibration: pd.DataFrame,
    false_alarms: float,
) -> list[Path]:
    """Draw the figures that have data, and return their files."""
    place, files = folder / "figures", []
    if len(ordinary(refusals)):
        data = (refusals, calibration, false_alarms)
        files += save_figure(place, "refusal", study_figures.draw_refusal, *data)
    files += save_figure(place, "refusal_kinds", study_figures.draw_refusal_kinds, refusals)
    files += save_figure(place, "refusal_roc", study_figures.draw_refusal_roc, refusals)
    return files


def write_guarantee(folder: Path, found: Guarantee) -> list[Path]:
    """Write the tables `shares` and `thresholds` (Parquet and CSV), and return their files."""
    stated = {"alpha": f"{found.alpha:g}", "delta": f"{found.delta:g}"}
    files = []
    for name, schema_of in (("shares", SHARES), ("thresholds", THRESHOLDS)):
        rows = getattr(found, name)
        files += [folder / f"{name}.parquet", folder / f"{name}.csv"]
        write_rows(files[-2], schema_of, rows, stated)
        write_text(files[-1], rows.to_csv(index=False))
    return files


_SECTIONS = {"4": "Map building", "5": "Map alignment", "6": "Map merging", "7": "Conclusion"}
CROSSING_FIGURE = "crossing"


def write_claims(folder: Path, values: pd.DataFrame, crossing: pd.DataFrame) -> list[Path]:
    """Write `claims` and `crossing` (Parquet and CSV), the figure and the page `paper.md`."""
    for name, schema_of, rows in (("claims", VALUES, values), ("crossing", CROSSING, crossing)):
        write_rows(folder / f"{name}.parquet", schema_of, rows)
        write_text(folder / f"{name}.csv", rows.to_csv(index=False))
    page = folder / "paper.md"
    write_text(page, claims_page(values, crossing))
    return [page, *save_figure(folder, CROSSING_FIGURE, study_figures.draw_crossing, crossing)]


def claims_page(values: pd.DataFrame, crossing: pd.DataFrame) -> str:
    """Return the page "The paper beside this software" in Markdown."""
    runs = values.groupby(["scenario", "renderer"], sort=False)["n_runs"].max().reset_index()
    drawn = (f"`{row.scenario}`: {row.n_runs} by {row.renderer}" for row in runs.itertuples())
    parts = [
        "# The paper beside this software\n",
        "Written by `mapfusion study paper`; do not edit. `paper_as_printed` runs the methods of "
        '"Map Fusion in an Independent Multi-robot Approach" as printed, `paper` runs the same '
        "experiment with the defaults of this software.\n",
        f"Each value is the median over runs, one seed each, with its 95 % interval (bootstrap "
        "over runs). A claim is confirmed if the whole interval lies in the range that confirms "
        "it, refuted if all of it lies outside, and partly confirmed otherwise. The range is in "
        "`claims.csv` beside this page. T_a_b is the motion from the frame of map b to that of "
        f"map a; errors are those of T_a_b before the common least squares. "
        f"Runs and their renderers: {'; '.join(drawn)}.\n",
        "## Readings of the paper\n",
        *(f"- {line}" for line in READINGS),
        "",
    ]
    for number, title in _SECTIONS.items():
        rows = values[values["where"].str.startswith(number)]
        parts += [f"## Section {number}: {title}\n", to_markdown(claims_table(rows))]
    parts += [
        "## SVD and ICP against the share of false pairs\n",
        f"![Error against the share of false pairs]({CROSSING_FIGURE}.png)\n",
        *(f"{line}\n" for line in crossing_lines(crossing)),
    ]
    return "\n".join(parts)


def crossing_lines(crossing: pd.DataFrame) -> list[str]:
    """Say where the order of SVD and ICP changes, a line for each share of unpaired landmarks."""
    lines = []
    for unpaired, shares in crossings(crossing, "svd", "icp").items():
        errors = crossing[crossing["unpaired_share"] == unpaired]
        fewest = errors[errors["outlier_share"] == errors["outlier_share"].min()]
        error = fewest.set_index("method")["error_m"]
        order = "SVD is better" if error["svd"] < error["icp"] else "ICP is at least as good"
        at = ", ".join(f"{share:.1%}" for share in shares)
        where = f"the order changes at {at} of false pairs" if shares else "the order never changes"
        lines.append(
            f"With {unpaired:.0%} of the landmarks unpaired and no false pair, {order} "
            f"({error['svd']:.3f} m beside {error['icp']:.3f} m); {where}."
        )
    return lines
