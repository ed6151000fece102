"""`mapfusion inspect`: find out what a path is, and show it."""

import math
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from experiments.show.inspect.folders import (
    Description,
    inspect_folder,
    inspect_json,
    inspect_scenario,
)
from experiments.show.inspect.parquet import Column, Table, inspect_table
from mapfusion.errors import InputError

_LAYOUT: Any = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_justify": "left"}
_MAX_CELL = 14  # characters of a value in the first rows


def inspect(path: Path) -> None:
    """Print what a file or folder holds.

    Raises:
        InputError: it is missing, damaged, or none of mapfusion's.
    """
    console = Console()
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.is_dir():
        _print_description(console, path, inspect_folder(path))
    elif path.suffix in {".yaml", ".yml"}:
        _print_description(console, path, inspect_scenario(path))
    elif path.suffix == ".json":
        _print_description(console, path, inspect_json(path))
    elif path.suffix == ".parquet":
        _print_table(console, path, inspect_table(path))
    else:
        raise InputError(
            f"{path}: no file of mapfusion's (known: .parquet tables, .yaml scenarios, .json)"
        )


def _headline(console: Console, path: Path, kind: str, version: str) -> None:
    shown = f", schema version {version}" if version else ""
    console.print(f"{path}: {kind}{shown}", soft_wrap=True, markup=False, highlight=False)


def _print_description(console: Console, path: Path, found: Description) -> None:
    _headline(console, path, found.kind, found.version)
    if found.facts:
        facts = Grid(show_header=False, **_LAYOUT)
        for name, value in found.facts:
            facts.add_row(escape(name), escape(value))
        console.print(facts)
    if found.parts:
        parts = Grid(**_LAYOUT)
        parts.add_column("holds")
        parts.add_column("")
        for name, value in found.parts:
            parts.add_row(escape(name), escape(value))
        console.print(parts)


def _print_table(console: Console, path: Path, found: Table) -> None:
    _headline(console, path, found.kind, found.version)
    size = f"{path.stat().st_size / 1e6:.2f} MB"
    attributes = "".join(f", {name} {value}" for name, value in found.attributes.items())
    line = f"{found.n_rows} rows, {len(found.columns)} columns, {size}{attributes}"
    console.print(line, soft_wrap=True, markup=False, highlight=False)
    if not found.known:
        console.print("A kind this program does not know; shown as it describes itself.")
    columns = Grid(**_LAYOUT)
    for heading in ("column", "type", "unit"):
        columns.add_column(heading, overflow="fold")
    for heading in ("least", "most", "missing"):
        columns.add_column(heading, justify="right", overflow="fold")
    for each in found.columns:
        columns.add_row(*(escape(text) for text in _cells(each)))
    console.print(columns)
    if found.first_rows:
        console.print(_first_rows(found, console.width))


def _cells(column: Column) -> tuple[str, ...]:
    missing = str(column.n_missing) if column.n_missing else ""
    return (column.name, column.type, column.unit, column.low, column.high, missing)


def _first_rows(found: Table, width: int) -> Grid:
    """As many columns of the first rows as the screen is wide; the rest is counted."""
    names, used = [], 0
    for column in found.columns:
        used += max(len(column.name), _MAX_CELL // 2) + 1
        if used > width and names:
            break
        names.append(column.name)
    more = len(found.columns) - len(names)
    title = "first rows" + (f", {more} columns more" if more else "")
    rows = Grid(title=title, title_style="none", **_LAYOUT)
    for name in names:
        rows.add_column(name, no_wrap=True)
    for row in found.first_rows:
        rows.add_row(*(escape(_cell(row[name])) for name in names))
    return rows


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list):
        return f"{len(value)} values"
    text = str(value)
    return text if len(text) <= _MAX_CELL else f"{text[: _MAX_CELL - 1]}…"
