"""Report of a result as one HTML file that needs nothing else."""

import base64
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import jinja2

from experiments.evaluation import criteria, tables
from experiments.evaluation.map_consistency import GROSS_M
from experiments.reports import formatting
from experiments.reports.export import write_text
from experiments.reports.figures.style import ROBOT_COLOURS
from experiments.reports.report.contents import contents_of
from experiments.reports.report.theme import NEUTRAL, chart_template, css_name, palette
from experiments.studies.error_bands import BAND
from experiments.studies.intervals import FEW_RUNS

_PAGE = Path(__file__).parent / "page"


def write_report(path: Path, output: Path | None = None) -> Path:
    """Write the report of a folder of `run` or `sweep`, and return the file.

    The file is `report.html` in the folder by default. Raises InputError as `contents_of` does.
    """
    target = path / "report.html" if output is None else output
    write_text(target, _render(contents_of(path)))
    return target


def templates() -> jinja2.Environment:
    """Return the environment of the page's templates, which escapes all names."""
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
    """Render the report as HTML whose policy lets it fetch nothing and run these scripts alone."""
    from plotly.offline import get_plotlyjs

    scripts = {"plotly": get_plotlyjs(), "script": (_PAGE / "draw.js").read_text(encoding="utf-8")}
    digests = [hashlib.sha256(text.encode()).digest() for text in scripts.values()]
    charts = {name: figure for name, figure in contents["charts"].items() if figure is not None}
    colours = [style["hex"] for style in contents["styles"].values()] + [*ROBOT_COLOURS, NEUTRAL]
    shown = palette(colours)
    data = {
        "charts": {name: json.loads(figure.to_json()) for name, figure in charts.items()},
        "templates": {theme: chart_template(theme) for theme in ("light", "dark")},
        "lighter": {colour: shown["dark"][css_name(colour)] for colour in colours},
    }
    template = templates().get_template("report.html.j2")
    return template.render(
        contents | scripts,
        data=data,
        palette=shown,
        band=BAND,
        style=(_PAGE / "report.css").read_text(encoding="utf-8"),
        script_hashes=[base64.b64encode(digest).decode() for digest in digests],
    )
