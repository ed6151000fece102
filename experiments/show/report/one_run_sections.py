"""What only the report of a single run shows: maps, robots, checks, figures, the scenario."""

import base64
import importlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image
from ruamel.yaml import YAML

from experiments.judge import metrics, tables
from experiments.judge.expectations import Outcome
from experiments.judge.path_errors import path_rms
from experiments.scenario.settings import Bound
from experiments.show.figures.drawing import FIGURES
from experiments.show.figures.result_tables import ResultTables
from experiments.show.figures.style import robot_colours
from experiments.show.report.map_view import TABLES as MAP_TABLES
from experiments.show.report.map_view import map_view

_TABLES = tuple(dict.fromkeys((*MAP_TABLES, *metrics.USED_TABLES, "timings")))


def one_run_sections(data: ResultTables) -> dict[str, Any]:
    """Title and sections of a result; what builds on tables that it does not hold is empty."""
    held = {
        name: data.table(name) for name in _TABLES if tables.table_path(data.folder, name).is_file()
    }
    return {
        "title": f"{data.scenario['name']}, seed {data.scenario['seed']}",
        "description": data.scenario.get("description", ""),
        "spread_text": "repetitions on the same maps",
        "map": map_view(data, held),
        "robot_colours": robot_colours(data.robots),
        "outcomes": _outcomes(data.scenario, held),
        "robots": path_rms(held["robots"]).to_dict("records") if "robots" in held else [],
        "fits": held["map_fits"].to_dict("records") if "map_fits" in held else [],
        "figures": list(_pictures(data.folder)),
        "scenario_text": _as_yaml(data.scenario),
        "missing": [name for name in _TABLES if name not in held],
    }


def _outcomes(scenario: dict[str, Any], held: dict[str, pd.DataFrame]) -> list[Outcome]:
    """The scenario's expectations, measured on this run alone."""
    if not set(metrics.USED_TABLES) <= set(held):
        return []
    used = {name: held[name].assign(seed=0) for name in metrics.USED_TABLES}
    outcomes = []
    for metric, bound in scenario.get("expect", {}).items():
        value = metrics.compute(metric, used)
        limits = Bound.model_validate(bound)
        outcomes.append(Outcome(scenario["name"], metric, value, limits, {0: value}))
    return outcomes


def _pictures(folder: Path) -> Iterator[dict[str, Any]]:
    """The drawn figures, as data URIs; a reference folder keeps them beside its tables."""
    for name in FIGURES:
        for file in (folder / "figures" / f"{name}.png", folder / f"{name}.png"):
            if not file.is_file():
                continue
            module = importlib.import_module(f"experiments.show.figures.{name}")
            title, _, caption = (module.__doc__ or name).splitlines()[0].partition(": ")
            with Image.open(file) as picture:  # so that the page does not jump as pictures load
                width, height = picture.size
            uri = f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode('ascii')}"
            caption = caption[:1].upper() + caption[1:]
            yield {"title": title, "caption": caption, "uri": uri, "width": width, "height": height}
            break


def _as_yaml(scenario: dict[str, Any]) -> str:
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 100
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(scenario, stream)
    return stream.getvalue()
