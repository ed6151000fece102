"""Result folder of a run: tables, maps and images that figures, checks and users read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, the fused map, and `fused.2` and so on for
robots that only each other's alignments connect), `keyframes/`, `figures/`, `scenario.json`
(resolved), `world.json`, `provenance.json`.
"""

import platform
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation import fused_landmarks, tables
from experiments.evaluation.alignment_errors import EvaluatedRobot
from experiments.evaluation.evaluated_run import TABLES_PART, JudgedRun, finding_rows
from experiments.evaluation.fused_landmarks import (
    FusedTeam,
    fused_history_rows,
    map_history_rows,
    true_pair_rows,
)
from experiments.evaluation.fused_map_errors import JudgedFusion, coverage_rows, fuser_rows
from experiments.evaluation.pair_evaluation import ALIGNED
from experiments.evaluation.path_errors import path_statistics_rows, robot_paths
from experiments.evaluation.result_files import RESULT_SCHEMA_VERSION, require_tables
from experiments.evaluation.smoothed_robots import SmoothedRobot, smoothed_path_rows, smoother_rows
from experiments.evaluation.team_errors import team_pair_rows, team_rows
from experiments.pipeline.code_version import library_versions
from experiments.pipeline.stages import slam
from experiments.pipeline.stages.fuse import fused_map_files
from experiments.pipeline.stages.smooth import map_files, read_smoothed_path
from experiments.pipeline.store import (
    Store,
    file_entries,
    link_or_copy,
    require_undamaged,
    retry_damaged,
)
from experiments.pipeline.tables import read_rows, records
from experiments.pipeline.tasks import OnProgress
from experiments.plugins.discovery import find_method
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.files import (
    POSE_FIELDS,
    named_columns,
    remove_abandoned,
    require_writable,
    write_json,
)
from mapfusion.fusion.fusers import make_fuser
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import joint_path, write_map
from mapfusion.viewing import viewing_paths
from sim.floorplan import Wall
from sim.renderer import renderer_name

Maker = Callable[[], Any]
_LONG = ("fused_map", "fusers", "fuser_coverage")  # to make, of those that figures read
_IN_NO_FIGURE = ("map_history", "fused_history", "path_statistics", "timings")


def all_tables(
    run: JudgedRun, team: FusedTeam, only: Collection[str] = tuple(tables.ALL)
) -> dict[str, pd.DataFrame]:
    """The tables of a finished run's last maps, paths, estimates and errors, by their names.

    Of `only` those, if it is given: a sweep of short runs spends its time on the others.
    """
    made_by = makers(run, team).items()
    return {name: tables.framed(name, make()) for name, make in made_by if name in only}


def in_order(made: Mapping[str, Maker]) -> tuple[dict[str, Maker], dict[str, Maker]]:
    """Those that figures read, what takes long last, and those that no figure reads.

    In this order they are to be written: figures are drawn meanwhile, from what is there.
    """
    of_figures = (name for name in made if name not in _IN_NO_FIGURE)
    first = {name: made[name] for name in sorted(of_figures, key=_LONG.__contains__)}
    return first, {name: made[name] for name in _IN_NO_FIGURE}


def makers(run: JudgedRun, team: FusedTeam) -> dict[str, Maker]:
    """What makes these tables, by their names."""
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

    of_pairs = ("errors", *ALIGNED, "fusion")
    of_all: dict[str, Maker] = {name: partial(run.pair_table, name) for name in of_pairs}
    of_all |= {
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
    judged: dict[str, Maker] = {
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
    of_all |= dict.fromkeys(judged, list) if run.no_truth else judged
    return of_all | {
        "frame_times": lambda: _frame_times(run),
        "findings": lambda: finding_rows(run),
        "smoother": lambda: smoother_rows(smoothed()),
        "team_edges": lambda: fused_landmarks.team_edge_rows(team),
        "timings": lambda: _timings(run),
    }


def history_makers(run: JudgedRun, team: FusedTeam) -> dict[str, Maker]:
    """What makes the tables that a result has beside these, by their names, likewise."""
    no_truth = {"true_pairs": list} if run.no_truth else {}
    return {
        "aligner_timings": lambda: run.pair_table("aligner_timings"),
        "tracks": lambda: _tracks(run),
        "true_pairs": lambda: true_pair_rows(team, run.settings.true_pair_radius_m),
        "map_history": lambda: map_history_rows(team),
        "fused_history": lambda: fused_history_rows(team, run.settings.merge),
    } | no_truth


def timing_row(stage: str, part: str, seconds: float, figure: str = "elapsed_s") -> dict[str, Any]:
    """Return a row of the table `timings`, of a part of a stage, or of what is outside them."""
    return {"stage": stage, "name": f"{part}:{figure}", "elapsed_s": seconds}


def _timings(run: JudgedRun) -> list[dict[str, Any]]:
    of_stages = [
        timing_row(stage.name, stage.key, seconds, figure)
        for stage in run.folders()
        for figure, seconds in stage.figures().items()
    ]
    return of_stages + [timing_row(part, "run", s) for part, s in run.outside_s.items()]


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


def _tracks(run: JudgedRun) -> pd.DataFrame:
    files = [run.store.path(robot.observed) / "tracks.parquet" for robot in run.pipeline.simulated]
    return pd.concat([pd.DataFrame(), *(tables.read(file, "tracks") for file in files)])


OnWritten = Callable[[Path, str], None]
_SUBFOLDERS = ("tables", "maps", "keyframes", "figures")
_LABEL = "write the tables"
_FACE_DECIMALS = 6  # a micrometre: what is beyond is rounding


def require_result(result: Path) -> None:
    """Raise InputError unless the folder holds a finished result with all its tables."""
    for name in ("scenario.json", "tables"):
        if not (result / name).exists():
            raise InputError(f"{result}: not a result folder (no {name}); make one with `run`")
    require_tables(result)


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
        for folder_of_stage in run.folders():
            folder_of_stage.discard()

    def make() -> None:
        run.execute(jobs, on_progress)
        on_progress(_LABEL, 0, 1)
        write_result(run, folder, on_written)
        on_progress(_LABEL, 1, 1)

    retry_damaged(run.store, make)
    return folder


def write_result(
    run: JudgedRun, folder: Path, on_written: OnWritten = lambda folder, part: None
) -> None:
    """Collect a finished plan's tables, maps and images in a result folder.

    `on_written` is told (folder, part) of each table, and of `scenario`, when it is there. World
    and images are there before the first of them.
    """
    with run.timed(TABLES_PART):
        team = run.team
    measure_aligners(run)
    (folder / "provenance.json").unlink(missing_ok=True)  # it lists the files of an earlier run
    with run.timed(TABLES_PART):
        made = _write_parts(run, team, folder, on_written)
    # Times are added to this table later, so the list of files leaves it out.
    files = [folder / "scenario.json", folder / "world.json", *(folder / "maps").glob("*")]
    files += [tables.table_path(folder, name) for name in made if name != "timings"]
    tables.write(tables.table_path(folder, "timings"), "timings", made["timings"]())
    on_written(folder, "timings")
    about = provenance(run) | {"tables": sorted(made), "files": file_entries(folder, files)}
    write_json(folder / "provenance.json", about)


def _write_parts(
    run: JudgedRun, team: FusedTeam, folder: Path, on_written: OnWritten
) -> dict[str, Maker]:
    """Write images, maps and all tables but `timings`; return the makers of all tables by name."""
    for outdated in ("maps", "keyframes"):  # of robots or frames that are no longer there
        shutil.rmtree(folder / outdated, ignore_errors=True)
    _write_images(run, folder)
    write_json(folder / "world.json", _world(run.scenario, team.robots))

    def write_tables(made: Mapping[str, Maker]) -> None:
        for name, make in made.items():
            tables.write(tables.table_path(folder, name), name, make())
            on_written(folder, name)

    of_figures, others = in_order(makers(run, team) | history_makers(run, team))
    write_tables(of_figures)
    write_json(folder / "scenario.json", run.scenario.resolved())
    on_written(folder, "scenario")
    write_tables({name: make for name, make in others.items() if name != "timings"})
    _write_maps(run, folder / "maps")
    return of_figures | others


def add_times(folder: Path, seconds: Mapping[str, Mapping[str, float]]) -> None:
    """Add the times of what follows the tables to the table `timings`.

    Args:
        folder: of a result.
        seconds: of work, by the part of the run and by what it made.
    """
    path = tables.table_path(folder, "timings")
    more = [
        timing_row(part, name, value)
        for part, by_name in seconds.items()
        for name, value in by_name.items()
    ]
    tables.write(path, "timings", [*records(tables.read(path, "timings")), *more])


def measure_aligners(run: JudgedRun) -> None:
    """Time every aligner on each pair's maps of growing overlap; a table already there is kept.

    Serially, when all else is done: nothing else may be running.
    """
    for pair, path in run.untimed():
        with run.timed("timing the aligners"):
            timing = run.timings[pair.a.name, pair.b.name]
            remove_abandoned(path.parent)
            tables.write(path, "aligner_timings", timing.rows())


def _write_maps(run: JudgedRun, folder: Path) -> None:
    for name, landmarks in run.last_maps(run.team.iteration).items():
        write_map(folder / f"{name}.parquet", landmarks)
    for robot in run.pipeline.robots:
        smooth, last = run.store.path(robot.smooth), robot.n_frames - 1
        if last in read_smoothed_path(smooth):
            _put_map(map_files(smooth, last)[0], folder / f"{robot.name}.smoothed.parquet")
    if fuser := run.pipeline.fusers.get(run.scenario.merge.fuser):
        for k, fused in enumerate(fused_map_files(run.store.path(fuser)), start=1):
            _put_map(fused, folder / ("fused.parquet" if k == 1 else f"fused.{k}.parquet"))


def _put_map(source: Path, target: Path) -> None:
    """A map as it is stored, with what lies beside it."""
    sources, targets = ((path, joint_path(path), *viewing_paths(path)) for path in (source, target))
    for own, place in zip(sources, targets, strict=True):
        if own.is_file():
            link_or_copy(own, place)


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


def _write_images(run: JudgedRun, folder: Path) -> None:
    for robot in run.pipeline.simulated:
        require_undamaged(run.store.path(robot.features), "image_*.png")
        for path in sorted(run.store.path(robot.features).glob("image_*.png")):
            iteration = int(path.stem.removeprefix("image_"))
            link_or_copy(path, folder / "keyframes" / f"{robot.name}_{iteration:05d}.png")
