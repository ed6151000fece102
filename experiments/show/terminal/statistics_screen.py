"""What `mapfusion statistics` and `mapfusion compare` show."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.judge.criteria import ORACLE, RICH_PAIRS, RIGHT_WITHIN_M, RIGHT_WITHIN_RAD
from experiments.show.terminal.layout import LAYOUT
from experiments.study.compare.versions import (
    BETTER,
    NOISE,
    SAME,
    UNKNOWN,
    WORSE,
    VersionComparison,
)
from experiments.study.statistics.better import FEW_RUNS
from experiments.study.statistics.bootstrap import MAPS_OF_ONE_RUN
from experiments.study.statistics.summary import ALL_SCENARIOS, Summary

Row = dict[Any, Any]
Cells = Mapping[str, Callable[[Row], str]]  # by heading, what stands below it
_COLOURS = {BETTER: "green", WORSE: "bold red", UNKNOWN: "yellow"}
_MAX_CONFIGURATIONS = 6  # more would fill screens; the files hold all
_SHORT = {NOISE: "noise", SAME: "same", UNKNOWN: "unknown"}
_PATH_NAMES = {"ate_m": "ATE, m", "rpe_m": "RPE, m", "rpe_rad": "RPE, rad"}


def print_summary(summary: Summary, written: Path | None, skipped: Sequence[str]) -> None:
    """The main tables, and where all of them are."""
    console = Console()
    _print_success(console, summary)
    _print_where_it_fails(console, summary)
    _print_oracle_ratios(console, summary)
    _print_best_against_others(console, summary)
    _print_paths(console, summary)
    _print_nees(console, summary)
    _print_caveats(console, summary)
    for line in skipped:
        console.print(f"  not drawn: {line}", soft_wrap=True, markup=False)
    if written is not None:
        n = len(summary.tables)
        console.print(
            f"All {n} tables (CSV, Markdown, LaTeX) and figures: {written}", soft_wrap=True
        )


def _shown(summary: Summary, name: str) -> tuple[pd.DataFrame, list[str]]:
    """The rows for the screen, and the columns that tell configurations apart.

    Of several scenarios only all together; the files hold each.
    """
    table = summary.tables.get(name, pd.DataFrame({"scenario": []}))
    if (table["scenario"] == ALL_SCENARIOS).any():
        table = table[table["scenario"] == ALL_SCENARIOS]
    labels = [c for c in table if c == "scenario" or "." in str(c)]
    if len(table):
        numbers = table.groupby(labels, sort=False, dropna=False).ngroup()
        table = table[numbers < _MAX_CONFIGURATIONS]
    return table, [str(c) for c in labels if len(table[c].unique()) > 1]


def _print_table(
    console: Console,
    shown: tuple[pd.DataFrame, Sequence[str]],
    title: str,
    cells: Cells,
    caption: str,
    words: Sequence[str] = (),
) -> None:
    """A row of cells for each row shown; below, what they mean, unbroken at the table's width.

    `words` are the headings of further columns that are no numbers, and may wrap.
    """
    rows, labels = shown
    if rows.empty:
        return
    table = Table(title=title, **LAYOUT)
    for label in labels:
        table.add_column(escape(label))
    lines = max(heading.count("\n") for heading in cells)
    for place, heading in enumerate(cells):
        lower = "\n" * (lines - heading.count("\n")) + heading
        side = "left" if heading in words or not place else "right"
        table.add_column(lower, justify=side, no_wrap=heading not in words)
    for row in rows.to_dict("records"):
        own = [escape(str(row[label])) for label in labels]
        table.add_row(*own, *(cell(row) for cell in cells.values()))
    console.print(table)
    console.print(f"[dim]{escape(caption)}[/]\n", highlight=False)


def _text(name: str) -> Callable[[Row], str]:
    return lambda row: escape(str(row[name]))


def _figure(name: str, layout: str) -> Callable[[Row], str]:
    return lambda row: _number(row[name], layout)


def _interval(name: str, layout: str = ".2f") -> Callable[[Row], str]:
    """A number with its interval in brackets, from the columns NAME_low and NAME_high."""
    return lambda row: _bracketed(row[name], row[f"{name}_low"], row[f"{name}_high"], layout)


def _share(name: str) -> Callable[[Row], str]:
    low, high = f"{name}_low", f"{name}_high"
    return lambda row: _bracketed(100 * row[name], 100 * row[low], 100 * row[high], ".0f")


def _print_success(console: Console, summary: Summary) -> None:
    rows, labels = shown = _shown(summary, "success_at_the_end")
    if rows.empty:
        return
    within = f"within {RIGHT_WITHIN_M:g} m and {RIGHT_WITHIN_RAD:g} rad"
    caption = f"{within}, the reach of the refinement"
    n_apart, n_maps = rows[["n_apart", "n_maps"]].max()  # all methods see the same maps
    if n_apart:
        caption += f"; without the {n_apart} of {n_maps} pairs of maps that have no common ground"
    cells = {"method": _text("aligner"), "as estimated": _share("estimated_success")}
    cells["refined"] = _share("refined_success")
    title = f"Right at the end of {_runs(summary.n_runs)}, percent"
    _print_table(console, shown, title, cells, f"{caption}; (95 %, Wilson)")
    if "accepted" not in rows:
        return
    heading = "accepted where\nthere is common ground" if n_apart else "accepted"
    cells = {"method": _text("aligner"), heading: _share("accepted")}
    cells["accepted\nthough wrong"] = _share("false_accepted")
    if n_apart:
        cells["refused where\nthere is none"] = _share("refused_apart")
    caption = "though wrong: of all, whatever ground; (95 %, Wilson)"
    _print_table(console, (rows, labels), "Verdicts at the end, percent", cells, caption)


def _print_where_it_fails(console: Console, summary: Summary) -> None:
    """Success as estimated by the number of true pairs: methods down, bins across."""
    rows, labels = _shown(summary, "success_by_true_pairs")
    if rows.empty:
        return
    last = np.where(rows["to"] == math.inf, "+", "")
    rows = rows.assign(bin=rows["from"].map("{:.0f}".format) + last)
    shares = rows.assign(percent=100 * rows["estimated_success"]).pivot_table(
        "percent", [*labels, "aligner"], "bin", sort=False
    )
    names = [str(name) for name in rows.sort_values("from")["bin"].unique() if name in shares]
    cells = {"method": _text("aligner")} | {name: _figure(name, ".0f") for name in names}
    title = "Right as estimated, percent of the maps"
    caption = "by the number of true pairs, from the one given up; intervals are in the files"
    _print_table(console, (shares.reset_index(), labels), title, cells, caption)


def _print_oracle_ratios(console: Console, summary: Summary) -> None:
    cells = {
        "method": _text("aligner"),
        "estim.\nm": _figure("estimated_m", ".3f"),
        "over the oracle": _interval("estimated_ratio"),
        "refined\nm": _figure("refined_m", ".3f"),
        "over the oracle ": _interval("refined_ratio"),
    }
    title = "Median translation error, and its ratio to the oracle's"
    caption = f"maps with {RICH_PAIRS}+ true pairs; inf: no estimate on most; (95 %, bootstrap)"
    _print_table(console, _shown(summary, "error_over_oracle"), title, cells, caption)


def _print_best_against_others(console: Console, summary: Summary) -> None:
    """The method with the smallest error as estimated, beside each other on the same maps."""
    rows, labels = _shown(summary, "methods_compared")
    if rows.empty:
        return
    ratios, _ = _shown(summary, "error_over_oracle")
    methods = ratios[ratios["aligner"] != ORACLE]
    best = str(methods.groupby("aligner")["estimated_m"].median().idxmin())
    of_best = [
        _swapped(row) if row["second"] == best else row
        for row in rows.to_dict("records")
        if best in (row["first"], row["second"])
    ]
    cells = {
        "other": _text("second"),
        "its error over other's": _interval("ratio"),
        "nearer, percent": _share("first_wins"),
        "p (Holm)": _figure("p_holm", ".2g"),
    }
    title = f"{best} against each other method on the same maps, as estimated"
    caption = "median ratio, and share of the maps; (95 %, bootstrap)"
    _print_table(console, (pd.DataFrame(of_best), labels), title, cells, caption)


def _swapped(row: Row) -> Row:
    """The same comparison with the methods in the other order."""
    swapped = row | {"first": row["second"], "second": row["first"]}
    for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
        ratio = row[f"ratio{other}"]
        swapped[f"ratio{end}"] = math.inf if ratio == 0 else 1 / ratio
        swapped[f"first_wins{end}"] = 1 - row[f"first_wins{other}"]
    return swapped


def _print_paths(console: Console, summary: Summary) -> None:
    rows, labels = _shown(summary, "paths")
    if len(rows):
        rows = rows[rows["quantity"].isin(list(_PATH_NAMES)) & (rows["delta_unit"] != "frames")]
    cells = {
        "path": _text("source"),
        "error": lambda row: _PATH_NAMES[row["quantity"]],
        "RMSE": _interval("rmse", ".3g"),
        "median": _figure("median", ".3g"),
        "max": _figure("max", ".3g"),
    }
    title = "Path errors, median over robots and runs"
    caption = "ATE: after the best rigid fit; RPE: relative, along a metre; (95 %, bootstrap)"
    _print_table(console, (rows, labels), title, cells, caption)


def _print_nees(console: Console, summary: Summary) -> None:
    cells = {
        "landmarks": _text("landmarks"),
        "n": _text("n_landmarks"),
        "NEES": _interval("nees_per_dof", ".3g"),
        "chi-square": lambda row: f"{row['band_low']:.2f}-{row['band_high']:.2f}",
        "in gate": _figure("share_in_gate", ".0%"),
    }
    title = "Landmark NEES per degree of freedom: 1 is consistent, more is too sure"
    caption = "chi-square: 95 % band of a consistent mean; in gate: of 95 %; (95 %, bootstrap)"
    _print_table(console, _shown(summary, "nees"), title, cells, caption)


def _print_caveats(console: Console, summary: Summary) -> None:
    lines = []
    if summary.n_runs == 1:
        lines.append(
            f"One run: the brackets tell of the {MAPS_OF_ONE_RUN}, which depend on each other, and "
            "nothing of other seeds."
        )
    elif summary.n_runs < FEW_RUNS:
        lines.append(
            f"{summary.n_runs} runs: bootstrap intervals of so few are too narrow; take {FEW_RUNS} "
            "seeds or more."
        )
    n_settings = summary.n_configurations
    if n_settings > _MAX_CONFIGURATIONS:
        lines.append(
            f"Shown are {_MAX_CONFIGURATIONS} of {n_settings} settings; `-o FOLDER` writes all."
        )
    for row in summary.failed.to_dict("records"):
        lines.append(f"failed, left out: {row['scenario']} seed {row['seed']}: {row['reason']}")
    if summary.missing:
        lines.append(f"No run has: {', '.join(summary.missing)}")
    for line in lines:
        console.print(line, soft_wrap=True, markup=False)


def print_comparison(found: VersionComparison, show_all: bool, written: Path | None) -> None:
    """What got better or worse, how sure that is, and what must be known beside it."""
    console = Console()
    counts = found.table["verdict"].value_counts()
    shown = found.table if show_all else found.table[found.table["verdict"].isin([BETTER, WORSE])]
    order = [WORSE, BETTER, UNKNOWN, NOISE, SAME]
    shown = shown.sort_values("verdict", key=lambda names: names.map(order.index), kind="stable")
    cells = {
        "method": _text("method"),
        "metric": _text("metric"),
        "first": lambda row: _value(row["a"], row["scale"]),
        "second": lambda row: _value(row["b"], row["scale"]),
        "change": _change,
        "verdict": _verdict,
    }
    caption = "change: factor, or difference; (95 %, Student's t); "
    caption += f"verdict: 5 % over {found.table['p'].notna().sum()} tests"
    title, words = "Second version against the first", ("metric", "verdict")
    _print_table(console, (shown, []), title, cells, caption, words)
    tally = ", ".join(
        f"{counts.get(verdict, 0)} {verdict}"
        for verdict in (WORSE, BETTER, NOISE, SAME, UNKNOWN)
        if verdict != UNKNOWN or counts.get(UNKNOWN, 0)
    )
    console.print(
        f"{_runs(found.n_runs)} compared in {len(found.table)} ways: {tally}", soft_wrap=True
    )
    for note in found.notes:
        console.print(f"  {note}", soft_wrap=True, markup=False)
    if written is not None:
        console.print(f"All rows (CSV, Markdown, LaTeX): {written}", soft_wrap=True)


def _value(value: float, scale: str) -> str:
    return f"{100 * value:.0f} %" if scale == "share" else _number(value, ".3g")


def _change(row: Row) -> str:
    if row["verdict"] == SAME:
        return ""
    value, low, high = row["change"], row["low"], row["high"]
    if row["scale"] == "share":
        return _bracketed(100 * value, 100 * low, 100 * high, "+.0f", " %")
    return _bracketed(value, low, high, ".2f" if row["scale"] == "ratio" else "+.2f")


def _verdict(row: Row) -> str:
    colour = _COLOURS.get(row["verdict"], "dim")
    return f"[{colour}]{_SHORT.get(row['verdict'], row['verdict'])}[/]"


def _bracketed(value: float, low: float, high: float, layout: str, unit: str = "") -> str:
    text = _number(value, layout) + (unit if not math.isnan(value) else "")
    if math.isnan(low) or math.isnan(high) or (math.isinf(low) and math.isinf(high)):
        return text
    to = " to " if layout.startswith("+") else "–"  # signs need room between them
    return f"{text} ({_number(low, layout)}{to}{_number(high, layout)})"


def _number(value: float, layout: str) -> str:
    if math.isnan(value):
        return "-"
    return "inf" if math.isinf(value) else format(value, layout)


def _runs(n: int) -> str:
    return "1 run" if n == 1 else f"{n} runs"
