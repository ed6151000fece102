"""The result folder of a run: everything that figures, checks and people read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, and the fused map), `keyframes/`, `figures/`,
`scenario.json` (resolved), `world.json`, `provenance.json`.
"""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.judge import tables
from experiments.judge.aligner_times import time_aligners
from experiments.judge.consistency import landmark_nees_rows
from experiments.judge.errors import EvaluatedRobot, path_columns, robot_rows
from experiments.judge.fused_landmarks import (
    fused_maps,
    fused_motion_rows,
    fused_truth,
    map_fit_rows,
)
from experiments.judge.judged_run import JudgedRun
from experiments.judge.map_history import write_history
from experiments.judge.path_errors import path_statistics_rows
from experiments.judge.provenance import provenance
from experiments.run.stages import slam
from experiments.run.store import Store
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.settings import AnyScenario, Merge, Simulation
from mapfusion import se2
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.errors import InputError
from mapfusion.landmark_map import LandmarkMap, write_map
from mapfusion.merge import FusedMap
from mapfusion.robot_log import read_log
from mapfusion.se2 import Float
from mapfusion.storage import point_columns, read_table, write_whole

_LABEL = "write the tables"


def result_folder(results: Path, scenario: AnyScenario) -> Path:
    """Where the result of a scenario goes: `RESULTS/NAME-SEED`."""
    return results / f"{scenario.name}-{scenario.seed}"


def require_result(result: Path) -> None:
    """Raise InputError unless the folder holds a finished result."""
    for name in ("scenario.json", "tables"):
        if not (result / name).exists():
            raise InputError(f"{result}: not a result folder (no {name}); make one with `run`")


def run_scenario(
    scenario: AnyScenario, results: Path, jobs: int, on_progress: OnProgress, fresh: bool = False
) -> Path:
    """Run a scenario and write its result folder; returns the folder."""
    run = JudgedRun.of(scenario, Store.of(results))
    if fresh:
        for stage_folder in run.folders():
            stage_folder.discard()
    run.execute(jobs, on_progress)
    folder = result_folder(results, scenario)
    on_progress(_LABEL, 0, 1)
    write_result(run, folder)
    on_progress(_LABEL, 1, 1)
    return folder


def write_result(run: JudgedRun, folder: Path) -> None:
    """Collect a finished plan's tables, maps and images in a result folder."""
    scenario, robots = run.scenario, run.load_robots()
    measure_aligners(run, robots)
    _join_pair_tables(run, folder)
    _write_robot_tables(run, robots, folder)
    for outdated in ("maps", "keyframes"):  # of robots or frames that are no longer there
        shutil.rmtree(folder / outdated, ignore_errors=True)
    _write_maps(run, robots, folder)
    write_history(robots, scenario, folder)
    _write_images(run, folder)
    _write_json(folder / "scenario.json", scenario.resolved())
    _write_json(folder / "world.json", _world(scenario, robots))
    _write_json(folder / "provenance.json", provenance(run))


def _write_json(path: Path, content: object) -> None:
    text = json.dumps(content, indent=1)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _world(scenario: AnyScenario, robots: Sequence[EvaluatedRobot]) -> dict[str, object]:
    """The truth that figures show as background."""
    walls = (
        [list(wall.points) for wall in scenario.world.walls]
        if isinstance(scenario, Simulation)
        else []
    )
    starts = {robot.name: robot.path.T_world_map.tolist() for robot in robots}
    return {"walls": walls, "robots": starts}


def measure_aligners(run: JudgedRun, robots: Sequence[EvaluatedRobot]) -> None:
    """Time the aligners, serially, when all else is done: nothing else may be running."""
    by_name = {robot.name: robot for robot in robots}
    for pair in run.pipeline.pairs:
        path = run.store.path(pair.estimates) / "aligner_timings.parquet"
        time_aligners(run.scenario, by_name[pair.a.name], by_name[pair.b.name], path)


def _join_pair_tables(run: JudgedRun, folder: Path) -> None:
    for name in ("aligner_timings", "estimates", "correspondences", "errors", "fusion"):
        tables.write(tables.table_path(folder, name), name, run.pair_table(name))


def robot_tables(run: JudgedRun, robots: Sequence[EvaluatedRobot]) -> dict[str, pd.DataFrame]:
    """The tables `paths`, `path_statistics`, `robots` and `clouds`, of all robots."""
    paths, online, clouds = [], [], []
    for stages, robot in zip(run.pipeline.robots, robots, strict=True):
        log, maps = run.robot_folders(stages)
        poses = read_table(maps / "poses.parquet", slam.POSES)[0].to_pandas()
        joined = path_columns(poses, read_log(log).odometry, robot.path)
        paths.append(joined.assign(robot=robot.name))
        online.append(robot_rows(poses, joined).assign(robot=robot.name))
        cloud = read_table(maps / "clouds.parquet", slam.CLOUDS)[0].to_pandas()
        clouds.append(cloud.assign(robot=robot.name))
    made = {
        name: pd.concat(parts, ignore_index=True)
        for name, parts in (("paths", paths), ("robots", online), ("clouds", clouds))
    }
    return made | {"path_statistics": pd.DataFrame(path_statistics_rows(made["paths"]))}


def _write_robot_tables(run: JudgedRun, robots: Sequence[EvaluatedRobot], folder: Path) -> None:
    for name, rows in robot_tables(run, robots).items():
        tables.write(tables.table_path(folder, name), name, rows)
    timings = [
        {"stage": stage.name, "name": f"{stage.key}:{name}", "elapsed_s": seconds}
        for stage in run.folders()
        for name, seconds in stage.figures().items()
    ]
    tables.write(tables.table_path(folder, "timings"), "timings", timings)


def _write_maps(run: JudgedRun, robots: list[EvaluatedRobot], folder: Path) -> None:
    last = max(max(robot.maps) for robot in robots)
    landmark_rows = []
    for robot in robots:
        landmarks, points = robot.at(last)
        write_map(folder / "maps" / f"{robot.name}.parquet", landmarks)
        truth = se2.transform_points(se2.inverse(robot.path.T_world_map), points)
        rows = _landmark_columns(landmarks, truth) | {"count": landmarks.count}
        landmark_rows.append(pd.DataFrame({"robot": robot.name} | rows))
    joined = pd.concat(landmark_rows, ignore_index=True)
    tables.write(tables.table_path(folder, "landmarks"), "landmarks", joined)
    estimates, offered = (
        tables.read(tables.table_path(folder, name), name)
        for name in ("estimates", "correspondences")
    )
    fused = fused_map(run.scenario.merge, robots, estimates, offered, last)
    if fused is not None:
        write_map(folder / "maps" / "fused.parquet", fused.landmarks)
    motions = fused_motion_rows(robots, fused, run.scenario.merge.parameters)
    tables.write(tables.table_path(folder, "fused_motions"), "fused_motions", motions)
    fits = map_fit_rows(robots, fused, last)
    tables.write(tables.table_path(folder, "map_fits"), "map_fits", fits)
    nees = landmark_nees_rows(robots, fused, last, run.scenario.evaluate.true_pair_radius_m)
    tables.write(tables.table_path(folder, "landmark_nees"), "landmark_nees", nees)
    fused_rows = [] if fused is None else _fused_rows(fused, robots, last)
    tables.write(tables.table_path(folder, "fused"), "fused", fused_rows)


def fused_map(
    settings: Merge,
    robots: Sequence[EvaluatedRobot],
    estimates: pd.DataFrame,
    offered: pd.DataFrame,
    last: int,
) -> FusedMap | None:
    """All robots' last maps fused, from all pairs' estimates; None for a single robot."""
    if len(robots) < 2:
        return None
    # a pair's last estimates are at the later of its two robots' last frames
    ends = estimates.groupby(["robot_a", "robot_b"])["iteration"].transform("max")
    offered_ends = offered.merge(
        estimates[["robot_a", "robot_b", "iteration"]][
            estimates["iteration"] == ends
        ].drop_duplicates()
    )
    maps = [robot.at(last)[0] for robot in robots]
    return fused_maps(
        maps,
        estimates[estimates["iteration"] == ends],
        offered_ends,
        settings.aligner,
        settings.parameters,
    )


def _landmark_columns(landmarks: LandmarkMap, truth: Float) -> dict[str, np.ndarray]:
    return {
        "landmark": np.arange(len(landmarks)),
        **point_columns(landmarks.position_m, landmarks.covariance_m2),
        **{f"truth_{axis}_m": truth[:, i] for i, axis in enumerate("xyz")},
    }


def _fused_rows(fused: FusedMap, robots: list[EvaluatedRobot], iteration: int) -> pd.DataFrame:
    truth = fused_truth(fused, robots, iteration)
    truth = se2.transform_points(se2.inverse(robots[0].path.T_world_map), truth)
    rows = pd.DataFrame(_landmark_columns(fused.landmarks, truth))
    has = fused.parents != ABSENT
    names = np.array([robot.name for robot in robots], dtype=object)
    first = np.argmax(has, axis=1)
    later = has & (np.arange(len(robots)) > first[:, None])
    second = np.where(later.any(axis=1), np.argmax(later, axis=1), ABSENT)
    each = np.arange(len(rows))
    rows["n_parents"] = has.sum(axis=1)
    rows["robot_a"] = names[first]
    rows["landmark_a"] = fused.parents[each, first]
    rows["robot_b"] = np.where(second != ABSENT, names[second], "")
    rows["landmark_b"] = np.where(second != ABSENT, fused.parents[each, second], ABSENT)
    return rows


def _write_images(run: JudgedRun, folder: Path) -> None:
    tracks = []
    for robot in run.pipeline.simulated:
        for path in sorted(run.store.path(robot.features).glob("image_*.png")):
            iteration = int(path.stem.removeprefix("image_"))
            link_or_copy(path, folder / "keyframes" / f"{robot.name}_{iteration:05d}.png")
        tracks.append(tables.read(run.store.path(robot.observed) / "tracks.parquet", "tracks"))
    joined = pd.concat(tracks, ignore_index=True) if tracks else []
    tables.write(tables.table_path(folder, "tracks"), "tracks", joined)
