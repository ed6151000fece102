"""What `mapfusion statistics` and `mapfusion compare` show."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.judge.metrics import MIN_TRUE_PAIRS, ORACLE
from experiments.show.terminal.layout import LAYOUT as TABLE_LAYOUT
from experiments.study.compare.versions import (
    BETTER,
    FEW_RUNS,
    NOISE,
    SAME,
    UNKNOWN,
    WORSE,
    Comparison,
)
from experiments.study.statistics.bootstrap import MAPS_OF_ONE_RUN
from experiments.study.statistics.summary import ALL_SCENARIOS, Summary

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


def _table(title: str, headings: Sequence[str], labels: Sequence[str]) -> Table:
    table = Table(title=title, **TABLE_LAYOUT)
    for label in labels:
        table.add_column(escape(label))
    for place, heading in enumerate(headings):
        table.add_column(heading, justify="right" if place else "left", no_wrap=True)
    return table


def _show(console: Console, table: Table, caption: str) -> None:
    """A table and what its columns mean; as a caption rich would break it at the table's width."""
    console.print(table)
    console.print(f"[dim]{escape(caption)}[/]\n", highlight=False)


def _cells(row: dict, labels: Sequence[str]) -> list[str]:
    return [escape(str(row[label])) for label in labels]


def _print_success(console: Console, summary: Summary) -> None:
    rows, labels = _shown(summary, "success_at_the_end")
    if rows.empty:
        return
    limits = summary.criteria
    reach = f"{limits.translation_m:g} m and {limits.rotation_rad:g} rad"
    caption = f"within {reach}, the reach of the refinement"
    apart = bool(rows["n_apart"].any())
    if apart:
        caption += f"; without the {_apart(rows)} that have no common ground"
    right = {"estimated_success": "as estimated", "refined_success": "refined"}
    title = f"Right at the end of {_runs(summary.n_runs)}, percent"
    _show(console, _shares(rows, labels, title, right), f"{caption}; (95 %, Wilson)")
    if "accepted" not in rows:
        return
    verdicts = {"accepted": "accepted", "false_accepted": "accepted\nthough wrong"}
    if apart:
        verdicts["accepted"] = "accepted where\nthere is common ground"
        verdicts["refused_apart"] = "refused where\nthere is none"
    table = _shares(rows, labels, "Verdicts at the end, percent", verdicts)
    _show(console, table, "though wrong: of all, whatever ground; (95 %, Wilson)")


def _shares(
    rows: pd.DataFrame, labels: Sequence[str], title: str, shares: Mapping[str, str]
) -> Table:
    """Methods down, shares across: columns of `rows` and their headings."""
    lines = max(heading.count("\n") for heading in shares.values())
    headings = ["method", *shares.values()]
    table = _table(title, ["\n" * (lines - h.count("\n")) + h for h in headings], labels)
    for row in rows.to_dict("records"):
        cells = [_share(row, name) for name in shares]
        table.add_row(*_cells(row, [*labels, "aligner"]), *cells)
    return table


def _apart(rows: pd.DataFrame) -> str:
    """How many pairs of maps have no common ground; all methods see the same maps."""
    n_apart, n_maps = rows[["n_apart", "n_maps"]].max()
    return f"{n_apart} of {n_maps} pairs of maps"


def _print_where_it_fails(console: Console, summary: Summary) -> None:
    """Success as estimated by the number of true pairs: methods down, bins across."""
    rows, labels = _shown(summary, "success_by_true_pairs")
    if rows.empty:
        return
    bins = rows[["from", "to"]].drop_duplicates().sort_values("from").to_dict("records")
    headings = [f"{b['from']:.0f}+" if math.isinf(b["to"]) else f"{b['from']:.0f}" for b in bins]
    table = _table("Right as estimated, percent of the maps", ["method", *headings], labels)
    for keys, own in rows.groupby([*labels, "aligner"], sort=False):
        shares = own.set_index("from")["estimated_success"]
        cells = [_number(100 * shares.get(b["from"], math.nan), ".0f") for b in bins]
        table.add_row(*(escape(str(key)) for key in keys), *cells)
    _show(
        console,
        table,
        "by the number of true pairs, from the one given up; intervals are in the files",
    )


def _print_oracle_ratios(console: Console, summary: Summary) -> None:
    rows, labels = _shown(summary, "error_over_oracle")
    if rows.empty:
        return
    table = _table(
        "Median translation error, and its ratio to the oracle's",
        ["\nmethod", "estim.\nm", "\nover the oracle", "refined\nm", "\nover the oracle"],
        labels,
    )
    for row in rows.to_dict("records"):
        cells = []
        for stage in ("estimated", "refined"):
            cells += [_number(row[f"{stage}_m"], ".3f"), _interval(row, f"{stage}_ratio")]
        table.add_row(*_cells(row, [*labels, "aligner"]), *cells)
    caption = f"maps with {MIN_TRUE_PAIRS}+ true pairs; inf: no estimate on most; (95 %, bootstrap)"
    _show(console, table, caption)


def _print_best_against_others(console: Console, summary: Summary) -> None:
    """The method with the smallest error as estimated, beside each other on the same maps."""
    rows, labels = _shown(summary, "methods_compared")
    if rows.empty:
        return
    ratios, _ = _shown(summary, "error_over_oracle")
    methods = ratios[ratios["aligner"] != ORACLE]
    best = str(methods.groupby("aligner")["estimated_m"].median().idxmin())
    table = _table(
        f"{best} against each other method on the same maps, as estimated",
        ["other", "its error over other's", "nearer, percent", "p (Holm)"],
        labels,
    )
    for row in rows[(rows["first"] == best) | (rows["second"] == best)].to_dict("records"):
        if row["second"] == best:
            row = _swapped(row)
        cells = [_interval(row, "ratio"), _share(row, "first_wins"), _number(row["p_holm"], ".2g")]
        table.add_row(*_cells(row, [*labels, "second"]), *cells)
    _show(console, table, "median ratio, and share of the maps; (95 %, bootstrap)")


def _swapped(row: dict) -> dict:
    """The same comparison with the methods in the other order."""
    swapped = row | {"first": row["second"], "second": row["first"]}
    for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
        ratio = row[f"ratio{other}"]
        swapped[f"ratio{end}"] = math.inf if ratio == 0 else 1 / ratio
        swapped[f"first_wins{end}"] = 1 - row[f"first_wins{other}"]
    return swapped


def _print_paths(console: Console, summary: Summary) -> None:
    rows, labels = _shown(summary, "paths")
    if rows.empty:
        return
    shown = rows["quantity"].isin(list(_PATH_NAMES)) & (rows["delta_unit"] != "frames")
    table = _table(
        "Path errors, median over robots and runs",
        ["path", "error", "RMSE", "median", "max"],
        labels,
    )
    for row in rows[shown].to_dict("records"):
        cells = [_PATH_NAMES[row["quantity"]], _interval(row, "rmse", ".3g")]
        cells += [_number(row["median"], ".3g"), _number(row["max"], ".3g")]
        table.add_row(*_cells(row, [*labels, "source"]), *cells)
    caption = "ATE: after the best rigid fit; RPE: relative, along a metre; (95 %, bootstrap)"
    _show(console, table, caption)


def _print_nees(console: Console, summary: Summary) -> None:
    rows, labels = _shown(summary, "nees")
    if rows.empty:
        return
    table = _table(
        "Landmark NEES per degree of freedom: 1 is consistent, more is too sure",
        ["landmarks", "n", "NEES", "chi-square", "in gate"],
        labels,
    )
    for row in rows.to_dict("records"):
        band = f"{row['band_low']:.2f}-{row['band_high']:.2f}"
        inside = _number(100 * row["share_in_gate"], ".0f")
        cells = [str(row["n_landmarks"]), _interval(row, "nees_per_dof", ".3g"), band]
        cells.append(inside if inside == "-" else f"{inside} %")
        table.add_row(*_cells(row, [*labels, "landmarks"]), *cells)
    caption = "chi-square: 95 % band of a consistent mean; in gate: of 95 %; (95 %, bootstrap)"
    _show(console, table, caption)


def _print_caveats(console: Console, summary: Summary) -> None:
    if summary.n_runs == 1:
        console.print(
            f"One run: the brackets tell of the {MAPS_OF_ONE_RUN}, which depend on each other, and "
            "nothing of other seeds.",
            soft_wrap=True,
        )
    elif summary.n_runs < FEW_RUNS:
        console.print(
            f"{summary.n_runs} runs: bootstrap intervals of so few are too narrow; take {FEW_RUNS} "
            "seeds or more.",
            soft_wrap=True,
        )
    n_settings = summary.n_configurations
    if n_settings > _MAX_CONFIGURATIONS:
        console.print(
            f"Shown are {_MAX_CONFIGURATIONS} of {n_settings} settings; `-o FOLDER` writes all.",
            soft_wrap=True,
        )
    for row in summary.failed.to_dict("records"):
        text = f"failed, left out: {row['scenario']} seed {row['seed']}: {row['reason']}"
        console.print(text, soft_wrap=True, markup=False)
    if summary.missing:
        console.print(f"No run has: {', '.join(summary.missing)}", soft_wrap=True)


def print_comparison(found: Comparison, show_all: bool, written: Path | None) -> None:
    """What got better or worse, how sure that is, and what must be known beside it."""
    console = Console()
    counts = found.table["verdict"].value_counts()
    shown = found.table if show_all else found.table[found.table["verdict"].isin([BETTER, WORSE])]
    if len(shown):
        _show(
            console,
            _comparison_table(shown),
            "change: factor, or difference; (95 %, bootstrap); "
            f"verdict: 5 % over {found.table['p'].notna().sum()} tests",
        )
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


def _comparison_table(shown: pd.DataFrame) -> Table:
    order = [WORSE, BETTER, UNKNOWN, NOISE, SAME]
    rows = shown.sort_values("verdict", key=lambda names: names.map(order.index), kind="stable")
    headings = ["method", "metric", "first", "second", "change", "verdict"]
    table = _table("Second version against the first", headings, [])
    for column in (table.columns[1], table.columns[-1]):
        column.justify = "left"
    table.columns[0].no_wrap, table.columns[1].no_wrap = True, False
    for row in rows.to_dict("records"):
        colour = _COLOURS.get(row["verdict"], "dim")
        table.add_row(
            escape(row["method"]),
            escape(row["metric"]),
            *(_value(row[side], row["scale"]) for side in "ab"),
            "" if row["verdict"] == SAME else _change(row),
            f"[{colour}]{_SHORT.get(row['verdict'], row['verdict'])}[/]",
        )
    return table


def _value(value: float, scale: str) -> str:
    return f"{100 * value:.0f} %" if scale == "share" else _number(value, ".3g")


def _change(row: dict) -> str:
    if row["scale"] == "ratio":
        return _interval(row, "change")
    if row["scale"] == "share":
        points = {name: 100 * row[name] for name in ("change", "low", "high")}
        return _bracketed(points["change"], points["low"], points["high"], "+.0f", " %")
    return _bracketed(row["change"], row["low"], row["high"], "+.2f")


def _interval(row: dict, name: str, layout: str = ".2f") -> str:
    """A number with its interval in brackets; columns NAME_low and NAME_high, or low and high."""
    low = row.get(f"{name}_low", row.get("low", math.nan))
    high = row.get(f"{name}_high", row.get("high", math.nan))
    return _bracketed(row[name], low, high, layout)


def _share(row: dict, name: str) -> str:
    values = (100 * row[name], 100 * row[f"{name}_low"], 100 * row[f"{name}_high"])
    return _bracketed(*values, ".0f")


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
