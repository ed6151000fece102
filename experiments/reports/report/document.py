"""Report of one or several runs as one HTML file that needs nothing else."""

import base64
import hashlib
import io
import json
import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from PIL import Image
from ruamel.yaml import YAML

from experiments.evaluation import alignment_criteria, metrics, tables
from experiments.evaluation.alignment_criteria import (
    methods_in,
    path_rms,
    setting_columns,
    with_common_ground_at_any_time,
)
from experiments.evaluation.evaluated_run import finding_row_lines
from experiments.evaluation.map_consistency import GROSS_M
from experiments.evaluation.map_errors import last_fused
from experiments.evaluation.metrics import Outcome
from experiments.evaluation.result import require_result
from experiments.evaluation.tables import read_provenance
from experiments.reports import layout
from experiments.reports.export import write_text
from experiments.reports.figures.drawing import FIGURES, caption
from experiments.reports.figures.result_tables import (
    ResultTables,
    of_pair,
    parse_json_object,
    read_png,
)
from experiments.reports.figures.style import aligner_styles
from experiments.reports.report.charts import (
    NEUTRAL,
    chart_style,
    chart_template,
    css_name,
    error_curves,
    error_figure,
    palette,
    success_curves,
    success_figure,
    time_curves,
    time_figure,
)
from experiments.reports.report.map_view import MAP_TABLES, map_figure
from experiments.reports.run_screen import adoption_lines, images_by, team_lines
from experiments.scenario.settings import Bound
from experiments.studies.comparison import (
    BETTER,
    WORSE,
    compare_values,
    natural_key,
    values_by_setting,
)
from experiments.studies.intervals import FEW_RUNS
from experiments.studies.method_comparison import recommend
from experiments.studies.paper_claims import SCENARIOS, claims_table, compare_with_paper
from experiments.studies.run_tables import Runs, find_runs
from experiments.studies.statistics import ALL_SCENARIOS, BAND, configurations, reduced_errors
from mapfusion.errors import InputError, install_command
from mapfusion.plotting import ROBOT_COLOURS

_SOURCE_DIGITS = 16


def _provenance(path: Path, runs: Runs) -> tuple[dict[str, str], list[str]]:
    """Collect seeds, settings, versions, renderer and sources of the finished runs.

    Returns:
        Texts by name, which list all values if runs differ; the stage keys of a single run.

    Raises:
        InputError: a description is damaged.
    """
    described: list[dict[str, Any]] = []
    file = path / "provenance.json"
    if runs.has("runs"):
        rows = runs.read("runs", ["status", "renderer", "source_hash", "libraries"])
        described += [
            {
                "seed": row["seed"],
                "settings": {name: row[name] for name in setting_columns(rows)},
                "renderer": row["renderer"],
                "source_hash": str(row["source_hash"])[:_SOURCE_DIGITS],
                "libraries": parse_json_object(str(row["libraries"]), path / "runs"),
            }
            for row in rows[rows["status"] == "finished"].to_dict("records")
        ]
    elif not runs.sweeps and file.is_file():
        omitted = {"tables", "files"}
        found = read_provenance(file).items()
        described.append({name: value for name, value in found if name not in omitted})
    # Different values by name; entries of a mapping (libraries, aligners) have their own names.
    values: dict[str, dict[str, None]] = {}
    stages: list[str] = []
    for run in described:
        stages += run.pop("stages", {})
        for name, value in run.items():
            entries = value if isinstance(value, dict) else {name.replace("_", " "): value}
            for key, entry in entries.items():
                texts = entry.values() if isinstance(entry, dict) else [entry]
                values.setdefault(key, {})[", ".join(map(str, texts))] = None
    # Three or more consecutive whole numbers are written as `--seeds` takes them.
    shown: dict[str, str] = {}
    for name, different in values.items():
        texts = sorted(different, key=natural_key)
        shown[name] = ", ".join(texts)
        if len(texts) > 2 and all(text.isdigit() for text in texts):
            first, last = int(texts[0]), int(texts[-1])
            if last - first == len(texts) - 1:
                shown[name] = f"{first}..{last}"
    return shown, stages


def _stage_times(runs: Runs) -> list[dict[Any, Any]]:
    """Sum the seconds of work of each stage; a stage that several runs share counts once."""
    if runs.has("timings"):
        rows = runs.read("timings", ["stage", "name", "elapsed_s"])
    elif runs.has("run_times"):
        rows = runs.read("run_times", ["stage", "key", "figure", "seconds"])
        rows = rows.assign(name=rows["key"] + ":" + rows["figure"], elapsed_s=rows["seconds"])
    else:
        return []
    return tables.work_by_stage(rows).to_dict("records")


_BETWEEN = "a b"  # rivals between two maps; the others align a map with itself
_PLACE = ["tx_m", "ty_m", "theta_rad", "n_support", "n_confirmed", "n_contradicted"]


def verdicts_and_places(data: ResultTables) -> Iterator[dict[str, Any]]:
    """Yield verdict, reason and rival alignments of every pair of robots, for the fused maps.

    Rival alignments are distinct motions that correspondences support, the best first.
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
            "n_confirmed": answer["n_confirmed"],
            "n_contradicted": answer["n_contradicted"],
            "reason": answer["acceptance_reason"] or answer["refined_reason"] or answer["reason"],
            "places": places[_PLACE].to_dict("records"),
        }


def _last(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["iteration"] == rows["iteration"].max()]


# Figures beside the table of fusers, with an explanation.
_OF_FUSERS = {
    "fig11_fusers": "Lower is better. A map with small errors can still be misplaced in its frame."
    " The rigid fit removes this part of the error, so the two panels differ by it. A median (thin)"
    " far below the RMS indicates a few landmarks with much larger errors.",
    "fig12_coverage": "On the gray diagonal the covariances are consistent. Below the diagonal a"
    " map is overconfident, above the diagonal its covariances are too large.",
}
# Likewise beside the table of robots that exchange maps.
_OF_TEAMS = {
    "fig13_team": "Lower is better; errors of the whole path so far. The smoother knows all"
    " observations of a robot's own log. The independent robot and the robot in the joint map are"
    " filters. Green lines are adoptions.",
}
_EXPLAINED = _OF_FUSERS | _OF_TEAMS
_TABLES = tuple(dict.fromkeys((*MAP_TABLES, *metrics.USED_TABLES, "timings")))


def contents_of(path: Path) -> dict[str, Any]:
    """Collect the values that the report of a result folder or of a sweep shows.

    `charts` holds the Plotly figures by the name of their place in the page; a figure without
    data is None.

    Raises:
        InputError: the path is neither, or a table is damaged.
    """
    runs = find_runs(path)
    if not runs.sweeps:
        require_result(path)
    reduced = reduced_errors(runs) if runs.has("errors") else None
    has_errors = reduced is not None and not reduced.maps.empty
    data = None if runs.sweeps else ResultTables(path)
    if not has_errors and (data is None or not data.no_truth):
        raise InputError(f"{path}: no pair of maps was aligned, there is nothing to report on")
    provenance, stages = _provenance(path, runs)
    timings = runs.read("aligner_timings") if runs.has("aligner_timings") else pd.DataFrame()
    common = {
        "provenance": provenance,
        "stages": stages,
        "stage_times": _stage_times(runs),
        "failed": runs.failed.to_dict("records"),
    }
    if data is not None and not has_errors:
        # Without truth there are no errors and no success.
        own, styles = _of_result(data), _page_styles(data.aligners)
        times = time_curves(timings, data.aligners) if len(timings) else {}
        charts = {"errors": None, "success": None, "times": time_figure(times, styles)}
        absent = [name for name, label in data.labels.items() if label != name]
        own |= {"charts": own["charts"] | charts, "absent": absent, "outcomes": ()}
        shown = {"no_truth": True, "ranking": None, "styles": styles, "claims": ()}
        return own | common | shown
    assert reduced is not None
    maps = reduced.maps
    if data is None:
        # The sections of single results are empty.
        empty = ("outcomes", "robots", "fits", "smoother", "team", "edges", "figures", "missing")
        empty += ("scenario_text", "fusers", "fuser_figures", "places", "findings")
        empty += ("members", "adoptions", "member_figures")
        own: dict[str, Any] = dict.fromkeys(empty, ()) | {
            "title": f"{path.name}, {maps['run_id'].nunique()} runs",
            "description": ", ".join(maps["scenario"].unique()),
            "spread_text": "runs; each run is the median of its repetitions",
            "charts": {"map": None},
            "compared": list(_compared_settings(path, runs)),
        }
        groups = list(_by_configuration(reduced.medians))
    else:
        own, errors = _of_result(data), runs.read("errors")
        groups = [(f"{a} – {b}", of_pair(errors, (a, b))) for a, b in data.pairs]
        if len(data.pairs) > 1:
            groups.append(("all pairs", errors))
    aligners = methods_in(maps, oracle=True)
    styles = _page_styles(aligners)
    times = time_curves(timings, aligners) if len(timings) else {}
    charts = {
        "errors": error_figure([(n, error_curves(r, aligners)) for n, r in groups], styles),
        "success": success_figure(success_curves(maps, aligners), styles),
        "times": time_figure(times, styles),
    }
    own |= {"charts": own["charts"] | charts, "absent": reduced.absent}
    # The table of the paper's claims, for runs of the paper's experiment.
    is_paper = bool(set(SCENARIOS) & set(runs.described["scenario"]))
    claims = claims_table(compare_with_paper([runs])) if is_paper else pd.DataFrame()
    return (
        own
        | common
        | {
            "no_truth": False,
            "ranking": recommend(maps, timings, aligners),
            "n_robot_pairs": len(maps[["scenario", "robot_a", "robot_b"]].drop_duplicates()),
            "settings": setting_columns(maps),
            "styles": styles,
            "claims": claims.to_dict("records"),
        }
    )


def _page_styles(aligners: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the styles of aligners in the page's and Plotly's terms."""
    styles = aligner_styles(aligners)
    return {name: chart_style(styles[name]) for name in aligners}


def _by_configuration(spread: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the runs of each scenario and setting with a label."""
    ordered = sorted(configurations(spread), key=lambda each: [*map(natural_key, each[0].values())])
    for labels, rows in ordered:
        scenario = labels.pop("scenario")
        if scenario == ALL_SCENARIOS:
            n_before, rows = len(rows), with_common_ground_at_any_time(rows)
            scenario = "(all)" if len(rows) == n_before else "(all with common ground)"
        settings = [f"{name.rpartition('.')[2]} {value}" for name, value in labels.items()]
        yield ", ".join([scenario, *settings]), rows


# Comparisons of values in the report of a sweep: each reads all tables once.
_MOST_COMPARED = 8


def _compared_settings(path: Path, runs: Runs) -> Iterator[dict[str, Any]]:
    """Yield for each setting that a sweep varied what a value changes against the first one."""
    pairs = [
        (setting, first, other)
        for setting, (first, *others) in values_by_setting(runs).items()
        for other in others
    ]
    for setting, first, other in pairs[:_MOST_COMPARED]:
        try:
            found = compare_values(path, setting, first, other)
        except InputError:  # no run with the one value matches a run with the other
            continue
        judged = found.table[~found.table["timed"]]
        changed = judged[judged["verdict"].isin([BETTER, WORSE])].sort_values("p_holm")
        counts = changed["verdict"].value_counts()
        yield {
            "setting": setting,
            "first": first,
            "other": other,
            "n_runs": found.n_runs,
            "unit": found.unit,
            "n_better": int(counts.get(BETTER, 0)),
            "n_worse": int(counts.get(WORSE, 0)),
            "n_measures": len(judged),
            "weak": found.n_runs < FEW_RUNS,
            "changed": changed.to_dict("records"),
        }


def _of_result(data: ResultTables) -> dict[str, Any]:
    """Return the title and the sections of a result; a section without its tables is empty."""
    outcomes: list[Outcome] = []  # of this run alone
    # older results lack some tables
    needed = set(metrics.USED_TABLES) - {"smoother", "fusers", "sightings"}
    needed -= {"adoptions", "team_members"}
    if all(map(data.has, needed)):
        used = {name: data.rows(name).assign(seed=0) for name in metrics.USED_TABLES}
        for metric, bound in data.scenario.get("expect", {}).items():
            value, limits = metrics.compute(metric, used), Bound.model_validate(bound)
            outcomes.append(Outcome(data.scenario["name"], metric, value, limits, {0: value}))
    scenario_text = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 100
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(data.scenario, scenario_text)
    return {
        "title": f"{data.scenario['name']}, seed {data.scenario['seed']}",
        "description": data.scenario.get("description", ""),
        "compared": (),
        "spread_text": "repetitions on the same maps",
        "charts": {"map": map_figure(data, _page_styles(data.aligners))},
        "outcomes": outcomes,
        "findings": list(finding_row_lines(data.rows("findings"))),
        "robots": path_rms(data.table("robots")).to_dict("records"),
        "fits": data.rows("map_fits").to_dict("records"),
        "smoother": data.rows("smoother").to_dict("records"),
        "team": list(team_lines(*map(data.rows, ("fused_motions", "team", "team_pairs")))),
        "edges": data.rows("team_pairs").to_dict("records"),
        "places": list(verdicts_and_places(data)),
        "fusers": last_fused(data.rows("fusers")).to_dict("records"),
        "fuser_figures": list(_pictures(data.folder, _OF_FUSERS)),
        "members": _last(data.rows("team_members")).to_dict("records"),
        "adoptions": list(adoption_lines(data.rows("adoptions"), data.rows("messages"))),
        "member_figures": list(_pictures(data.folder, _OF_TEAMS)),
        "figures": list(_pictures(data.folder, [n for n in FIGURES if n not in _EXPLAINED])),
        "scenario_text": scenario_text.getvalue(),
        "missing": [name for name in _TABLES if not data.has(name)],
    }


def _pictures(folder: Path, names: Collection[str]) -> Iterator[dict[str, Any]]:
    """Yield the figures that exist; a reference folder keeps them beside its tables."""
    for name in names:
        files = (folder / "figures" / f"{name}.png", folder / f"{name}.png")
        if file := next(filter(Path.is_file, files), None):
            data = read_png(file)
            with Image.open(io.BytesIO(data)) as picture:  # keeps the layout while loading
                size = dict(zip(("width", "height"), picture.size, strict=True))
            png = base64.b64encode(data).decode()
            how = _EXPLAINED.get(name, "")
            yield {"about": caption(name, file.parent), "how": how, "png": png, **size}


_PAGE = Path(__file__).parent / "page"


def write_report(path: Path, output: Path | None = None) -> Path:
    """Write the report of a folder of `run` or `sweep`, and return the file.

    The file is `report.html` in the folder by default. The policy in the page lets it fetch nothing
    and run only its own scripts. Raises InputError as `contents_of` does.
    """
    contents = contents_of(path)
    colours = [style["hex"] for style in contents["styles"].values()] + [*ROBOT_COLOURS, NEUTRAL]
    target = path / "report.html" if output is None else output
    write_page(target, "report.html.j2", contents | {"band": BAND}, colours)
    return target


def write_page(
    target: Path, template: str, contents: dict[str, Any], colours: Collection[str]
) -> None:
    """Write a page with charts as one file that fetches nothing and runs only its own scripts.

    Args:
        target: the file.
        template: name of the page's template.
        contents: values of the template; `charts` holds figures of Plotly, or None, by name.
        colours: colours of the charts, for which the dark page has lighter ones.
    """
    from plotly.offline import get_plotlyjs

    scripts = {"plotly": get_plotlyjs(), "script": (_PAGE / "draw.js").read_text(encoding="utf-8")}
    digests = [hashlib.sha256(text.encode()).digest() for text in scripts.values()]
    charts = {name: figure for name, figure in contents["charts"].items() if figure is not None}
    shown = palette(colours)
    data = {
        "charts": {name: json.loads(figure.to_json()) for name, figure in charts.items()},
        "templates": {theme: chart_template(theme) for theme in ("light", "dark")},
        "lighter": {colour: shown["dark"][css_name(colour)] for colour in colours},
    }
    page = templates().get_template(template)
    html = page.render(
        contents | scripts,
        data=data,
        palette=shown,
        style=(_PAGE / "report.css").read_text(encoding="utf-8"),
        script_hashes=[base64.b64encode(digest).decode() for digest in digests],
    )
    write_text(target, html)


def templates() -> jinja2.Environment:
    """Return the environment of the page's templates, which escapes all names."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PAGE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"text": layout, "criteria": alignment_criteria, "shown": tables.SHOWN}
    environment.globals["few_worlds"] = FEW_RUNS  # runs of one world are not independent
    environment.globals |= {
        "gross_m": GROSS_M,
        "images_by": images_by,
        "install_command": install_command,
    }
    environment.tests["nan"] = math.isnan
    return environment
