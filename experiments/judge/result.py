"""The result folder of a run: everything that figures, checks and people read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, and the fused map), `keyframes/`, `figures/`,
`scenario.json` (resolved), `world.json`, `provenance.json`.
"""

import json
import platform
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.judge import tables
from experiments.judge.aligner_times import measure_aligners
from experiments.judge.consistency import landmark_nees_rows
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.fused_landmarks import (
    FusedTeam,
    fused_motion_rows,
    fused_rows,
    landmark_rows,
    map_fit_rows,
)
from experiments.judge.judged_run import JudgedRun
from experiments.judge.map_history import history_tables
from experiments.judge.path_errors import path_statistics_rows, robot_paths
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.stages import slam
from experiments.run.store import Store
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.landmark_map import write_map
from mapfusion.robot_log import read_log
from mapfusion.storage import read_table, write_whole
from sim.renderer import renderer_name

RESULT_SCHEMA_VERSION = 1
_LABEL = "write the tables"


def require_result(result: Path) -> None:
    """Raise InputError unless the folder holds a finished result."""
    for name in ("scenario.json", "tables"):
        if not (result / name).exists():
            raise InputError(f"{result}: not a result folder (no {name}); make one with `run`")


def run_scenario(
    scenario: AnyScenario, results: Path, jobs: int, on_progress: OnProgress, fresh: bool = False
) -> Path:
    """Run a scenario and write its result folder `RESULTS/NAME-SEED`; returns the folder."""
    run = JudgedRun.of(scenario, Store.of(results))
    if fresh:
        for stage_folder in run.folders():
            stage_folder.discard()
    run.execute(jobs, on_progress)
    folder = results / f"{scenario.name}-{scenario.seed}"
    on_progress(_LABEL, 0, 1)
    write_result(run, folder)
    on_progress(_LABEL, 1, 1)
    return folder


def write_result(run: JudgedRun, folder: Path) -> None:
    """Collect a finished plan's tables, maps and images in a result folder."""
    team = run.load_team()
    measure_aligners(run, team.robots)
    rows = all_tables(run, team) | history_tables(team, run.scenario)
    rows |= {"aligner_timings": run.pair_table("aligner_timings"), "tracks": _tracks(run)}
    for name, table in rows.items():
        tables.write(tables.table_path(folder, name), name, table)
    for outdated in ("maps", "keyframes"):  # of robots or frames that are no longer there
        shutil.rmtree(folder / outdated, ignore_errors=True)
    for name, landmarks, _ in team.judged():
        write_map(folder / "maps" / f"{name}.parquet", landmarks)
    _write_images(run, folder)
    _write_json(folder / "scenario.json", run.scenario.resolved())
    _write_json(folder / "world.json", _world(run.scenario, team.robots))
    _write_json(folder / "provenance.json", provenance(run))


def all_tables(run: JudgedRun, team: FusedTeam) -> dict[str, pd.DataFrame]:
    """The tables of a finished run's last maps, paths, estimates and errors, by their names."""
    paths, clouds = [], []
    for stages, robot in zip(run.pipeline.robots, team.robots, strict=True):
        log, maps = run.robot_folders(stages)
        poses = read_table(maps / "poses.parquet", slam.POSES)[0].to_pandas()
        own = robot_paths(poses, read_log(log).odometry, robot.path)
        paths.append(own.assign(robot=robot.name))
        cloud = read_table(maps / "clouds.parquet", slam.CLOUDS)[0].to_pandas()
        clouds.append(cloud.assign(robot=robot.name))
    joined = pd.concat(paths, ignore_index=True)
    rows = {
        "paths": joined,
        "robots": joined,
        "path_statistics": path_statistics_rows(joined),
        "clouds": pd.concat(clouds, ignore_index=True),
        "landmarks": landmark_rows(team),
        "fused": fused_rows(team),
        "fused_motions": fused_motion_rows(team, run.scenario.merge.parameters.use_drift),
        "map_fits": map_fit_rows(team),
        "landmark_nees": landmark_nees_rows(team, run.scenario.evaluate.true_pair_radius_m),
        "timings": [
            {"stage": stage.name, "name": f"{stage.key}:{name}", "elapsed_s": seconds}
            for stage in run.folders()
            for name, seconds in stage.figures().items()
        ],
    }
    of_pairs = ("estimates", "correspondences", "errors", "fusion")
    made = {name: pd.DataFrame(rows[name], columns=tables.ALL[name].names) for name in rows}
    return made | {name: run.pair_table(name) for name in of_pairs}


def _write_json(path: Path, content: object) -> None:
    text = json.dumps(content, indent=1)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _world(scenario: AnyScenario, robots: Sequence[EvaluatedRobot]) -> dict[str, object]:
    """The truth that figures show as background."""
    walls = scenario.world.walls if isinstance(scenario, Simulation) else []
    starts = {robot.name: robot.path.T_world_map.tolist() for robot in robots}
    return {"walls": [list(wall.points) for wall in walls], "robots": starts}


def renderer(scenario: AnyScenario) -> str:
    """What made the pictures."""
    if isinstance(scenario, Simulation):
        return renderer_name(scenario.render.renderer)
    return "none (imported logs)"


def provenance(run: JudgedRun) -> dict[str, Any]:
    """JSON-able description of a run: enough to make it again, or to see why it cannot be."""
    return {
        "schema_version": RESULT_SCHEMA_VERSION,
        "scenario": run.scenario.name,
        "seed": run.scenario.seed,
        "renderer": renderer(run.scenario),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "libraries": library_versions(),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "others_aligners": {
            entry.name: origin
            for entry in run.scenario.align.aligners
            if (origin := find_method(entry.method).origin())
        },
        "stages": {f"{folder.name}/{folder.key}": folder.finished for folder in run.folders()},
    }


def _tracks(run: JudgedRun) -> pd.DataFrame:
    files = [run.store.path(robot.observed) / "tracks.parquet" for robot in run.pipeline.simulated]
    return pd.concat([pd.DataFrame(), *(tables.read(file, "tracks") for file in files)])


def _write_images(run: JudgedRun, folder: Path) -> None:
    for robot in run.pipeline.simulated:
        for path in sorted(run.store.path(robot.features).glob("image_*.png")):
            iteration = int(path.stem.removeprefix("image_"))
            link_or_copy(path, folder / "keyframes" / f"{robot.name}_{iteration:05d}.png")
