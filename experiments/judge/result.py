"""The result folder of a run: everything that figures, checks and people read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, the fused map, and `fused.2` and so on for
robots that only each other's alignments connect), `keyframes/`, `figures/`, `scenario.json`
(resolved), `world.json`, `provenance.json`.
"""

import platform
import shutil
from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge import fused_landmarks, tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.fused_landmarks import FusedTeam
from experiments.judge.fuser_coverage import coverage_rows
from experiments.judge.judged_fusers import JudgedFusion, fuser_rows
from experiments.judge.judged_run import JudgedRun
from experiments.judge.judging import ALIGNED
from experiments.judge.map_history import (
    fused_history_rows,
    map_history_rows,
    true_pair_rows,
)
from experiments.judge.path_errors import path_statistics_rows, robot_paths
from experiments.judge.smoothed_robots import SmoothedRobot, smoothed_path_rows, smoother_rows
from experiments.judge.team_figures import team_pair_rows, team_rows
from experiments.judge.truth import common_landmarks
from experiments.methods.aligner_calls import callable_aligner
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.frames import read_rows
from experiments.run.stages import slam
from experiments.run.stages.fuse import read_fused_maps
from experiments.run.stages.smooth import read_smoothed
from experiments.run.store import Store, mending
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.align.correspondences import match
from mapfusion.errors import InputError
from mapfusion.fuse.registry import make_fuser
from mapfusion.landmark_map import write_map
from mapfusion.se2 import Float
from mapfusion.storage import (
    POSE_FIELDS,
    named_columns,
    remove_abandoned,
    require_writable,
    write_json,
)
from sim.floorplan import Wall
from sim.renderer import renderer_name

RESULT_SCHEMA_VERSION = 1
OnWritten = Callable[[Path, str], None]
_SUBFOLDERS = ("tables", "maps", "keyframes", "figures")
_LABEL = "write the tables"
_FACE_DECIMALS = 6  # a micrometre: what is beyond is rounding
_WARM_UP_RUNS = 1  # compilation and caches


def require_result(result: Path) -> None:
    """Raise InputError unless the folder holds a finished result."""
    for name in ("scenario.json", "tables"):
        if not (result / name).exists():
            raise InputError(f"{result}: not a result folder (no {name}); make one with `run`")


def run_scenario(
    scenario: AnyScenario,
    results: Path,
    jobs: int,
    on_progress: OnProgress,
    fresh: bool = False,
    output: Path | None = None,
    on_written: OnWritten = lambda folder, part: None,
) -> Path:
    """Run a scenario and write its result, to `RESULTS/NAME-SEED` by default; returns the folder.

    The store is that of `results`. `on_written` is told (folder, part) as `write_result` has it.
    """
    run = JudgedRun.of(scenario, Store.of(results))
    folder = output or results / f"{scenario.name}-{scenario.seed}"
    for place in (run.store.root, folder, *(folder / name for name in _SUBFOLDERS)):
        require_writable(place)
    remove_abandoned(folder)
    if fresh:
        for stage_folder in run.folders():
            stage_folder.discard()

    def make() -> None:
        run.execute(jobs, on_progress)
        on_progress(_LABEL, 0, 1)
        write_result(run, folder, on_written)
        on_progress(_LABEL, 1, 1)

    mending(run.store, make)
    return folder


def write_result(
    run: JudgedRun, folder: Path, on_written: OnWritten = lambda folder, part: None
) -> None:
    """Collect a finished plan's tables, maps and images in a result folder.

    `on_written` is told (folder, part) of each table, and of `scenario`, when it is there. World
    and images are there before the first of them.
    """
    team = run.load_team()
    measure_aligners(run, team.robots)
    for outdated in ("maps", "keyframes"):  # of robots or frames that are no longer there
        shutil.rmtree(folder / outdated, ignore_errors=True)
    _write_images(run, folder)
    write_json(folder / "world.json", _world(run.scenario, team.robots))
    own = {
        "aligner_timings": lambda: run.pair_table("aligner_timings"),
        "tracks": lambda: _tracks(run),
    }
    for name, make in (own | _makers(run, team) | _history(run, team)).items():
        tables.write(tables.table_path(folder, name), name, make())
        on_written(folder, name)
    write_json(folder / "scenario.json", run.scenario.resolved())
    on_written(folder, "scenario")
    for robot in team.robots:
        write_map(folder / "maps" / f"{robot.name}.parquet", robot.at(team.iteration)[0])
    for robot in run.pipeline.robots:
        if smoothed := read_smoothed(run.store.path(robot.smooth)).get(robot.n_frames - 1):
            write_map(folder / "maps" / f"{robot.name}.smoothed.parquet", smoothed)
    if fuser := run.pipeline.fusers.get(run.scenario.merge.fuser):
        for k, fused in enumerate(read_fused_maps(run.store.path(fuser)), start=1):
            name = "fused.parquet" if k == 1 else f"fused.{k}.parquet"
            write_map(folder / "maps" / name, fused)
    write_json(folder / "provenance.json", provenance(run))


def measure_aligners(run: JudgedRun, robots: Sequence[EvaluatedRobot]) -> None:
    """Time every aligner on each pair's maps of growing overlap; a table already there is kept.

    Serially, when all else is done: nothing else may be running.
    """
    by_name = {robot.name: robot for robot in robots}
    for pair in run.pipeline.pairs:
        path = run.store.path(pair.estimates) / "aligner_timings.parquet"
        if not path.is_file():
            remove_abandoned(path.parent)
            rows = _time_pair(run.scenario, by_name[pair.a.name], by_name[pair.b.name])
            tables.write(path, "aligner_timings", rows)


def _time_pair(scenario: AnyScenario, a: EvaluatedRobot, b: EvaluatedRobot) -> list[dict[str, Any]]:
    settings, iterations = scenario.evaluate, np.array(sorted({*a.maps, *b.maps}))
    spread = np.linspace(0, len(iterations) - 1, settings.timing_points)
    repeats = range(_WARM_UP_RUNS + settings.timing_repeats)
    aligners = {
        entry.name: callable_aligner(entry.method, entry.parameters, entry.time_limit_s)
        for entry in scenario.align.aligners
    }
    rows = []
    for iteration in iterations[np.unique(spread.round().astype(int))].tolist():
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pairs = match(map_a, map_b, scenario.align.match)
        known = np.isfinite(points_a).any() and np.isfinite(points_b).any()
        n_common = common_landmarks(points_a, points_b, settings.true_pair_radius_m)
        n_common = n_common if known else tables.UNKNOWN
        maps = {"robot_a": a.name, "robot_b": b.name, "iteration": iteration}
        maps |= {"n_correspondences": len(pairs), "n_common": n_common}
        for name, aligner in aligners.items():
            rngs = (generator(scenario.seed, "timing", name, repeat) for repeat in repeats)
            elapsed = [aligner.align(map_a, map_b, pairs, rng).elapsed_s for rng in rngs]
            low, median, high = np.percentile(elapsed[_WARM_UP_RUNS:], [10, 50, 90])
            times = {"elapsed_s": median, "elapsed_low_s": low, "elapsed_high_s": high}
            rows.append({**maps, "aligner": name, **times})
    return rows


def all_tables(
    run: JudgedRun, team: FusedTeam, only: Collection[str] = tuple(tables.ALL)
) -> dict[str, pd.DataFrame]:
    """The tables of a finished run's last maps, paths, estimates and errors, by their names.

    Of `only` those, if it is given: a sweep of short runs spends its time on the others.
    """
    makers = _makers(run, team).items()
    return {name: tables.framed(name, make()) for name, make in makers if name in only}


def _makers(run: JudgedRun, team: FusedTeam) -> dict[str, Callable[[], Any]]:
    """What makes these tables, by their names: first those that figures wait for."""
    settings = run.settings

    @cache
    def smoothed() -> list[SmoothedRobot]:
        return run.load_smoothed(team.robots)

    @cache
    def paths() -> pd.DataFrame:
        return _paths(run, smoothed())

    @cache
    def fusions() -> list[JudgedFusion]:
        return run.load_fusions(team.robots, smoothed())

    makers: dict[str, Callable[[], Any]] = {
        name: partial(run.pair_table, name) for name in ("errors", *ALIGNED, "fusion")
    }
    makers |= {
        "landmarks": lambda: pd.concat(
            [fused_landmarks.landmark_rows(r, *r.at(team.iteration)) for r in team.robots],
            ignore_index=True,
        ),
        "paths": paths,
        "robots": paths,
        "clouds": lambda: _clouds(run),
        "smoothed_paths": lambda: smoothed_path_rows(smoothed()),
        "fused": lambda: fused_landmarks.fused_rows(team),
        "fused_motions": lambda: fused_landmarks.fused_motion_rows(team),
        "fused_map": lambda: _fused_map_rows(run, fusions()),
    }
    judged: dict[str, Callable[[], Any]] = {
        "fusers": lambda: fuser_rows(fusions()),
        "fuser_coverage": lambda: coverage_rows(fusions()),
        "path_statistics": lambda: path_statistics_rows(paths()),
        "team": lambda: team_rows(team, paths(), _placed_by_smoothed(run, fusions())),
        "team_pairs": lambda: team_pair_rows(
            team, run.pair_table("errors"), settings.merge.aligner
        ),
        "map_fits": lambda: fused_landmarks.map_fit_rows(team),
        "landmark_nees": lambda: fused_landmarks.landmark_nees_rows(
            team, settings.true_pair_radius_m
        ),
    }
    makers |= dict.fromkeys(judged, list) if run.no_truth else judged
    return makers | {
        "frame_times": lambda: _frame_times(run),
        "smoother": lambda: smoother_rows(smoothed()),
        "team_edges": lambda: fused_landmarks.team_edge_rows(team),
        "timings": lambda: [
            {"stage": stage.name, "name": f"{stage.key}:{name}", "elapsed_s": seconds}
            for stage in run.folders()
            for name, seconds in stage.figures().items()
        ],
    }


def _history(run: JudgedRun, team: FusedTeam) -> dict[str, Callable[[], Any]]:
    """What makes the tables of all evaluated maps, by their names."""
    no_truth = {"true_pairs": list} if run.no_truth else {}
    return {
        "true_pairs": lambda: true_pair_rows(team, run.settings.true_pair_radius_m),
        "map_history": lambda: map_history_rows(team),
        "fused_history": lambda: fused_history_rows(team, run.settings.merge),
    } | no_truth


def _fused_map_rows(run: JudgedRun, fusions: Sequence[JudgedFusion]) -> pd.DataFrame:
    named = [fusion for fusion in fusions if fusion.fuser == run.scenario.merge.fuser]
    last = max(named, key=lambda fusion: fusion.iteration, default=None)
    return pd.DataFrame() if last is None else fused_landmarks.fused_rows(last.team())


def _placed_by_smoothed(run: JudgedRun, fusions: Sequence[JudgedFusion]) -> Float | None:
    """T_first_map (M, 3) of the last map of a fuser of smoothed maps; of `merge.fuser` if it is."""
    takes = [fusion for fusion in fusions if make_fuser(fusion.fuser).smoothed]
    named = [fusion for fusion in takes if fusion.fuser == run.scenario.merge.fuser]
    last = max(named or takes, key=lambda fusion: fusion.iteration, default=None)
    return None if last is None else last.fusion.T_first_map


def _paths(run: JudgedRun, smoothed: Sequence[SmoothedRobot]) -> pd.DataFrame:
    """Rows of the table `paths`, with the smoothed path beside its columns."""
    paths = []
    for stages, each in zip(run.pipeline.robots, smoothed, strict=True):
        poses = read_rows(run.store.path(stages.slam) / "poses.parquet", slam.POSES)
        poses, log = poses.assign(robot=each.robot.name), run.logs[stages.name]
        rows = robot_paths(poses, log.odometry, each.robot.path)
        names = [f"smoothed_{name}" for name in POSE_FIELDS]
        paths.append(rows.assign(**named_columns(names, each.last_path)))
    return pd.concat(paths, ignore_index=True)


def _frame_times(run: JudgedRun) -> pd.DataFrame:
    parts = [
        pd.DataFrame({"robot": name, "iteration": np.arange(len(log)), "time_s": log.time_s})
        for name, log in run.logs.items()
    ]
    return pd.concat(parts, ignore_index=True)


def _clouds(run: JudgedRun) -> pd.DataFrame:
    folders = ((each.name, run.robot_folders(each).slam) for each in run.pipeline.robots)
    clouds = [
        read_rows(folder / "clouds.parquet", slam.CLOUDS).assign(robot=name)
        for name, folder in folders
    ]
    return pd.concat(clouds, ignore_index=True)


def _world(scenario: AnyScenario, robots: Sequence[EvaluatedRobot]) -> dict[str, object]:
    """The truth that figures show as background."""
    plan = scenario.world if isinstance(scenario, Simulation) else None
    walls = plan.walls if plan is not None else []
    thick = plan.wall_thickness_m if plan is not None else 0.0
    solid = [Wall(np.array(wall.points), thickness_m=thick) for wall in walls]
    faces = [edge.round(_FACE_DECIMALS).tolist() for wall in solid for edge in wall.outline()]
    known = [robot for robot in robots if np.isfinite(robot.path.T_world_map).all()]
    starts = {robot.name: robot.path.T_world_map.tolist() for robot in known}
    return {"walls": [list(wall.points) for wall in walls], "faces": faces, "robots": starts}


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
