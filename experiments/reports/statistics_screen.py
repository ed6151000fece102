"""Screens of `statistics` and `compare`."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from rich.text import Text

from experiments.evaluation.alignment_criteria import (
    ORACLE,
    RICH_PAIRS,
    RIGHT_WITHIN_M,
    RIGHT_WITHIN_RAD,
    setting_columns,
)
from experiments.reports import layout
from experiments.reports.layout import columns, interval, number
from experiments.studies import comparison
from experiments.studies.intervals import FEW_RUNS, MAPS_OF_ONE_RUN, RUN
from experiments.studies.statistics import ALL_SCENARIOS, Summary

_MAX_CONFIGURATIONS = 6  # on the screen; the files have all
_TEXT_WIDTH = 80  # default width of terminals
# Text and style of each verdict, in the order of a comparison's rows
_VERDICTS = {
    comparison.WORSE: ("worse", "bold red"),
    comparison.BETTER: ("better", "green"),
    comparison.UNKNOWN: ("unknown", "yellow"),
    comparison.NOISE: ("noise", "dim"),
    comparison.SAME: ("same", "dim"),
}
_PATH_NAMES = {"ate_m": "ATE, m", "rpe_m": "RPE, m", "rpe_rad": "RPE, rad"}

# Columns of tables; intervals are shown beside the numbers.
_METHOD = columns("", aligner="method")
_SUCCESS = _METHOD | columns(".0%", estimated_success="as estimated", refined_success="refined")
_STAGES = {"estimated": "as estimated", "refined": "refined"}
_AGAINST = {
    "second": ("other", ""),
    "ratio": ("its error over other's", ".2f"),
    "first_wins": ("nearer", ".0%"),
    "p_holm": ("p (Holm)", ".2g"),
}
_PATHS = columns("", source="path", error="error")
_PATHS |= columns(".3g", rmse="RMSE", median="median", max="max")
_SMOOTHER = columns(".3g", path_rmse_m="path, m", filter_over_smoother="ratio")
_SMOOTHER |= columns(".3g", landmark_rmse_m="landmarks, m", nees_per_dof="NEES / dof")
_SMOOTHER |= columns(".1%", gross_share="gross", coverage_95="in 95 %")
_FUSERS = columns("", fuser="fuser") | columns(".2g", landmark_rmse_m="landmarks, m")
_FUSERS |= columns(".2g", over_better_filter="over filter", nees_per_dof="NEES / dof")
_FUSERS |= columns(".0%", coverage_95="in 95 %")
_ADOPTION = columns("d", n_robots="robots", n_adopting="adopting")
_ADOPTION |= columns(".2f", path_over_alone="path /\nalone") | columns(".0%", worse="worse")
_ADOPTION |= columns(".2g", landmark_rmse_m="landmarks\nm", frame_nees_per_dof="NEES\n/ dof")
_ADOPTION |= columns(".0%", frame_coverage_95="in\n95 %", shared_share="shared")
_TEAM = columns("", source="path") | columns(">", robots="robots")
_TEAM |= columns(".3g", rmse="RMSE, m", median="median", max="max")
_TEAM_PAIRS = columns("d", n_pairs="pairs\nof maps", n_met="met") | columns(
    ".0%", precision="precision"
)
_TEAM_PAIRS |= columns(".0%", recall="recall")
_TEAM_PAIRS |= columns(".3g", alone_m="alone, m", team_m="in the team, m")
_NEES = columns("", landmarks="landmarks") | columns("d", n_landmarks="n")
_NEES |= columns(".3g", nees_per_dof="NEES") | columns(">", band="chi-square")
_NEES |= columns(".0%", share_in_gate="in gate")
_ALIGNMENT_NEES = (
    _METHOD
    | columns("", maps="maps")
    | columns("d", n_maps="n")
    | columns(".2g", nees_per_dof="NEES / dof")
)
_ALIGNMENT_NEES |= columns(".0%", coverage_90="in 90 %")


def print_summary(summary: Summary, written: Path | None, skipped: Sequence[str]) -> None:
    """Print the main tables, and the folder of all tables."""
    _print_success(_rows(summary, "success_at_the_end"), summary.n_runs)
    by_pairs = _rows(summary, "success_by_true_pairs")
    if len(by_pairs):
        # One column per bin of the number of true pairs
        last = np.where(by_pairs["to"] == math.inf, "+", "")
        by_pairs = by_pairs.assign(bin=by_pairs["from"].map("{:.0f}".format) + last)
        index = [*_labels(by_pairs), "aligner"]
        shares = by_pairs.pivot_table("estimated_success", index, "bin", sort=False)
        bins = {name: name for name in by_pairs.sort_values("from")["bin"] if name in shares}
        shown = _METHOD | columns(".0%", **bins)
        note = "by the number of true correspondences, from the lower edge of each bin; "
        note += "intervals: see the files"
        _print(shares.reset_index(), shown, "Share of the maps right as estimated", note)
    ratios = _rows(summary, "error_over_oracle")
    for stage, kind in _STAGES.items():
        shown = _METHOD | columns(".0%", **{f"{stage}_share": "given"})
        shown |= columns(".3f", **{f"{stage}_m": "error, m"})
        shown |= columns(".2f", **{f"{stage}_ratio": "over the oracle"})
        note = (
            f"maps with {RICH_PAIRS}+ true correspondences; (95 %, bootstrap); {layout.NO_ESTIMATE}"
        )
        _print(
            ratios, shown, f"Median translation error {kind}, and its ratio to the oracle's", note
        )
    _print_best_against_others(_rows(summary, "methods_compared"), ratios)
    paths = _rows(summary, "paths")
    if len(paths):
        paths = paths.assign(error=paths["quantity"].map(_PATH_NAMES))
        paths = paths[paths["error"].notna() & (paths["delta_unit"] != "frames")]
        note = "ATE: after the best rigid fit; RPE: relative, along a metre; (95 %, bootstrap)"
        _print(paths, _PATHS, "Path errors, median over robots and runs", note)
    note = "ratio: FastSLAM's final path over the smoothed one; landmarks: fitted; "
    note += "(95 %, bootstrap)"
    title = "Batch smoother, median over robots and runs"
    _print(_rows(summary, "smoother"), _SMOOTHER, title, note)
    note = "landmarks: RMS in the frame of the first robot, without gross ones; over filter:\n"
    note += "fitted error over that of the better FastSLAM map; (95 %, bootstrap)"
    title = "Fused maps by fuser at the end, median over runs"
    _print(_rows(summary, "fusers"), _FUSERS, title, note)
    note = "path / alone: path errors since the first adoption over those of the independent\n"
    note += "robots; worse: share of robots above 1.1; landmarks: adopted ones; (95 %, bootstrap)"
    title = "Robots that exchange maps while they drive, median over robots and runs"
    _print(_rows(summary, "adoption"), _ADOPTION, title, note)
    team = _rows(summary, "team")
    if len(team):
        robots = team["n_robots"].map(str) + "/" + team["n_team"].map(str)
        note = "all merged robots under one rigid fit, median over runs; (95 %, bootstrap)"
        _print(team.assign(robots=robots), _TEAM, "Path errors of teams (ATE)", note)
    note = "precision: right ones of those used; recall: found ones of those that met;\n"
    note += "errors of T_a_b, medians over pairs of merged maps; (95 %, Wilson, bootstrap)"
    title = "Alignments between robots at the end"
    _print(_rows(summary, "team_pairs"), _TEAM_PAIRS, title, note)
    note = "accepted alignments of maps with joint covariances; in 90 %: share of the true\n"
    note += "motions in the stated 90 % ellipsoid; (95 %, bootstrap)"
    title = "Covariances of T_a_b: median NEES per degree of freedom"
    _print(_rows(summary, "alignment_nees"), _ALIGNMENT_NEES, title, note)
    nees = _rows(summary, "nees")
    if len(nees):
        low, high = (nees[name].map("{:.2f}".format) for name in ("band_low", "band_high"))
        nees = nees.drop(columns=["band_low", "band_high"]).assign(band=low + "–" + high)
        title = "Landmark NEES per degree of freedom: 1 is consistent, more is overconfident"
        note = "chi-square: 95 % band of a consistent mean; in gate: of 95 %; (95 %, bootstrap)"
        _print(nees, _NEES, title, note)
    layout.print_lines(_caveats(summary))
    layout.print_skipped(skipped)
    if written is not None:
        n_tables = len(summary.tables)
        layout.print_lines([f"All {n_tables} tables (CSV, Markdown, LaTeX) and figures: {written}"])


def _rows(summary: Summary, name: str) -> pd.DataFrame:
    """Return the rows for the screen: pooled scenarios only, and few configurations."""
    table = summary.tables.get(name, pd.DataFrame({"scenario": []}))
    if (table["scenario"] == ALL_SCENARIOS).any():
        table = table[table["scenario"] == ALL_SCENARIOS]
    numbers = table.groupby(_labels(table), sort=False, dropna=False).ngroup()
    return table[numbers < _MAX_CONFIGURATIONS]


def _labels(rows: pd.DataFrame) -> list[str]:
    """Return the names of the columns of scenario and settings."""
    return ["scenario", *setting_columns(rows)]


def _print(rows: pd.DataFrame, shown: Mapping[str, layout.Column], title: str, note: str) -> None:
    """Print a table, with the columns in front in which configurations differ."""
    apart = columns("", **{name: name for name in _labels(rows) if len(rows[name].unique()) > 1})
    layout.print_frame(rows, {**apart, **shown}, title, note)


def _print_success(rows: pd.DataFrame, n_runs: int) -> None:
    """Print success rates and verdicts at the last iteration."""
    if rows.empty:
        return
    within = f"within {RIGHT_WITHIN_M:g} m and {RIGHT_WITHIN_RAD:g} rad"
    caption = f"{within}, the reach of the refinement"
    n_apart, n_maps = rows[["n_apart", "n_maps"]].max()  # equal for all methods
    if n_apart:
        caption += f"; without the {n_apart} of {n_maps} pairs of maps that have no common ground"
    title = f"Right at the end of {_runs(n_runs)}"
    _print(rows, _SUCCESS, title, f"{caption}; (95 %, Wilson)")
    if "accepted" not in rows:
        return
    ground = "accepted with\ncommon ground" if n_apart else "accepted"
    shown = _METHOD | columns(".0%", accepted=ground, false_accepted="accepted\nthough wrong")
    if n_apart:
        shown |= columns(".0%", refused_apart="refused without\ncommon ground")
    caption = "though wrong: share of all pairs of maps; (95 %, Wilson)"
    _print(rows, shown, "Verdicts at the end", caption)


def _print_best_against_others(rows: pd.DataFrame, ratios: pd.DataFrame) -> None:
    """Compare the method with the smallest estimated error to each other method on equal maps."""
    if rows.empty:
        return
    methods = ratios[ratios["aligner"] != ORACLE]
    best = str(methods.groupby("aligner")["estimated_m"].median().idxmin())
    # Exchange first and second where the best method is the second one.
    others = rows[rows["second"] == best]
    turned = others.assign(first=others["second"], second=others["first"])
    for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
        turned[f"ratio{end}"] = 1 / others[f"ratio{other}"]
        turned[f"first_wins{end}"] = 1 - others[f"first_wins{other}"]
    beside = pd.concat([rows[rows["first"] == best], turned]).sort_index()
    title = f"{best} against each other method on the same maps, as estimated"
    caption = "median ratio, and share of the maps; (95 %, bootstrap)"
    _print(beside, _AGAINST, title, caption)


def _caveats(summary: Summary) -> list[str]:
    """Return warnings about few runs, and notes on what is not shown."""
    lines, n_runs, n_settings = [], summary.n_runs, summary.n_configurations
    if n_runs == 1:
        depend = "which depend on each other; they say nothing about other seeds"
        lines.append(f"One run: the intervals are over the {MAPS_OF_ONE_RUN}, {depend}.")
    elif summary.n_worlds < FEW_RUNS:
        too_narrow = f"bootstrap intervals of so few are too narrow; use {FEW_RUNS} seeds or more"
        worlds = f"{summary.n_worlds} world{'s' * (summary.n_worlds > 1)}"
        lines.append(f"{n_runs} runs in {worlds} (scenario and seed): {too_narrow}.")
    if n_settings > _MAX_CONFIGURATIONS:
        shown = f"{_MAX_CONFIGURATIONS} of {n_settings} settings"
        lines.append(f"Shown are {shown}; `-o FOLDER` writes all.")
    for row in summary.failed.to_dict("records"):
        lines.append(f"failed, left out: {row['scenario']} seed {row['seed']}: {row['reason']}")
    if summary.missing:
        lines += textwrap.wrap(f"No run has: {', '.join(summary.missing)}", _TEXT_WIDTH)
    return lines


def print_comparison(
    found: comparison.VersionComparison, show_all: bool, written: Path | None
) -> None:
    """Print changes between two versions with intervals, verdicts and notes."""
    table, order = found.table, list(_VERDICTS)
    changed = table["verdict"].isin([comparison.BETTER, comparison.WORSE])
    rows = (table if show_all else table[changed]).sort_values(
        "verdict", key=lambda names: names.map(order.index), kind="stable"
    )
    shown = [("method", ""), ("metric", ""), ("first", ">"), ("second", ">"), ("change", ">")]
    shown.append(("better\nin", ">"))
    cells: list[list[str | Text]] = []
    for row in rows.to_dict("records"):
        value = {"share": ".0%"}.get(row["scale"], ".3g")
        change = {"share": "+.0%", "ratio": ".2f"}.get(row["scale"], "+.2f")
        is_same = row["verdict"] == comparison.SAME
        changed_by = interval(row["change"], row["low"], row["high"], change)
        texts = [row["method"], row["metric"], number(row["a"], value), number(row["b"], value)]
        counted = f"{row['n_better']} of {row['n_units']}"
        texts += ["" if is_same else changed_by, counted]
        cells.append([*texts, Text(*_VERDICTS[row["verdict"]])])
    title = "Second version against the first"
    note = "change: factor, or difference; (95 %, Student's t); verdict: 5 % over "
    note += f"{table['p'].notna().sum()} tests\nbetter in: number of "
    note += "runs" if found.unit == RUN else found.unit
    layout.print_table([*shown, ("verdict", "")], cells, title, note)
    counts = table["verdict"].value_counts().reindex(order, fill_value=0)
    tally = (
        f"{n} {verdict}" for verdict, n in counts.items() if n or verdict != comparison.UNKNOWN
    )
    ways = f"{_runs(found.n_runs)} compared in {len(table)} ways: {', '.join(tally)}"
    layout.print_lines([ways, *(f"  {note}" for note in found.notes)])
    if written is not None:
        layout.print_lines([f"All rows (CSV, Markdown, LaTeX): {written}"])


def _runs(n: int) -> str:
    """Return "1 run" or "N runs"."""
    return "1 run" if n == 1 else f"{n} runs"
