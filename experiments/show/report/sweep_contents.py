"""What the report of a sweep shows: the same comparison over many runs, without maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge.criteria import ORACLE, that_ever_meet
from experiments.judge.judged_maps import RUN_KEYS, setting_columns
from experiments.show.report.comparison import compare, present, reduce_errors
from experiments.show.report.curves import error_curves
from experiments.study.statistics.error_bands import medians_of_run
from experiments.study.statistics.run_tables import Runs
from experiments.study.statistics.summary import ALL_SCENARIOS, configurations
from mapfusion.errors import InputError


def sweep_contents(path: Path, runs: Runs) -> dict[str, Any]:
    """As `contents_of`, of a sweep's folder; runs are read and reduced one by one."""
    reduced, medians, aligners = [], [], {}
    every: dict[str, None] = {}
    for whole in runs.each("errors") if runs.has("errors") else ():
        every |= dict.fromkeys(whole["aligner"])
        errors = present(whole)
        reduced.append(reduce_errors(errors))
        medians.append(medians_of_run(errors))
        aligners |= dict.fromkeys(errors["aligner"])
    names = [name for name in aligners if name != ORACLE] + [ORACLE] * (ORACLE in aligners)
    comparison = compare(runs, reduced, names)
    maps = comparison.maps
    described = maps[[*RUN_KEYS, *setting_columns(maps)]].drop_duplicates()
    return comparison.contents() | {
        "title": f"{path.name}, {len(described)} runs",
        "description": ", ".join(described["scenario"].unique()),
        "spread_text": "runs; each run is the median of its repetitions",
        "data": comparison.chart_data(_groups(pd.concat(medians, ignore_index=True), names)),
        "outcomes": [],
        "robots": [],
        "fits": [],
        "figures": [],
        "facts": _facts(described),
        "scenario_text": "",
        "provenance": _provenance(path, runs),
        "stages": [],
        "stage_times": _stage_times(runs),
        "missing": [],
        "colours": comparison.colours,
        "absent": [name for name in every if name not in aligners],
        "failed": runs.failed.to_dict("records"),
    }


def _groups(medians: pd.DataFrame, aligners: list[str]) -> list[dict[str, Any]]:
    """Error curves over the runs of each scenario and setting."""
    groups = []
    ordered = sorted(configurations(medians), key=lambda each: [*map(_natural, each[0].values())])
    for labels, rows in ordered:
        settings = [
            f"{name.rsplit('.', 1)[1]} {value}" for name, value in labels.items() if "." in name
        ]
        scenario = str(labels["scenario"])
        if scenario == ALL_SCENARIOS:
            n_before, rows = len(rows), that_ever_meet(rows)
            scenario = "(all)" if len(rows) == n_before else "(all with common ground)"
        label = ", ".join([scenario, *settings])
        groups.append({"label": label, "curves": error_curves(rows, aligners)})
    return groups


def _natural(text: object) -> tuple[float, str]:
    """A sorting key that puts 50 before 200."""
    try:
        return float(str(text)), ""
    except ValueError:
        return np.inf, str(text)


def _facts(described: pd.DataFrame) -> list[tuple[str, str]]:
    facts = [
        ("Runs", str(len(described))),
        ("Scenarios", ", ".join(described["scenario"].unique())),
        ("Seeds", _listed_seeds(described["seed"].to_numpy())),
    ]
    for name in setting_columns(described):
        facts.append((name, ", ".join(sorted(map(str, described[name].unique()), key=_natural))))
    return facts


def _listed_seeds(seeds: np.ndarray) -> str:
    """Seeds as `--seeds` takes them, where they follow one another."""
    found = sorted({int(seed) for seed in seeds})
    if len(found) > 2 and found == list(range(found[0], found[-1] + 1)):
        return f"{found[0]}..{found[-1]}"
    return ", ".join(str(seed) for seed in found)


def _provenance(path: Path, runs: Runs) -> list[tuple[str, str]]:
    """Renderers, versions and sources of the finished runs; more than one of a kind is shown."""
    if not runs.has("runs"):
        return []
    rows = runs.read("runs")
    rows = rows[rows["status"] == "finished"]
    found = []
    for name in ("renderer", "source_hash"):
        if name in rows:
            values = [str(value)[:16] for value in rows[name].unique()]
            found.append((name.replace("_", " "), ", ".join(values)))
    if "libraries" in rows:
        try:
            versions = [json.loads(text) for text in rows["libraries"].unique()]
        except ValueError as error:
            raise InputError(f"{path / 'runs'}: libraries are no JSON ({error})") from error
        for library in sorted({name for each in versions for name in each}):
            known = dict.fromkeys(str(each[library]) for each in versions if library in each)
            found.append((library, ", ".join(known)))
    return found


def _stage_times(runs: Runs) -> list[dict[str, Any]]:
    """Seconds of work by stage; a stage that several runs share counts once."""
    if not runs.has("run_times"):
        return []
    rows = runs.read("run_times", ["stage", "key", "figure", "seconds"])
    rows = rows[rows["figure"] == "elapsed_s"].drop_duplicates(["stage", "key"])
    sums = rows.groupby("stage", sort=False)["seconds"].agg(["sum", "count"])
    longest = max(float(sums["sum"].max()), 1e-9) if len(sums) else 1.0
    return [
        {"stage": stage, "seconds": total, "tasks": int(count), "share": total / longest}
        for stage, total, count in sums.itertuples()
    ]
