"""The result folder of a run: everything that figures, checks and people read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, the fused map, and `fused.2` and so on for
robots that only each other's alignments connect), `keyframes/`, `figures/`, `scenario.json`
(resolved), `world.json`, `provenance.json`.
"""

import platform
import shutil
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.judged_run import JudgedRun
from experiments.judge.result_files import RESULT_SCHEMA_VERSION, require_tables
from experiments.judge.table_makers import Maker, history_makers, in_order, makers
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.head_start import head_start
from experiments.run.stages.fuse import fused_map_files
from experiments.run.stages.smooth import map_files, read_smoothed_path
from experiments.run.store import Store, mending
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.joint_files import joint_path
from mapfusion.landmark_map import write_map
from mapfusion.storage import (
    remove_abandoned,
    require_writable,
    write_json,
)
from mapfusion.viewing_files import viewing_paths
from sim.floorplan import Wall
from sim.renderer import renderer_name

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
        head = head_start(run.pipeline)
        for stage in [*run.stages(), *([head] if head else [])]:
            run.store.folder(stage).discard()

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
    team = run.team
    measure_aligners(run)
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
    write_tables(others)
    _write_maps(run, folder / "maps")
    about = provenance(run) | {"tables": sorted([*of_figures, *others])}
    write_json(folder / "provenance.json", about)


def measure_aligners(run: JudgedRun) -> None:
    """Time every aligner on each pair's maps of growing overlap; a table already there is kept.

    Serially, when all else is done: nothing else may be running.
    """
    for pair, path in run.untimed():
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
        for path in sorted(run.store.path(robot.features).glob("image_*.png")):
            iteration = int(path.stem.removeprefix("image_"))
            link_or_copy(path, folder / "keyframes" / f"{robot.name}_{iteration:05d}.png")
