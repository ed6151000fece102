"""Folders and descriptions: results, sweeps, logs, stages, stores; scenarios and JSON files."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from experiments.judge.provenance import RESULT_SCHEMA_VERSION
from experiments.scenario.loading import load_scenario, scenario_of
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.robot_log import read_log

# What tells a folder's kind, in this order.
_FOLDER_MARKS = (
    ("sweep", "sweep.json"),
    ("result", "scenario.json"),
    ("stage", "done.json"),
    ("robot log", "frames.parquet"),
)
MAX_LISTED = 40


@dataclass(frozen=True)
class Description:
    """What is known of a folder or a description file.

    Attributes:
        kind: in words.
        version: of its schema; empty where it has none.
        facts: (name, value) in order.
        parts: (name, what it holds) of the files or entries inside.
    """

    kind: str
    version: str
    facts: tuple[tuple[str, str], ...]
    parts: tuple[tuple[str, str], ...] = ()


def inspect_folder(path: Path) -> Description:
    """Describe a folder of ours; raises InputError where it is none, or a part is damaged."""
    for kind, mark in _FOLDER_MARKS:
        if (path / mark).is_file():
            return _OF_FOLDER[kind](path)
    stages = sorted(path.glob("*/*/done.json"))
    if stages:
        return _store(path, stages)
    if list(path.glob("*/frames.parquet")):
        return _logs(path)
    if list(path.glob("*.parquet")):
        return Description("folder of tables", "", (), _tables(path))
    raise InputError(
        f"{path}: no folder of mapfusion's (known: results, sweeps, robot logs, stages, stores)"
    )


def read_json(path: Path) -> Any:
    """A JSON file; raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged or no JSON ({error})") from error


def inspect_json(path: Path) -> Description:
    """Describe a JSON file of ours by its name and keys."""
    found = read_json(path)
    if not isinstance(found, dict):
        raise InputError(f"{path}: no file of mapfusion's, expected a JSON object")
    for keys, kind in _JSON_KINDS:
        if keys <= set(found):
            version = str(found.get("schema_version", ""))
            if kind == "scenario, resolved":
                return _scenario(_validated(path, found), kind)
            facts = tuple((name, _brief(value)) for name, value in found.items())
            return Description(kind, version, facts)
    raise InputError(
        f"{path}: no file of mapfusion's (known JSON: scenario, provenance, world, sweep, stage)"
    )


_JSON_KINDS = (
    ({"schema_version", "align", "slam", "evaluate"}, "scenario, resolved"),
    ({"schema_version", "stages", "libraries"}, "provenance of a result"),
    ({"walls", "robots"}, "world: walls and the robots' true starts"),
    ({"kind", "settings"}, "sweep"),
    ({"stage", "key"}, "finished stage"),
    ({"elapsed_s"}, "times of a part of a stage"),
)


def inspect_scenario(path: Path) -> Description:
    """Describe a scenario; raises InputError as the commands that run it do."""
    return _scenario(load_scenario(path), "scenario")


def _validated(path: Path, found: dict[str, Any]) -> AnyScenario:
    return scenario_of(found, str(path))


def _scenario(scenario: AnyScenario, kind: str) -> Description:
    facts = [("name", scenario.name), ("description", scenario.description)]
    facts.append(("seed", str(scenario.seed)))
    if isinstance(scenario, Simulation):
        facts.append(("robots", ", ".join(robot.name for robot in scenario.robots)))
        facts.append(("walls", str(len(scenario.world.walls))))
        facts.append(("frames a robot", str(scenario.drive.frames)))
    else:
        facts.append(("logs", ", ".join(scenario.logs)))
    facts += [
        ("particles", str(scenario.slam.filter.n_particles)),
        ("aligners", ", ".join(entry.name for entry in scenario.align.aligners)),
        ("merged with", scenario.merge.aligner),
        ("evaluated every", f"{scenario.evaluate.every} iterations"),
        ("expects", ", ".join(scenario.expect) or "nothing"),
    ]
    return Description(kind, str(scenario.schema_version), tuple(f for f in facts if f[1]))


def _result(path: Path) -> Description:
    scenario = read_json(path / "scenario.json")
    facts = [(name, str(scenario.get(name, ""))) for name in ("name", "description", "seed")]
    version = ""
    if (path / "provenance.json").is_file():
        made = read_json(path / "provenance.json")
        version = str(made.get("schema_version", ""))
        facts += [(name, str(made.get(name, ""))) for name in ("renderer", "written")]
        if version != str(RESULT_SCHEMA_VERSION):
            facts.append(("note", f"this program writes schema_version {RESULT_SCHEMA_VERSION}"))
    figures = len(list((path / "figures").glob("*.png")))
    facts.append(("figures", str(figures)))
    if (path / "report.html").is_file():
        facts.append(("report", "report.html"))
    maps = ((f"maps/{name}", rows) for name, rows in _tables(path / "maps"))
    parts = (*_tables(path / "tables"), *maps)
    return Description("result of a run", version, tuple(f for f in facts if f[1]), parts)


def _sweep(path: Path) -> Description:
    found = read_json(path / "sweep.json")
    facts = [("settings", ", ".join(found.get("settings", [])) or "seeds alone")]
    parts = []
    for folder in sorted(entry for entry in path.iterdir() if entry.is_dir()):
        files = [file for file in folder.glob("*.parquet") if not file.name.startswith(".")]
        if files:
            n_rows = sum(_rows(file) for file in files)
            parts.append((folder.name, f"{len(files)} runs, {n_rows} rows"))
    if (path / "runs").is_dir():
        statuses = [
            str(row["status"])
            for file in sorted((path / "runs").glob("[!.]*.parquet"))
            for row in pq.read_table(file, columns=["status"]).to_pylist()
        ]
        for status in dict.fromkeys(statuses):
            facts.append((status, f"{statuses.count(status)} runs"))
    return Description("sweep", str(found.get("schema_version", "")), tuple(facts), tuple(parts))


def _log(path: Path) -> Description:
    log = read_log(path)
    n, frames = len(log.observations), len(log)
    duration_s = float(log.time_s[-1] - log.time_s[0]) if frames else 0.0
    travelled_m = float(np.hypot(log.odometry[:, 0], log.odometry[:, 1]).sum())
    carried = [
        name
        for name in ("descriptor", "label", "uvd_px")
        if getattr(log.observations, name) is not None
    ]
    truth = [
        name for name in ("truth_poses", "truth_points") if (path / f"{name}.parquet").is_file()
    ]
    facts = (
        ("robot", log.robot),
        ("planar", "yes" if log.planar else "no"),
        ("frames", f"{frames}, {duration_s:.1f} s"),
        ("odometry", f"{travelled_m:.1f} m"),
        ("observations", f"{n}, {n / frames:.1f} a frame" if frames else "0"),
        ("with", ", ".join(carried) or "positions alone"),
        ("truth", ", ".join(truth) or "none"),
    )
    return Description("robot log", "", facts, _tables(path))


def _logs(path: Path) -> Description:
    folders = sorted(file.parent for file in path.glob("*/frames.parquet"))
    parts = tuple((folder.name, f"log of {read_log(folder).robot}") for folder in folders)
    return Description("folder of robot logs", "", (("logs", str(len(folders))),), parts)


def _stage(path: Path) -> Description:
    done = read_json(path / "done.json")
    facts = tuple((str(name), _brief(value)) for name, value in done.items())
    return Description("finished stage", "", facts, _tables(path))


def _store(path: Path, stages: list[Path]) -> Description:
    counts: dict[str, int] = {}
    for mark in stages:
        name = mark.parent.parent.name
        counts[name] = counts.get(name, 0) + 1
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    parts = tuple((name, f"{n} finished") for name, n in counts.items())
    return Description("store of stages", "", (("size", f"{size / 1e6:.1f} MB"),), parts)


_OF_FOLDER: dict[str, Callable[[Path], Description]] = {
    "sweep": _sweep,
    "result": _result,
    "stage": _stage,
    "robot log": _log,
}


def _tables(folder: Path) -> tuple[tuple[str, str], ...]:
    files = sorted(folder.glob("[!.]*.parquet"))
    shown = [(file.stem, f"{_rows(file)} rows") for file in files[:MAX_LISTED]]
    more = len(files) - len(shown)
    return (*shown, (f"{more} more", "")) if more else tuple(shown)


def _rows(file: Path) -> int:
    try:
        return pq.read_metadata(file).num_rows
    except (OSError, ValueError) as error:  # pyarrow's ArrowInvalid is a ValueError
        reason = str(error).splitlines()[0]
        raise InputError(f"{file}: damaged or not a Parquet file ({reason})") from error


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        listed = ", ".join(f"{k} {v}" for k, v in value.items()) if len(value) <= 8 else ""
        return listed or f"{len(value)} entries"
    if isinstance(value, list):
        return ", ".join(map(str, value)) if len(str(value)) < 80 else f"{len(value)} entries"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
