"""Contents of a report of one or several runs, as values for the template."""

import base64
import io
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image
from ruamel.yaml import YAML

from experiments.evaluation import metrics
from experiments.evaluation.alignment_summary import methods_in, setting_columns
from experiments.evaluation.checks import Outcome
from experiments.evaluation.criteria import that_ever_meet
from experiments.evaluation.evaluated_run import lines_of
from experiments.evaluation.fused_map_errors import last_fused
from experiments.evaluation.path_errors import path_rms
from experiments.evaluation.result import require_result
from experiments.reports.figures.drawing import FIGURES, caption
from experiments.reports.figures.result_tables import Pair, ResultTables, of_pair, read_png
from experiments.reports.figures.style import aligner_styles
from experiments.reports.report.charts import (
    error_curves,
    error_figure,
    success_curves,
    success_figure,
    time_curves,
    time_figure,
)
from experiments.reports.report.map_view import MAP_TABLES, map_figure
from experiments.reports.report.origin import natural, provenance_of, stage_times
from experiments.reports.report.theme import chart_style
from experiments.reports.team_text import team_lines
from experiments.scenario.settings import Bound
from experiments.studies.method_comparison import recommend
from experiments.studies.run_tables import Runs, find_runs
from experiments.studies.statistics import ALL_SCENARIOS, configurations, reduced_errors
from mapfusion.errors import InputError

_BETWEEN = "a b"  # of rivals; the others lay a map onto itself
_PLACE = ["tx_m", "ty_m", "theta_rad", "n_support", "n_confirmed", "n_contradicted"]


def verdicts_and_places(data: ResultTables) -> Iterator[dict[str, Any]]:
    """Yield verdict, reason and places of every pair of robots, by the aligner that fuses maps.

    Places are the distinct motions that correspondences support, the best first.
    """
    estimates, rivals = data.rows("estimates"), data.rows("rivals")
    used = data.scenario["merge"]["aligner"]
    estimates = estimates[(estimates["aligner"] == used) & (estimates["repetition"] == 0)]
    for robot_a, robot_b in data.pairs:
        pair = (robot_a, robot_b)
        last = _last(of_pair(estimates, pair))
        if last.empty:
            continue
        answer = last.iloc[0]
        places = _last(of_pair(rivals, pair))
        places = places[places["of"] == _BETWEEN].sort_values("log10_false_alarms", kind="stable")
        yield {
            "robots": f"{robot_a} – {robot_b}",
            "verdict": str(answer["verdict"]).replace("_", " "),
            "probability": answer["probability"],
            "n_confirmed": answer["n_confirmed"],
            "n_contradicted": answer["n_contradicted"],
            "reason": answer["acceptance_reason"] or answer["refined_reason"] or answer["reason"],
            "places": places[_PLACE].to_dict("records"),
        }


def _last(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["iteration"] == rows["iteration"].max()]


# Figures that stand beside the table of fusers, and how they are to be read.
_OF_FUSERS = {
    "fig11_fusers": "Lower is better. A map can be right as such and still lie askew in its frame:"
    " the fit takes that away, so the two panels differ by it. A median (thin) far below the RMS"
    " tells of a few landmarks that are much worse than the others.",
    "fig12_coverage": "On the gray diagonal as many true points lie inside the ellipses as these"
    " say. Below it a map is too sure of itself, above it less sure than it may be.",
}
_TABLES = tuple(dict.fromkeys((*MAP_TABLES, *metrics.USED_TABLES, "timings")))


def contents_of(path: Path) -> dict[str, Any]:
    """Collect what the report of a result folder, or of a sweep, shows.

    `charts` holds the Plotly figures by the name of their place in the page; a figure without
    data is None.

    Raises:
        InputError: The path is neither, or a table is damaged.
    """
    runs = find_runs(path)
    if not runs.sweeps:
        require_result(path)
    if not runs.has("errors") or (reduced := reduced_errors(runs)).maps.empty:
        if runs.sweeps or not (data := ResultTables(path)).no_truth:
            raise InputError(f"{path}: no pair of maps was aligned, there is nothing to report on")
        return _without_truth(path, runs, data)
    maps = reduced.maps
    if runs.sweeps:
        own, groups = _of_sweep(path, maps), _by_configuration(reduced.medians)
    else:
        data = ResultTables(path)
        own, groups = _of_result(data), _by_robots(runs.read("errors"), data.pairs)
    aligners = methods_in(maps, oracle=True)
    drawn_in = aligner_styles(aligners)
    styles = {name: chart_style(drawn_in[name]) for name in aligners}
    timings = runs.read("aligner_timings") if runs.has("aligner_timings") else pd.DataFrame()
    provenance, stages = provenance_of(path, runs)
    return own | {
        "no_truth": False,
        "ranking": recommend(maps, timings, aligners),
        "n_robot_pairs": len(maps[["scenario", "robot_a", "robot_b"]].drop_duplicates()),
        "settings": setting_columns(maps),
        "styles": styles,
        "charts": own["charts"]
        | {
            "errors": error_figure([(n, error_curves(r, aligners)) for n, r in groups], styles),
            "success": success_figure(success_curves(maps, aligners), styles),
            "times": time_figure(time_curves(timings, aligners) if len(timings) else {}, styles),
        },
        "absent": reduced.absent,
        "provenance": provenance,
        "stages": stages,
        "stage_times": stage_times(runs),
        "failed": runs.failed.to_dict("records"),
    }


def _without_truth(path: Path, runs: Runs, data: ResultTables) -> dict[str, Any]:
    """Collect what a result without truth shows: all but errors and success."""
    styles = {name: chart_style(style) for name, style in data.styles.items()}
    times = time_curves(runs.read("aligner_timings"), data.aligners)
    provenance, stages = provenance_of(path, runs)
    own = _of_result(data)
    return own | {
        "no_truth": True,
        "outcomes": (),
        "ranking": None,
        "styles": styles,
        "charts": own["charts"]
        | {"errors": None, "success": None, "times": time_figure(times, styles)},
        "absent": [name for name, label in data.labels.items() if label != name],
        "provenance": provenance,
        "stages": stages,
        "stage_times": stage_times(runs),
        "failed": [],
    }


def _of_sweep(path: Path, maps: pd.DataFrame) -> dict[str, Any]:
    """Return the title of a sweep; the sections of single results are empty."""
    none = ("outcomes", "robots", "fits", "smoother", "team", "edges", "figures", "missing")
    none += ("scenario_text", "fusers", "fuser_figures", "places", "findings")
    return dict.fromkeys(none, ()) | {
        "title": f"{path.name}, {maps['run_id'].nunique()} runs",
        "description": ", ".join(maps["scenario"].unique()),
        "spread_text": "runs; each run is the median of its repetitions",
        "charts": {"map": None},
    }


def _by_configuration(spread: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the runs of each scenario and setting with a label."""
    ordered = sorted(configurations(spread), key=lambda each: [*map(natural, each[0].values())])
    for labels, rows in ordered:
        scenario = labels.pop("scenario")
        if scenario == ALL_SCENARIOS:
            n_before, rows = len(rows), that_ever_meet(rows)
            scenario = "(all)" if len(rows) == n_before else "(all with common ground)"
        settings = [f"{name.rpartition('.')[2]} {value}" for name, value in labels.items()]
        yield ", ".join([scenario, *settings]), rows


def _of_result(data: ResultTables) -> dict[str, Any]:
    """Return the title and the sections of a result; a section without its tables is empty."""
    return {
        "title": f"{data.scenario['name']}, seed {data.scenario['seed']}",
        "description": data.scenario.get("description", ""),
        "spread_text": "repetitions on the same maps",
        "charts": {"map": map_figure(data, {n: chart_style(s) for n, s in data.styles.items()})},
        "outcomes": list(_outcomes(data)),
        "findings": list(lines_of(data.rows("findings"))),
        "robots": path_rms(data.table("robots")).to_dict("records"),
        "fits": data.rows("map_fits").to_dict("records"),
        "smoother": data.rows("smoother").to_dict("records"),
        "team": list(team_lines(*map(data.rows, ("fused_motions", "team", "team_pairs")))),
        "edges": data.rows("team_pairs").to_dict("records"),
        "places": list(verdicts_and_places(data)),
        "fusers": last_fused(data.rows("fusers")).to_dict("records"),
        "fuser_figures": list(_pictures(data.folder, _OF_FUSERS)),
        "figures": list(_pictures(data.folder, [n for n in FIGURES if n not in _OF_FUSERS])),
        "scenario_text": _as_yaml(data.scenario),
        "missing": [name for name in _TABLES if not data.has(name)],
    }


def _by_robots(errors: pd.DataFrame, pairs: list[Pair]) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the errors of each pair of robots, then of all pairs, with a label."""
    for a, b in pairs:
        yield f"{a} – {b}", of_pair(errors, (a, b))
    if len(pairs) > 1:
        yield "all pairs", errors


def _outcomes(data: ResultTables) -> Iterator[Outcome]:
    """Compare this run alone with the scenario's expectations."""
    needed = set(metrics.USED_TABLES) - {"smoother", "fusers"}  # which older results lack
    if all(map(data.has, needed)):
        used = {name: data.rows(name).assign(seed=0) for name in metrics.USED_TABLES}
        for metric, bound in data.scenario.get("expect", {}).items():
            value, limits = metrics.compute(metric, used), Bound.model_validate(bound)
            yield Outcome(data.scenario["name"], metric, value, limits, {0: value})


def _pictures(folder: Path, names: Collection[str]) -> Iterator[dict[str, Any]]:
    """Yield the figures that are drawn; a reference folder keeps them beside its tables."""
    for name in names:
        files = (folder / "figures" / f"{name}.png", folder / f"{name}.png")
        if file := next(filter(Path.is_file, files), None):
            data = read_png(file)
            with Image.open(io.BytesIO(data)) as picture:  # so that the page does not jump
                size = dict(zip(("width", "height"), picture.size, strict=True))
            png = base64.b64encode(data).decode()
            how = _OF_FUSERS.get(name, "")
            yield {"about": caption(name), "how": how, "png": png, **size}


def _as_yaml(scenario: dict[str, Any]) -> str:
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 100
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(scenario, stream)
    return stream.getvalue()
