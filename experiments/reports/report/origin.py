"""Provenance of a report: runs, versions, stages and their times."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.evaluation import tables
from experiments.evaluation.result_files import read_provenance
from experiments.reports.figures.result_tables import json_object
from experiments.evaluation.alignment_summary import setting_columns
from experiments.studies.run_tables import Runs

_SOURCE_DIGITS = 16


def natural(text: object) -> tuple[float, str]:
    """Return a sorting key that puts 50 before 200."""
    try:
        return float(str(text)), ""
    except ValueError:
        return math.inf, str(text)


def provenance_of(path: Path, runs: Runs) -> tuple[dict[str, str], list[str]]:
    """Collect seeds, settings, versions, renderer and sources of the finished runs.

    Returns texts by name, which list all values if runs differ, and the stage keys of a single
    run. Raises InputError if a description is damaged.
    """
    found: dict[str, dict[str, None]] = {}
    stages: list[str] = []
    for described in _descriptions(path, runs):
        stages += described.pop("stages", {})
        for name, value in _flat(described):
            found.setdefault(name, {})[value] = None
    return {name: _joined(sorted(texts, key=natural)) for name, texts in found.items()}, stages


def _joined(texts: list[str]) -> str:
    """Write three or more consecutive whole numbers as `--seeds` takes them, others as a list."""
    if len(texts) > 2 and all(text.isdigit() for text in texts):
        first, last = int(texts[0]), int(texts[-1])
        if last - first == len(texts) - 1:
            return f"{first}..{last}"
    return ", ".join(texts)


def _descriptions(path: Path, runs: Runs) -> Iterator[dict[str, Any]]:
    """Yield the description of each finished run."""
    file = path / "provenance.json"
    if runs.has("runs"):
        rows = runs.read("runs", ["status", "renderer", "source_hash", "libraries"])
        for row in rows[rows["status"] == "finished"].to_dict("records"):
            yield {
                "seed": row["seed"],
                "settings": {name: row[name] for name in setting_columns(rows)},
                "renderer": row["renderer"],
                "source_hash": str(row["source_hash"])[:_SOURCE_DIGITS],
                "libraries": json_object(str(row["libraries"]), path / "runs"),
            }
    elif not runs.sweeps and file.is_file():
        listed = {"tables", "files"}
        yield {name: told for name, told in read_provenance(file).items() if name not in listed}


def _flat(described: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield names and values; those inside a mapping (libraries, aligners) have their own names."""
    for name, value in described.items():
        if isinstance(value, dict):
            for key, inner in value.items():
                texts = inner.values() if isinstance(inner, dict) else [inner]
                yield key, ", ".join(map(str, texts))
        else:
            yield name.replace("_", " "), str(value)


def stage_times(runs: Runs) -> list[dict[Any, Any]]:
    """Sum the seconds of work of each stage; a stage that several runs share counts once."""
    if runs.has("timings"):
        rows = runs.read("timings", ["stage", "name", "elapsed_s"])
    elif runs.has("run_times"):
        rows = runs.read("run_times", ["stage", "key", "figure", "seconds"])
        rows = rows.assign(name=rows["key"] + ":" + rows["figure"], elapsed_s=rows["seconds"])
    else:
        return []
    return tables.work_by_stage(rows).to_dict("records")
