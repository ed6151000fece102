"""The result folder of a run: everything that figures, checks and people read.

`RESULT/tables/*.parquet`, `maps/` (one file a robot, the fused map, and `fused.2` and so on for
robots that only each other's alignments connect), `keyframes/`, `figures/`, `scenario.json`
(resolved), `world.json`, `provenance.json`.
"""

import platform
import shutil
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judge import tables
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.judged_run import JudgedRun
from experiments.judge.table_makers import history_makers, in_order, makers
from experiments.judge.truth import common_landmarks
from experiments.methods.aligner_calls import callable_aligner
from experiments.methods.catalogue import find_method
from experiments.run.code_version import library_versions
from experiments.run.estimates import correspondences_of
from experiments.run.head_start import head_start
from experiments.run.stages.fuse import read_fused_maps
from experiments.run.stages.smooth import read_smoothed
from experiments.run.store import Store, mending
from experiments.run.store_files import link_or_copy
from experiments.run.tasks import OnProgress
from experiments.scenario.randomness import generator
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError
from mapfusion.landmark_map import write_map
from mapfusion.storage import (
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
    measure_aligners(run, team.robots)
    for outdated in ("maps", "keyframes"):  # of robots or frames that are no longer there
        shutil.rmtree(folder / outdated, ignore_errors=True)
    _write_images(run, folder)
    write_json(folder / "world.json", _world(run.scenario, team.robots))
    for name, make in in_order(makers(run, team) | history_makers(run, team)).items():
        tables.write(tables.table_path(folder, name), name, make())
        on_written(folder, name)
    write_json(folder / "scenario.json", run.scenario.resolved())
    on_written(folder, "scenario")
    for name, landmarks in run.last_maps(team.iteration).items():
        write_map(folder / "maps" / f"{name}.parquet", landmarks)
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
            offered = tables.read(path.with_name("correspondences.parquet"), "correspondences")
            robots_of = by_name[pair.a.name], by_name[pair.b.name]
            rows = _time_pair(run.scenario, *robots_of, offered)
            tables.write(path, "aligner_timings", rows)


def _time_pair(
    scenario: AnyScenario, a: EvaluatedRobot, b: EvaluatedRobot, offered: pd.DataFrame
) -> list[dict[str, Any]]:
    """Rows of a pair of robots, to which `offered` are the correspondences at all iterations."""
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
        pairs = correspondences_of(offered[offered["iteration"] == iteration])
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
