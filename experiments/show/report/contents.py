"""All that a report shows of one result, as values for the template; nothing is drawn here."""

import base64
import io
import json
import math
from pathlib import Path
from typing import Any

import pandas as pd
from ruamel.yaml import YAML

from experiments.judge import metrics, tables
from experiments.judge.expectations import Outcome
from experiments.judge.result import require_result
from experiments.scenario.settings import Bound
from experiments.show.figures.drawing import FIGURES
from experiments.show.figures.result_tables import ResultTables, of_pair
from experiments.show.figures.style import robot_colours
from experiments.show.report.comparison import compare, present, reduce_errors
from experiments.show.report.curves import error_curves
from experiments.show.report.map_view import map_view
from experiments.show.report.sweep_contents import sweep_contents
from experiments.show.report.theme import css_name
from experiments.study.statistics.run_tables import Runs, find_runs
from mapfusion.errors import InputError

_CAPTIONS = {
    "fig01_tracks": "Tracked Harris points over consecutive frames.",
    "fig02_two_maps": "Two robots' maps with path, particles and ellipses, each in its own frame.",
    "fig03_dispersion": "Dispersion of the particles along the paths, tight and wide moments.",
    "fig04_translation_error": "Translation error against the iteration.",
    "fig05_rotation_error": "Rotation error against the iteration, signed.",
    "fig06_aligner_time": "Time of an alignment against the number of overlapping points.",
    "fig07_correspondences": "Two maps in 3-D with the correspondences between them.",
    "fig08_fused_landmark": "One landmark: two ellipses and the fused one.",
    "fig09_aligned_maps": "Aligned correspondences with the ellipses of both maps and the fused.",
    "fig10_fused_map": "The fused map in plan.",
}


class _Result:
    """One result folder; tables that it does not hold are None, and named among the missing."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.data = ResultTables(folder)
        self.missing: list[str] = []

    def table(self, name: str) -> pd.DataFrame | None:
        if not tables.table_path(self.folder, name).is_file():
            if name not in self.missing:
                self.missing.append(name)
            return None
        return self.data.table(name)


def contents_of(path: Path) -> dict[str, Any]:
    """What the report of a result folder, or of a sweep, shows.

    Raises:
        InputError: neither, or a table is damaged.
    """
    runs = find_runs(path)
    contents = sweep_contents(path, runs) if runs.sweeps else _result_contents(path, runs)
    return contents | {"sections": _sections(contents)}


def _result_contents(path: Path, runs: Runs) -> dict[str, Any]:
    require_result(path)
    result = _Result(path)
    data, scenario = result.data, result.data.scenario
    errors = present(runs.read("errors"))
    reduced = [reduce_errors(errors)] if len(errors) else []
    there = set(errors["aligner"])
    comparison = compare(runs, reduced, [name for name in data.aligners if name in there])
    rows, stages = _provenance(path)
    colours = robot_colours(data.robots)
    charts = comparison.chart_data(_groups(errors, data, comparison.aligners)) | {
        "robot_colours": {robot: css_name(colour) for robot, colour in colours.items()},
        "map": map_view(data, result.table),
    }
    return comparison.contents() | {
        "title": f"{scenario['name']}, seed {scenario['seed']}",
        "description": scenario.get("description", ""),
        "spread_text": "repetitions on the same maps",
        "data": charts,
        "outcomes": _outcomes(result),
        "robots": _robots(result),
        "fits": _records(result.table("map_fits")),
        "figures": _figures(path),
        "facts": _facts(scenario, data),
        "scenario_text": _as_yaml(scenario),
        "provenance": rows,
        "stages": stages,
        "stage_times": _stage_times(result.table("timings")),
        "missing": result.missing,
        "failed": [],
        "absent": [name for name in data.aligners if name not in there],
        "colours": [*comparison.colours, *colours.values()],
    }


def _groups(errors: pd.DataFrame, data: ResultTables, aligners: list[str]) -> list[dict[str, Any]]:
    """Error curves of each robot pair, and of all together."""
    groups = [
        {"label": f"{a} – {b}", "curves": error_curves(of_pair(errors, (a, b)), aligners)}
        for a, b in data.pairs
    ]
    if len(groups) > 1:
        groups.append({"label": "all pairs", "curves": error_curves(errors, aligners)})
    return groups


def _sections(contents: dict[str, Any]) -> list[tuple[str, str]]:
    """(id, name) of the sections that this report has."""
    every = (
        ("verdict", "Verdict", True),
        ("errors", "Errors", True),
        ("map", "Maps", contents["data"]["map"]),
        ("success", "Success", True),
        ("times", "Time", True),
        ("robots", "Robots", contents["robots"] or contents["fits"]),
        ("checks", "Checks", contents["outcomes"]),
        ("figures", "Figures", contents["figures"]),
        ("scenario", "Scenario", True),
    )
    return [(name, label) for name, label, there in every if there]


def _records(rows: pd.DataFrame | None) -> list[dict[Any, Any]]:
    return [] if rows is None else rows.to_dict("records")


def _outcomes(result: _Result) -> list[Outcome]:
    """The scenario's expectations, measured on this run alone."""
    expect = result.data.scenario.get("expect", {})
    found = {name: result.table(name) for name in metrics.USED_TABLES}
    used = {n: t.assign(seed=0) for n, t in found.items() if t is not None}
    if len(used) < len(found):
        return []
    name = result.data.scenario["name"]
    outcomes = []
    for metric, bound in expect.items():
        value = metrics.compute(metric, used)
        outcomes.append(Outcome(name, metric, value, Bound.model_validate(bound), {0: value}))
    return outcomes


def _robots(result: _Result) -> list[dict[str, Any]]:
    rows = result.table("robots")
    if rows is None:
        return []
    found = []
    for robot in result.data.robots:
        own = rows[rows["robot"] == robot]
        path, odometry = (
            float((own[f"{source}_error_m"] ** 2).mean() ** 0.5) for source in ("path", "odometry")
        )
        found.append(
            {
                "robot": robot,
                "path_m": path,
                "odometry_m": odometry,
                "ratio": path / odometry if odometry else math.nan,
                "n_landmarks": int(own["n_landmarks"].iloc[-1]),
                "frames": len(own),
            }
        )
    return found


def _figures(path: Path) -> list[dict[str, str]]:
    """The drawn pictures, as data URIs; a reference folder keeps them beside its tables."""
    figures = []
    for name in FIGURES:
        for file in (path / "figures" / f"{name}.png", path / f"{name}.png"):
            if file.is_file():
                text = base64.b64encode(file.read_bytes()).decode("ascii")
                number = int(name[3:5])
                figures.append(
                    {
                        "name": name,
                        "title": f"Figure {number}",
                        "caption": _CAPTIONS.get(name, ""),
                        "uri": f"data:image/png;base64,{text}",
                        **_picture_size(file),
                    }
                )
                break
    return figures


def _picture_size(file: Path) -> dict[str, Any]:
    """Width and height from the PNG's header, so that the page does not jump as pictures load."""
    header = file.read_bytes()[:24]
    return {
        "width": int.from_bytes(header[16:20], "big"),
        "height": int.from_bytes(header[20:24], "big"),
    }


def _facts(scenario: dict[str, Any], data: ResultTables) -> list[tuple[str, str]]:
    """What one wants to know of a scenario at a glance."""
    camera, drive = scenario.get("camera") or {}, scenario.get("drive") or {}
    slam = (scenario.get("slam") or {}).get("filter") or {}
    align, evaluate = scenario.get("align") or {}, scenario.get("evaluate") or {}
    facts = [
        ("Robots", ", ".join(data.robots)),
        ("Frames a robot", drive.get("frames")),
        ("Recorded logs", len(scenario.get("logs") or []) or None),
        ("Camera", _times(camera.get("width_px"), camera.get("height_px"), "px")),
        ("Particles", slam.get("n_particles")),
        ("Proposal", slam.get("proposal")),
        ("Repetitions of randomised aligners", align.get("repetitions")),
        ("Evaluated every", _unit(evaluate.get("every"), "iterations")),
        ("True pairs lie within", _unit(evaluate.get("true_pair_radius_m"), "m")),
        ("Merged with", (scenario.get("merge") or {}).get("aligner")),
        ("Tags", ", ".join(scenario.get("tags") or []) or None),
    ]
    simulated = bool(drive)
    return [
        (name, str(value))
        for name, value in facts
        if value is not None and (simulated or name != "Camera")
    ]


def _unit(value: Any, unit: str) -> str | None:
    return None if value is None else f"{value} {unit}"


def _times(first: Any, second: Any, unit: str) -> str | None:
    return None if first is None or second is None else f"{first} × {second} {unit}"


def _as_yaml(scenario: dict[str, Any]) -> str:
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 100
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(scenario, stream)
    return stream.getvalue()


def _provenance(path: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Rows to show, and the keys of the stages."""
    file = path / "provenance.json"
    if not file.is_file():
        return [], []
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as JSON ({error})") from error
    if not isinstance(found, dict):
        raise InputError(f"{file}: is no provenance, expected an object")
    rows = []
    for name, value in found.items():
        if name == "libraries":
            rows += [(str(library), str(version)) for library, version in value.items()]
        elif name != "stages":
            rows.append((name.replace("_", " "), str(value)))
    return rows, [str(key) for key in found.get("stages", {})]


def _stage_times(rows: pd.DataFrame | None) -> list[dict[str, Any]]:
    """Seconds by stage, all its tasks together; rendering is part of the features."""
    if rows is None or rows.empty:
        return []
    elapsed = rows[rows["name"].str.endswith(":elapsed_s")]
    sums = elapsed.groupby("stage", sort=False)["elapsed_s"].agg(["sum", "count"])
    longest = max(float(sums["sum"].max()), 1e-9)
    return [
        {"stage": stage, "seconds": total, "tasks": int(count), "share": total / longest}
        for stage, total, count in sums.itertuples()
    ]
