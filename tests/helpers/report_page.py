"""A report as a parser reads it, and a result whose names would like to be HTML."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation import tables
from experiments.reports.report.document import write_report
from mapfusion.files import read_json, write_json

HOSTILE = '<img src=x onerror=alert(1)></script><script>alert("2")</script>'


class Page(HTMLParser):
    """Tags, text and the JSON of a report."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.json = ""
        self._within = ""
        self.feed(text)

    @property
    def charts(self) -> dict[str, Any]:
        """The Plotly figures by name."""
        return json.loads(self.json)["charts"]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        kind = dict(attrs).get("type")
        self._within = "json" if kind == "application/json" else tag

    def handle_endtag(self, tag: str) -> None:
        self._within = ""

    def handle_data(self, data: str) -> None:
        if self._within == "json":
            self.json += data
        elif self._within not in {"script", "style"}:
            self.words += data


def numbers(values: Any) -> np.ndarray:
    """Return numbers as Plotly's JSON holds them: a list, or the bytes of an array."""
    if isinstance(values, dict):
        found = np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
        return found.reshape([int(n) for n in values.get("shape", "-1").split(",")])
    return np.array(values, dtype=float)


def page_of(result: Path, output: Path) -> Page:
    return Page(write_report(result, output).read_text(encoding="utf-8"))


def hostile(result: Path) -> Path:
    """Give an aligner, a robot and the scenario names that would like to be HTML."""
    renamed = {"ransac": HOSTILE, "R2": f"R2{HOSTILE}"}
    for name in tables.ALL:
        file = tables.table_path(result, name)
        if file.is_file():
            tables.write(file, name, tables.read(file, name).replace(renamed))
    for name, old, new in (("scenario", "ransac", HOSTILE), ("world", "R2", f"R2{HOSTILE}")):
        path = result / f"{name}.json"
        text = json.dumps(read_json(path, name)).replace(json.dumps(old), json.dumps(new))
        named = {"description": HOSTILE, "name": HOSTILE} if name == "scenario" else {}
        write_json(path, json.loads(text) | named)
    return result
