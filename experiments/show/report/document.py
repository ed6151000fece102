"""From what a result holds to one HTML file that needs nothing else."""

import base64
import hashlib
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from experiments.judge import criteria, tables
from experiments.show import numbers
from experiments.show.report.contents import contents_of
from experiments.show.report.theme import css_name, palette
from experiments.study.statistics.error_bands import BAND
from mapfusion.storage import write_whole

# The page is there, and the map can be used, before the browser reads Plotly for the charts.
_AT_ONCE = ("base.js", "map.js")
_DRAWN_BY_SCRIPTS = ("aligners", "groups", "success", "times", "map")


def write_report(path: Path, output: Path | None = None) -> Path:
    """Write the report of a result or of a sweep.

    Args:
        path: a folder written by `run` or by `sweep`; nothing else is read.
        output: where to write; `report.html` in that folder by default.

    Returns:
        The file.

    Raises:
        InputError: the folder is neither, or a table is damaged.
    """
    text = render(contents_of(path))
    target = path / "report.html" if output is None else output
    write_whole(target, lambda file: file.write_text(text, encoding="utf-8"))
    return target


def render(contents: dict[str, Any]) -> str:
    """The report as HTML.

    All names are escaped: in text by Jinja2, in data by its `tojson`, which leaves no `<` that
    could end the script. The page's policy lets it fetch nothing and run these scripts alone.
    """
    from plotly.offline import get_plotlyjs

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("experiments.show.report", "page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = "\n".join(_page_file(name) for name in _AT_ONCE)
    later = {"plotly": get_plotlyjs(), "charts": _page_file("charts.js")}
    robots, aligners = contents["robot_colours"], contents["aligners"]
    data = {name: contents[name] for name in _DRAWN_BY_SCRIPTS}
    data["min_true_pairs"] = criteria.ANSWERABLE_PAIRS
    data["robot_colours"] = {robot: css_name(colour) for robot, colour in robots.items()}
    return environment.get_template("report.html.j2").render(
        contents,
        data=data,
        text=numbers,
        criteria=criteria,
        shown=tables.SHOWN,
        style_of={style["name"]: style for style in aligners},
        palette=palette([*(style["hex"] for style in aligners), *robots.values()]),
        band_text=f"{100 * BAND[0]:g}–{100 * BAND[1]:g}\u00a0%",
        style=Markup(_page_file("report.css")),  # noqa: S704  # our own file
        script=Markup(script),  # noqa: S704  # our own files
        **{name: Markup(text) for name, text in later.items()},  # noqa: S704  # Plotly's, our own
        policy=_policy([script, *later.values()]),
    )


def _page_file(name: str) -> str:
    folder = resources.files("experiments.show.report")
    return folder.joinpath("page", name).read_text(encoding="utf-8")


def _policy(scripts: list[str]) -> str:
    """Content security policy: scripts by their hash, nothing from anywhere else."""
    digests = [hashlib.sha256(text.encode()).digest() for text in scripts]
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
