"""Command `inspect`: kind, version and contents of a file or folder."""

import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from experiments.evaluation import tables
from experiments.evaluation.tables import require_as_written
from experiments.reports.layout import Column, print_lines, print_table
from mapfusion import attitude, landmark_map, robot_log
from mapfusion.errors import InputError
from mapfusion.files import read_json, read_parquet, read_table, text_attributes
from mapfusion.tables import columns_as_read, is_alone, is_csv, read_open_table
from sim import trajectory

_PREFIX, _KIND, _VERSION = "mapfusion.", "kind", "schema_version"
# Files that users read and write are checked; tables of stages and studies name their kind.
_SCHEMAS = [*tables.ALL.values(), landmark_map.LANDMARKS, trajectory.TRAJECTORY]
_SCHEMAS += [robot_log.FRAMES, robot_log.OBSERVATIONS, robot_log.ODOMETRY_COVARIANCE]
_SCHEMAS += [attitude.ATTITUDE]
_SCHEMAS += [robot_log.TRUTH_POSES, robot_log.TRUTH_POINTS]
_CHECKED = {each.metadata[f"{_PREFIX}{_KIND}".encode()].decode(): each for each in _SCHEMAS}
_UNITS = {"m": "m", "m2": "m²", "rad": "rad", "s": "s", "ms": "ms", "px": "px"}
# Columns of the upper triangle of an alignment's covariance end in the names of both axes.
_OF_AXES = {"xx": "m²", "xy": "m²", "yy": "m²", "xt": "m rad", "yt": "m rad", "tt": "rad²"}
_RESOLVED, _RESULT, _LOG = "scenario, resolved", "result of a run", "robot log"
_JSON_KEYS = {
    _RESOLVED: {_VERSION, "align", "slam", "evaluate"},
    "provenance of a result": {_VERSION, "stages", "libraries"},
    "world: walls and the robots' true starts": {"walls", "robots"},
    "sweep": {"kind", "settings"},
    "finished stage": {"stage", "key"},
    "times of a part of a stage": {"elapsed_s"},
}
_NAMES_SHOWN = 10
_DESCRIPTIONS = ("sweep.json", "scenario.json", "provenance.json", "done.json")
# The first pattern with a match gives the kind of a folder.
_FOLDER_MARKS = {
    "sweep.json": "sweep",
    "scenario.json": _RESULT,
    "done.json": "finished stage",
    "frames.parquet": _LOG,
    "frames.csv": _LOG,
    "*/*/done.json": "store of stages",
    "*/frames.parquet": "folder of robot logs",
    "*/frames.csv": "folder of robot logs",
    "*.parquet": "folder of tables",
}


def _open_tables() -> dict[str, pa.Schema]:
    """Return the schemas of tables of other programs by the names of files without metadata."""
    from mapfusion.datasets import point_logs  # imports the front end

    return {
        "frames": robot_log.FRAMES,
        "observations": robot_log.OBSERVATIONS,
        "truth_poses": robot_log.TRUTH_POSES,
        "truth_points": robot_log.TRUTH_POINTS,
        "odometry": point_logs.ODOMETRY,
        "points": point_logs.POINTS,
        "ranges": point_logs.RANGES,
    }


class Contents(NamedTuple):
    """Kind of a file or folder, facts by name, and a table of its columns or files."""

    kind: str
    facts: dict[str, Any]
    columns: Sequence[Column] = ()
    rows: Sequence[tuple[Any, ...]] = ()


def inspect(path: Path) -> None:
    """Print kind and contents of a file or folder; raises InputError as `contents_of` does."""
    found = contents_of(path)
    facts = {name: f"  {name}: {value}" for name, value in found.facts.items()}
    version = f", schema version {found.facts[_VERSION]}" if facts.pop(_VERSION, "") else ""
    print_lines([f"{path}: {found.kind}{version}", *facts.values()])
    print_table(found.columns, found.rows)


def contents_of(path: Path) -> Contents:
    """Describe a file or folder; raises InputError if missing, damaged or of no known kind."""
    if path.is_dir():
        return _folder_contents(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.suffix.lower() in landmark_map.MAP_ENDINGS:
        # by the kind in the table's metadata, or by the file's name without metadata
        if is_alone(path):
            return _open_table(path, _open_schema(path))
        table = read_parquet(path, "table")
        facts: dict[str, Any] = dict(text_attributes(path, table))
        kind = facts.pop(_KIND, None)
        table_schema = _CHECKED.get(kind or "")
        if kind is None:
            table_schema = _open_schema(path)
            if not set(table_schema.names) & set(table.column_names):
                raise InputError(f"{path}: none of mapfusion's (no mapfusion.kind in its metadata)")
        if table_schema in (landmark_map.LANDMARKS, *_open_tables().values()):
            return _open_table(path, table_schema)
        if table_schema is not None:
            read_table(path, table_schema)  # raises if version or columns differ
        return _columns_of(path, str(kind), table, facts)
    if path.suffix in {".yaml", ".yml"}:
        return Contents("scenario", _brief(_resolved(path)))
    if path.suffix != ".json":
        known = ", ".join((*landmark_map.MAP_ENDINGS, ".yaml", ".json"))
        raise InputError(f"{path}: no file of mapfusion's (known: {known})")
    found = _json(path)
    if found.kind == _RESOLVED:
        _resolved(path)  # raises if the settings are not valid
    return found


def _resolved(path: Path) -> dict[str, Any]:
    """Return all settings of a scenario; raises InputError."""
    from experiments.scenario.loading import load_scenario  # imports all methods

    return load_scenario(path).resolved()


def unit_of(name: str) -> str:
    """Return the unit at the end of a column's name; empty if there is none."""
    stem, _, end = name.rpartition("_")
    return (_OF_AXES if stem == "cov" else _UNITS).get(end, "") if stem else ""


def _folder_contents(path: Path) -> Contents:
    """Describe a folder by its descriptions and tables."""
    kind = next((kind for mark, kind in _FOLDER_MARKS.items() if any(path.glob(mark))), None)
    if kind is None:
        known = ", ".join(dict.fromkeys(_FOLDER_MARKS.values()))
        raise InputError(f"{path}: no folder of mapfusion's (known: {known})")
    if kind == _LOG:
        log = robot_log.read_log(path)
        facts: dict[str, Any] = {"robot": log.robot, "planar": log.planar}
    else:
        descriptions = [_json(path / name) for name in _DESCRIPTIONS if (path / name).is_file()]
        facts = {name: value for each in descriptions for name, value in each.facts.items()}
    if kind == _RESULT:
        require_as_written(path)
    # Files and rows by table, or by folder and table in a result
    n_levels = 2 if kind == _RESULT else 1
    files = sorted(path.rglob("[!.]*.parquet"))
    csv = [file for name in _open_tables() for file in path.rglob(f"{name}.csv")]
    files += sorted(file for file in csv if file.with_suffix(".parquet") not in files)
    inside = [file.relative_to(path).with_suffix("").parts[:n_levels] for file in files]
    n_files, n_rows = Counter[str](), Counter[str]()
    for name, file in zip(map("/".join, inside), files, strict=True):
        n_files[name] += 1
        if is_csv(file):
            n_rows[name] += read_open_table(file, _open_schema(file))[0].num_rows
        else:
            n_rows[name] += read_parquet(file, "table").num_rows
    rows = [(name, n, n_rows[name]) for name, n in n_files.items()]
    return Contents(kind, facts, [("holds", ""), ("files", "d"), ("rows", "d")], rows)


def _columns_of(path: Path, kind: str, table: pa.Table, facts: dict[str, Any]) -> Contents:
    """Return the contents of a table with its columns, types and units."""
    facts = facts | {"rows": table.num_rows, "MB": f"{path.stat().st_size / 1e6:.2f}"}
    rows = [(field.name, str(field.type), unit_of(field.name)) for field in table.schema]
    return Contents(kind, facts, [(name, "") for name in ("column", "type", "unit")], rows)


def _open_schema(path: Path) -> pa.Schema:
    """Return the schema for a file without metadata, by its name."""
    return _open_tables().get(path.stem, landmark_map.LANDMARKS)


def _open_table(path: Path, table_schema: pa.Schema) -> Contents:
    """Describe a table of any program as `align`, `merge` and `slam` read it."""
    with warnings.catch_warnings(record=table_schema is landmark_map.LANDMARKS):  # see `read_map`
        table, facts = read_open_table(path, table_schema)
    kind = table_schema.metadata[f"{_PREFIX}{_KIND}".encode()].decode()
    known: dict[str, Any] = {
        name: value
        for name, value in facts.items()
        if name != _KIND and not name.startswith("descriptor_")  # said in words below
    }
    if table_schema is landmark_map.LANDMARKS:
        landmarks = landmark_map.read_map(path)
        known |= {"name": landmarks.name, "planar": str(landmarks.planar).lower()}
        keys = {"descriptors": landmarks.descriptor, "labels": landmarks.label}
        there = [name for name, values in keys.items() if values is not None]
        known["matched by"] = (
            " and ".join(there) or "geometry alone: neither descriptors nor labels"
        )
        if landmarks.descriptor_kind is not None:
            known["descriptors"] = str(landmarks.descriptor_kind)
    given: dict[str, list[str]] = {}
    for name, known_name in columns_as_read(path, table_schema).items():
        given.setdefault(known_name, []).append(name)
    known["ignored columns"] = _listed(given.get("", [])) or "none"
    told = _columns_of(path, kind, table, known)
    sources = {name: names[0] for name, names in given.items()}
    sources |= {name: f"{own[0]} to {own[-1]}" for name, own in given.items() if len(own) > 1}
    rows = [(*row, sources.get(row[0], "not given")) for row in told.rows]
    return told._replace(columns=[*told.columns, ("read from", "")], rows=rows)


def _json(path: Path) -> Contents:
    """Describe a JSON file by its keys."""
    found = read_json(path, "file of mapfusion's")
    for kind, keys in _JSON_KEYS.items():
        if keys <= set(found):
            return Contents(kind, _brief(found))
    raise InputError(f"{path}: no file of mapfusion's (known: {'; '.join(_JSON_KEYS)})")


def _brief(found: dict[str, Any]) -> dict[str, Any]:
    """Select single values and lists of names."""
    facts = {}
    for name, value in found.items():
        shown = value
        if isinstance(value, list) and all(isinstance(each, str) for each in value):
            shown = _listed(value)
        if name != _KIND and isinstance(shown, str | float | int) and shown != "":
            facts[name] = shown
    return facts


def _listed(names: list[str]) -> str:
    """Return names as text; of many only their number and the ends."""
    if len(names) > _NAMES_SHOWN:
        return f"{len(names)}, from {names[0]} to {names[-1]}"
    return ", ".join(names)
