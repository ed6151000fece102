"""`mapfusion inspect`: what a file or folder is, of which version, and what it holds."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from experiments.judge import tables
from experiments.scenario.loading import load_scenario
from experiments.show.terminal.layout import print_lines, print_table
from mapfusion import landmark_map, robot_log
from mapfusion.errors import InputError
from mapfusion.storage import read_table
from sim import trajectory

_PREFIX, _KIND, _VERSION = "mapfusion.", "kind", "schema_version"
_LOG_SCHEMAS = ("FRAMES", "OBSERVATIONS", "TRUTH_POSES", "TRUTH_POINTS")
# What people bring or take away is checked; tables of stages and studies tell what they are.
_CHECKED = {
    each.metadata[f"{_PREFIX}{_KIND}".encode()].decode(): each
    for each in (
        *tables.ALL.values(),
        landmark_map.LANDMARKS,
        *(getattr(robot_log, name) for name in _LOG_SCHEMAS),
        trajectory.TRAJECTORY,
    )
}
_UNITS = {"m": "m", "m2": "m²", "rad": "rad", "s": "s", "ms": "ms", "px": "px"}
# the upper triangle of an alignment's covariance names its axes instead
_NAMED_UNITS = {f"cov_{a}{b}": "m²" for a, b in ("xx", "xy", "yy")}
_NAMED_UNITS |= {"cov_xt": "m rad", "cov_yt": "m rad", "cov_tt": "rad²"}
_RESOLVED = "scenario, resolved"
_JSON_KINDS = (
    ({_VERSION, "align", "slam", "evaluate"}, _RESOLVED),
    ({_VERSION, "stages", "libraries"}, "provenance of a result"),
    ({"walls", "robots"}, "world: walls and the robots' true starts"),
    ({"kind", "settings"}, "sweep"),
    ({"stage", "key"}, "finished stage"),
    ({"elapsed_s"}, "times of a part of a stage"),
)
# The first that a folder holds tells its kind.
_RESULT = "result of a run"
_LOG = "robot log"
_FOLDER_MARKS = {
    "sweep.json": "sweep",
    "scenario.json": _RESULT,
    "done.json": "finished stage",
    "frames.parquet": _LOG,
    "*/*/done.json": "store of stages",
    "*/frames.parquet": "folder of robot logs",
    "*.parquet": "folder of tables",
}
_DESCRIPTIONS = ("sweep.json", "scenario.json", "provenance.json", "done.json")


@dataclass(frozen=True)
class Contents:
    """What is known of a file or folder.

    Attributes:
        kind: in words.
        facts: by name, the schema's version among them.
        columns: of the parts: heading and format.
        parts: a row for each column of a table, or for what a folder holds.
    """

    kind: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    columns: Sequence[tuple[str, str]] = ()
    parts: Sequence[Sequence[Any]] = ()


def inspect(path: Path) -> None:
    """Print what a file or folder is and holds.

    Raises:
        InputError: it is missing, damaged, or none of mapfusion's.
    """
    found = contents_of(path)
    facts = dict(found.facts)
    version = facts.pop(_VERSION, None)
    shown = "" if version is None else f", schema version {version}"
    print_lines([f"{path}: {found.kind}{shown}", *(f"  {name}: {facts[name]}" for name in facts)])
    if found.parts:
        print_table(found.columns, found.parts)


def contents_of(path: Path) -> Contents:
    """What a file or folder is and holds; raises InputError as `inspect` does."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.is_dir():
        return _folder(path)
    if path.suffix in {".yaml", ".yml"}:
        return Contents("scenario", _brief(load_scenario(path).resolved()))
    if path.suffix == ".json":
        found = _json(path)
        if found.kind == _RESOLVED:
            load_scenario(path)  # raises where it is none of this program's
        return found
    if path.suffix == ".parquet":
        return _table(path)
    raise InputError(
        f"{path}: no file of mapfusion's (known: .parquet tables, .yaml scenarios, .json)"
    )


def unit_of(name: str) -> str:
    """The unit that a column's name ends in; empty for none."""
    return _NAMED_UNITS.get(name, _UNITS.get(name.rpartition("_")[2], "") if "_" in name else "")


def _table(path: Path) -> Contents:
    file = _open(path)
    told = {
        name.decode().removeprefix(_PREFIX): value.decode()
        for name, value in (file.schema_arrow.metadata or {}).items()
        if name.decode().startswith(_PREFIX)
    }
    if _KIND not in told:
        raise InputError(
            f"{path}: a Parquet file, but none of mapfusion's (no mapfusion.kind in its metadata)"
        )
    kind = told.pop(_KIND)
    if kind in _CHECKED:
        read_table(path, _CHECKED[kind])  # raises where version or columns are others
    facts = told | {"rows": file.metadata.num_rows, "MB": f"{path.stat().st_size / 1e6:.2f}"}
    columns = [(each.name, str(each.type), unit_of(each.name)) for each in file.schema_arrow]
    return Contents(kind, facts, [("column", ""), ("type", ""), ("unit", "")], columns)


def _open(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: damaged or not a Parquet file ({reason})") from error


def _json(path: Path) -> Contents:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged or no JSON ({error})") from error
    for keys, kind in _JSON_KINDS:
        if isinstance(found, dict) and keys <= set(found):
            return Contents(kind, _brief(found))
    raise InputError(
        f"{path}: no file of mapfusion's (known JSON: scenario, provenance, world, sweep, stage)"
    )


def _brief(found: Mapping[str, Any]) -> dict[str, Any]:
    """What can be read at a glance: single values and names; the file itself shows the rest."""
    names = {
        name: ", ".join(value)
        for name, value in found.items()
        if isinstance(value, list) and all(isinstance(each, str) for each in value)
    }
    facts = {name: names.get(name, value) for name, value in found.items() if name != _KIND}
    return {
        name: value
        for name, value in facts.items()
        if isinstance(value, str | float | int) and value != ""
    }


def _folder(path: Path) -> Contents:
    kind = next((kind for mark, kind in _FOLDER_MARKS.items() if any(path.glob(mark))), None)
    if kind is None:
        raise InputError(
            f"{path}: no folder of mapfusion's (known: results, sweeps, robot logs, stages, stores)"
        )
    facts: dict[str, Any] = {}
    for name in _DESCRIPTIONS:
        if (path / name).is_file():
            facts |= _json(path / name).facts
    if kind == _LOG:
        log = robot_log.read_log(path)
        facts = {"robot": log.robot, "planar": log.planar}
    n_files, n_rows = Counter[str](), Counter[str]()
    for file in sorted(path.rglob("[!.]*.parquet")):
        inside = file.relative_to(path).with_suffix("").parts[: 2 if kind == _RESULT else 1]
        n_files["/".join(inside)] += 1
        n_rows["/".join(inside)] += _open(file).metadata.num_rows
    parts = [(name, n_files[name], n_rows[name]) for name in n_files]
    return Contents(kind, facts, [("holds", ""), ("files", "d"), ("rows", "d")], parts)
