"""From what a result holds to one HTML file that needs nothing else."""

import base64
import hashlib
import math
from pathlib import Path
from typing import Any

import jinja2

from experiments.evaluation import criteria, tables
from experiments.evaluation.map_consistency import GROSS_M
from experiments.reports import formatting
from experiments.reports.export import write_text
from experiments.reports.report.contents import contents_of
from experiments.reports.report.theme import css_name, palette
from experiments.studies.error_bands import BAND
from experiments.studies.intervals import FEW_RUNS

_PAGE = Path(__file__).parent / "page"
_DRAWN_BY_SCRIPTS = ("aligners", "groups", "success", "times", "map")


def write_report(path: Path, output: Path | None = None) -> Path:
    """Write the report of a folder of `run` or `sweep`, from it alone; returns the file.

    By default that is `report.html` in the folder. Raises InputError as `contents_of` does.
    """
    target = path / "report.html" if output is None else output
    write_text(target, _render(contents_of(path)))
    return target


def templates() -> jinja2.Environment:
    """The page's templates; all names that they show are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PAGE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"text": formatting, "criteria": criteria, "shown": tables.SHOWN}
    environment.globals["few_worlds"] = FEW_RUNS  # runs of one world are not independent
    environment.globals["gross_m"] = GROSS_M
    environment.tests["nan"] = math.isnan
    return environment


def _render(contents: dict[str, Any]) -> str:
    """The report as HTML, whose policy lets it fetch nothing and run these scripts alone.

    The map can be used before the browser reads Plotly for the charts. In data, `tojson` leaves no
    `<` that could end the script.
    """
    from plotly.offline import get_plotlyjs

    style, base, map_view, charts = (
        (_PAGE / name).read_text(encoding="utf-8")
        for name in ("report.css", "base.js", "map.js", "charts.js")
    )
    scripts = {"script": f"{base}\n{map_view}", "plotly": get_plotlyjs(), "charts": charts}
    digests = [hashlib.sha256(text.encode()).digest() for text in scripts.values()]
    robots, aligners = contents["robot_colours"], contents["aligners"]
    data = {name: contents[name] for name in _DRAWN_BY_SCRIPTS} | {
        "min_true_pairs": criteria.ANSWERABLE_PAIRS,
        "robot_colours": {robot: css_name(colour) for robot, colour in robots.items()},
    }
    template = templates().get_template("report.html.j2")
    return template.render(
        contents | scripts,
        data=data,
        style_of={style["name"]: style for style in aligners},
        palette=palette([*(style["hex"] for style in aligners), *robots.values()]),
        band=BAND,
        style=style,
        script_hashes=[base64.b64encode(digest).decode() for digest in digests],
    )
