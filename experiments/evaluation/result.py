"""Result folder of a run: tables, maps and images for figures, checks and users.

A result folder has `tables/*.parquet`, `maps/`, `keyframes/`, `figures/`, `scenario.json`
(resolved), `world.json` and `provenance.json`. The folder `maps/` has one file for each robot and
the fused map. Further fused maps, `fused.2` and so on, are of groups of robots that no accepted
alignment connects to the first.
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

from experiments.evaluation import adoption, fused_landmarks, tables
from experiments.evaluation.adoption import TeamMember
from experiments.evaluation.evaluated_run import TABLES_PART, EvaluatedRun, finding_rows
from experiments.evaluation.fused_landmarks import (
    FusedTeam,
    fused_history_rows,
    map_history_rows,
    true_pair_rows,
)
from experiments.evaluation.loop_closures import sighting_rows
from experiments.evaluation.map_errors import (
    ALIGNED,
    EvaluatedFusion,
    SmoothedRobot,
    coverage_rows,
    smoothed_path_rows,
)
from experiments.evaluation.path_errors import (
    path_statistics_rows,
    robot_paths,
    team_pair_rows,
    team_rows,
)
from experiments.evaluation.tables import RESULT_SCHEMA_VERSION, require_tables
from experiments.evaluation.truth import EvaluatedRobot, truth_or_unknown
from experiments.pipeline.stage import library_versions
from experiments.pipeline.stages import slam
from experiments.pipeline.stages.fuse import fused_map_files
from experiments.pipeline.stages.smooth import map_files, read_smoothed_path, stored_maps
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
from mapfusion.landmark_map import joint_path, write_map
from mapfusion.viewing import viewing_paths
from sim.floorplan import Wall
from sim.renderer import renderer_name

TableMaker = Callable[[], Any]  # returns the rows of a table
_SLOW = ("fused_map", "fusers", "fuser_coverage")  # tables of figures that take long to compute
_IN_NO_FIGURE = ("fused_history", "path_statistics", "timings")


def all_tables(
    run: EvaluatedRun, team: FusedTeam, only: Collection[str] = tuple(tables.ALL)
) -> dict[str, pd.DataFrame]:
    """Return tables of a finished run by name, without those of `history_table_makers`.

    Args:
        run: the run.
        team: its last maps, merged.
        only: names of the tables that are needed.
    """
    makers = table_makers(run, team).items()
    return {name: tables.as_table(name, make()) for name, make in makers if name in only}


def table_makers(run: EvaluatedRun, team: FusedTeam) -> dict[str, TableMaker]:
    """Return functions that compute the tables of last maps, paths, estimates and errors."""
    settings, scenario = run.settings, run.scenario

    @cache
    def smoothed() -> list[SmoothedRobot]:
        return run.load_smoothed(team.robots)

    @cache
    def paths() -> pd.DataFrame:
        """Return the rows of `paths` and `robots`, with the smoothed path."""
        parts = []
        for stages, each in zip(run.pipeline.robots, smoothed(), strict=True):
            poses = read_rows(run.store.path(stages.slam) / "poses.parquet", slam.POSES)
            poses, log = poses.assign(robot=each.robot.name), run.logs[stages.name]
            rows = robot_paths(poses, log.odometry, each.robot.path)
            names = [f"smoothed_{name}" for name in POSE_FIELDS]
            parts.append(rows.assign(**named_columns(names, each.last_path)))
        return pd.concat(parts, ignore_index=True)

    @cache
    def fusions() -> list[EvaluatedFusion]:
        return run.load_fusions(team.robots, smoothed())

    def fused_map() -> pd.DataFrame:
        chosen = [fusion for fusion in fusions() if fusion.fuser == scenario.merge.fuser]
        last = max(chosen, key=lambda fusion: fusion.iteration, default=None)
        return pd.DataFrame() if last is None else fused_landmarks.fused_rows(last.team())

    def team_paths() -> list[dict[str, Any]]:
        # The last fusion of smoothed maps, if possible by `merge.fuser`, places smoothed paths.
        smoothing = [fusion for fusion in fusions() if make_fuser(fusion.fuser).smoothed]
        chosen = [fusion for fusion in smoothing if fusion.fuser == scenario.merge.fuser]
        last = max(chosen or smoothing, key=lambda fusion: fusion.iteration, default=None)
        return team_rows(team, paths(), None if last is None else last.fusion.T_first_map)

    def sightings() -> pd.DataFrame:
        parts = []
        for robot in run.pipeline.robots:
            log, last = run.logs[robot.name], stored_maps(run.robot_folders(robot), viewing=False)
            source = last.associations.at(len(log) - 1, len(log.observations))
            parts.append(sighting_rows(log, source).assign(robot=robot.name))
        return pd.concat(parts, ignore_index=True)

    def clouds() -> pd.DataFrame:
        parts = []
        for robot in run.pipeline.robots:
            rows = read_rows(run.store.path(robot.slam) / "clouds.parquet", slam.CLOUDS)
            parts.append(rows.assign(robot=robot.name))
        return pd.concat(parts, ignore_index=True)

    def frame_times() -> pd.DataFrame:
        parts = [
            pd.DataFrame({"robot": name, "iteration": np.arange(len(log)), "time_s": log.time_s})
            for name, log in run.logs.items()
        ]
        return pd.concat(parts, ignore_index=True)

    def timings() -> list[dict[str, Any]]:
        rows = [
            timing_row(stage.name, stage.key, seconds, quantity)
            for stage in run.folders()
            for quantity, seconds in stage.quantities().items()
        ]
        return rows + [timing_row(part, "run", s) for part, s in run.outside_s.items()]

    def landmarks() -> pd.DataFrame:
        iteration, rows = team.iteration, fused_landmarks.landmark_rows
        parts = [rows(robot, *robot.at(iteration)) for robot in team.robots]
        return pd.concat(parts, ignore_index=True)

    def team_pairs() -> pd.DataFrame:
        return team_pair_rows(team, run.pair_table("errors"), settings.merge.aligner)

    def landmark_nees() -> list[dict[str, Any]]:
        return fused_landmarks.landmark_nees_rows(team, settings.true_pair_radius_m)

    @cache
    def members() -> list[TeamMember]:
        stages = run.pipeline.robots if run.pipeline.team is not None else ()
        return [
            TeamMember(
                each.name,
                truth_or_unknown(run.store.path(each.log), run.logs[each.name]),
                run.store.path(each.slam),
                read_smoothed_path(run.store.path(each.smooth)),
            )
            for each in stages
        ]

    def of_team(rows: Callable[[Path, Sequence[TeamMember]], Any]) -> TableMaker:
        stage = run.pipeline.team
        return list if stage is None else lambda: rows(run.store.path(stage), members())

    of_pairs = ("errors", *ALIGNED, "fusion", "smoothed_errors", "smoothed_estimates")
    makers: dict[str, TableMaker] = {name: partial(run.pair_table, name) for name in of_pairs}
    makers |= {
        "landmarks": landmarks,
        "paths": paths,
        "robots": paths,
        "sightings": sightings,
        "clouds": clouds,
        "smoothed_paths": lambda: smoothed_path_rows(smoothed()),
        "fused": lambda: fused_landmarks.fused_rows(team),
        "fused_motions": lambda: fused_landmarks.fused_motion_rows(team),
        "fused_map": fused_map,
        "adoptions": of_team(adoption.event_rows),
        "team_members": of_team(adoption.member_rows),
        "messages": of_team(adoption.message_rows),
    }
    with_truth: dict[str, TableMaker] = {
        "fusers": lambda: [fusion.row() for fusion in fusions()],
        "fuser_coverage": lambda: coverage_rows(fusions()),
        "path_statistics": lambda: path_statistics_rows(paths()),
        "team": team_paths,
        "team_pairs": team_pairs,
        "map_fits": lambda: fused_landmarks.map_fit_rows(team),
        "landmark_nees": landmark_nees,
    }
    makers |= dict.fromkeys(with_truth, list) if run.no_truth else with_truth
    if not all(robot.surveyed for robot in team.robots):
        makers |= dict.fromkeys(("map_fits", "landmark_nees"), list)  # errors of landmarks
    return makers | {
        "frame_times": frame_times,
        "findings": lambda: finding_rows(run),
        "smoother": lambda: [each.row() for each in smoothed()],
        "team_edges": lambda: fused_landmarks.team_edge_rows(team),
        "timings": timings,
    }


def history_table_makers(run: EvaluatedRun, team: FusedTeam) -> dict[str, TableMaker]:
    """Return functions that compute the other tables: tracks, histories, times of aligners."""

    def tracks() -> pd.DataFrame:
        folders = [run.store.path(robot.observed) for robot in run.pipeline.simulated]
        parts = [tables.read(folder / "tracks.parquet", "tracks") for folder in folders]
        return pd.concat([pd.DataFrame(), *parts])

    no_truth = {"true_pairs": list} if run.no_truth else {}
    return {
        "aligner_timings": lambda: run.pair_table("aligner_timings"),
        "tracks": tracks,
        "true_pairs": lambda: true_pair_rows(team, run.settings.true_pair_radius_m),
        "map_history": lambda: map_history_rows(team),
        "fused_history": lambda: fused_history_rows(team, run.settings.merge),
    } | no_truth


def timing_row(stage: str, part: str, seconds: float, figure: str = "elapsed_s") -> dict[str, Any]:
    """Return a row of the table `timings`, of a stage or of a part of the run outside stages."""
    return {"stage": stage, "name": f"{part}:{figure}", "elapsed_s": seconds}


OnWritten = Callable[[Path, str], None]
_SUBFOLDERS = ("tables", "maps", "keyframes", "figures")
_LABEL = "write the tables"
_FACE_DECIMALS = 6  # a micrometre; further decimals are rounding errors


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
    """Run a scenario and write its result.

    Args:
        scenario: the scenario.
        results: folder of results and of the store.
        jobs: number of processes.
        on_progress: called with the number of finished tasks.
        fresh: discard stored stages first.
        output: folder of the result; `results/NAME-SEED` by default.
        on_written: is called as by `write_result`.

    Returns:
        The folder of the result.
    """
    run = EvaluatedRun.of(scenario, Store.of(results))
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
    run: EvaluatedRun, folder: Path, on_written: OnWritten = lambda folder, part: None
) -> None:
    """Write tables, maps and images of a finished run into a result folder.

    Args:
        run: the run.
        folder: folder of the result.
        on_written: is called with the folder and the name of each table after it was written, and
            with `scenario`. World and images are written before the first table.
    """
    with run.timed(TABLES_PART):
        team = run.team
    measure_aligners(run)
    (folder / "provenance.json").unlink(missing_ok=True)  # it lists the files of an earlier run

    def write_table(name: str, make: TableMaker) -> None:
        tables.write(tables.table_path(folder, name), name, make())
        on_written(folder, name)

    with run.timed(TABLES_PART):
        for outdated in ("maps", "keyframes"):  # may have other robots and frames
            shutil.rmtree(folder / outdated, ignore_errors=True)
        for robot in run.pipeline.simulated:
            features = run.store.path(robot.features)
            require_undamaged(features, "image_*.png")
            for path in sorted(features.glob("image_*.png")):
                iteration = int(path.stem.removeprefix("image_"))
                link_or_copy(path, folder / "keyframes" / f"{robot.name}_{iteration:05d}.png")
        write_json(folder / "world.json", _world(run.scenario, team.robots))
        # Figures are drawn while tables are written: the tables that they read come first, with
        # the slow ones at the end.
        makers = table_makers(run, team) | history_table_makers(run, team)
        shown = (name for name in makers if name not in _IN_NO_FIGURE)
        of_figures = {name: makers[name] for name in sorted(shown, key=_SLOW.__contains__)}
        others = {name: makers[name] for name in _IN_NO_FIGURE}
        for name, make in of_figures.items():
            write_table(name, make)
        write_json(folder / "scenario.json", run.scenario.resolved())
        on_written(folder, "scenario")
        make_timings = others.pop("timings")
        for name, make in others.items():
            write_table(name, make)
        maps = folder / "maps"
        for name, landmarks in run.last_maps(team.iteration).items():
            write_map(maps / f"{name}.parquet", landmarks)
        for robot in run.pipeline.robots:
            smooth, last = run.store.path(robot.smooth), robot.n_frames - 1
            if last in read_smoothed_path(smooth):
                _put_map(map_files(smooth, last)[0], maps / f"{robot.name}.smoothed.parquet")
        if fuser := run.pipeline.fusers.get(run.scenario.merge.fuser):
            for k, fused in enumerate(fused_map_files(run.store.path(fuser)), start=1):
                _put_map(fused, maps / ("fused.parquet" if k == 1 else f"fused.{k}.parquet"))
    # Figures add their times to `timings` later, so the list of files does not include this table.
    names = [*of_figures, *others]
    files = [folder / "scenario.json", folder / "world.json", *maps.glob("*")]
    files += [tables.table_path(folder, name) for name in names]
    write_table("timings", make_timings)
    written = {"tables": sorted([*names, "timings"]), "files": file_entries(folder, files)}
    write_json(folder / "provenance.json", provenance(run) | written)


def add_times(folder: Path, seconds: Mapping[str, Mapping[str, float]]) -> None:
    """Add the times of work after the tables to the table `timings`.

    Args:
        folder: folder of a result.
        seconds: times in s, by part of the run and by name.
    """
    path = tables.table_path(folder, "timings")
    more = [
        timing_row(part, name, value)
        for part, by_name in seconds.items()
        for name, value in by_name.items()
    ]
    tables.write(path, "timings", [*records(tables.read(path, "timings")), *more])


def measure_aligners(run: EvaluatedRun) -> None:
    """Time every aligner on pairs of maps, unless the table `aligner_timings` exists.

    Aligners run one after the other. No other process may be busy.
    """
    for pair, path in run.untimed():
        with run.timed("timing the aligners"):
            timing = run.timings[pair.a.name, pair.b.name]
            remove_abandoned(path.parent)
            tables.write(path, "aligner_timings", timing.rows())


def _put_map(source: Path, target: Path) -> None:
    """Copy a stored map with the files that belong to it."""
    sources, targets = ((path, joint_path(path), *viewing_paths(path)) for path in (source, target))
    for stored, copy in zip(sources, targets, strict=True):
        if stored.is_file():
            link_or_copy(stored, copy)


def _world(scenario: AnyScenario, robots: Sequence[EvaluatedRobot]) -> dict[str, object]:
    """Return walls and true start poses, the background of figures."""
    plan = scenario.world if isinstance(scenario, Simulation) else None
    walls = plan.walls if plan is not None else []
    thickness_m = plan.wall_thickness_m if plan is not None else 0.0
    solid = [Wall(np.array(wall.points), thickness_m=thickness_m) for wall in walls]
    faces = [edge.round(_FACE_DECIMALS).tolist() for wall in solid for edge in wall.outline()]
    known = [robot for robot in robots if np.isfinite(robot.path.T_world_map).all()]
    starts = {robot.name: robot.path.T_world_map.tolist() for robot in known}
    return {"walls": [list(wall.points) for wall in walls], "faces": faces, "robots": starts}


def renderer(scenario: AnyScenario) -> str:
    """Return the name of the renderer."""
    if isinstance(scenario, Simulation):
        return renderer_name(scenario.render.renderer)
    return "none (imported logs)"


def provenance(run: EvaluatedRun) -> dict[str, Any]:
    """Return a description of a run as JSON values, for its reproduction."""
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
