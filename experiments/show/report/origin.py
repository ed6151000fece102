"""Where a report's numbers come from: runs, versions, stages and their times."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.study.statistics.run_tables import Runs, setting_columns
from mapfusion.errors import InputError

Rows = list[tuple[str, str]]
_LEAST_S = 1e-9  # no division by zero where all stages were reused
_SOURCE_DIGITS = 16


def natural(text: object) -> tuple[float, str]:
    """A sorting key that puts 50 before 200."""
    try:
        return float(str(text)), ""
    except ValueError:
        return math.inf, str(text)


def provenance_of(path: Path, runs: Runs) -> tuple[Rows, list[str]]:
    """Seeds, settings, versions, renderer and sources of the finished runs; all where they differ.

    Returns:
        Rows to show, and the keys of the stages of a single run.

    Raises:
        InputError: a description is damaged.
    """
    found: dict[str, dict[str, None]] = {}
    stages: list[str] = []
    for described in _of_sweep(path, runs) if runs.sweeps else _of_result(path):
        stages += described.pop("stages", {})
        for name, value in _flat(described):
            found.setdefault(name, {})[value] = None
    rows = [(name, sorted(values, key=natural)) for name, values in found.items()]
    return [(name, _range(texts) or ", ".join(texts)) for name, texts in rows], stages


def _range(texts: list[str]) -> str:
    """Whole numbers as `--seeds` takes them, if three or more are consecutive; else nothing."""
    if len(texts) < 3 or not all(text.isdigit() for text in texts):
        return ""
    first, last = int(texts[0]), int(texts[-1])
    return f"{first}..{last}" if last - first == len(texts) - 1 else ""


def _of_result(path: Path) -> Iterator[dict[str, Any]]:
    file = path / "provenance.json"
    if file.is_file():
        yield _json_object(file.read_text(encoding="utf-8", errors="replace"), str(file))


def _of_sweep(path: Path, runs: Runs) -> Iterator[dict[str, Any]]:
    if not runs.has("runs"):
        return
    rows = runs.read("runs", ["status", "renderer", "source_hash", "libraries"])
    for row in rows[rows["status"] == "finished"].to_dict("records"):
        yield {
            "seed": row["seed"],
            "settings": {name: row[name] for name in setting_columns(rows)},
            "renderer": row["renderer"],
            "source_hash": str(row["source_hash"])[:_SOURCE_DIGITS],
            "libraries": _json_object(str(row["libraries"]), str(path / "runs")),
        }


def _json_object(text: str, where: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise InputError(f"{where}: cannot be read as JSON ({error})") from error
    if not isinstance(found, dict):
        raise InputError(f"{where}: is no provenance, expected an object")
    return found


def _flat(described: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Names and values; those of a mapping (libraries, aligners) under their own names."""
    for name, value in described.items():
        if not isinstance(value, dict):
            yield name.replace("_", " "), str(value)
            continue
        for key, inner in value.items():
            texts = inner.values() if isinstance(inner, dict) else [inner]
            yield str(key), ", ".join(map(str, texts))


def stage_times(runs: Runs) -> list[dict[str, Any]]:
    """Seconds of work by stage, all its tasks together; a stage that runs share counts once."""
    if runs.has("timings"):
        rows = runs.read("timings", ["stage", "name", "elapsed_s"])
        parts = rows["name"].str.rpartition(":")
        rows = rows.assign(key=parts[0], figure=parts[2], seconds=rows["elapsed_s"])
    elif runs.has("run_times"):
        rows = runs.read("run_times", ["stage", "key", "figure", "seconds"])
    else:
        return []
    rows = rows[rows["figure"] == "elapsed_s"].drop_duplicates(["stage", "key"])
    sums = rows.groupby("stage", sort=False)["seconds"].agg(["sum", "count"])
    longest = max([*sums["sum"], _LEAST_S])
    return [
        {"stage": stage, "seconds": total, "tasks": int(count), "share": total / longest}
        for stage, total, count in sums.itertuples()
    ]
