"""Plan of a run before it starts: tasks to do, with an estimate of time and memory.

The time of a stage is estimated from its number of frames or pairs of maps, with the rates of
earlier runs in the same folder of results, else with typical rates.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from experiments.evaluation import tables
from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.tables import read_scenario
from experiments.pipeline.stage import Stage
from experiments.pipeline.stages.drive import DriveSettings, require_drive
from experiments.pipeline.stages.pipeline import process_bytes, require_memory
from experiments.pipeline.store import Store
from experiments.pipeline.tasks import task_names
from experiments.scenario.loading import scenario_of
from experiments.scenario.settings import AnyScenario, Simulation
from mapfusion.errors import InputError

# Seconds of work in one process per frame of a robot (images to smoothed maps, drive, and each
# fuser's frames), per pair of maps (match to judge, for each aligner), or per run. Medians of
# `quick` and `paper` on two cores of a server of 2023; another machine may need half or twice it.
_TYPICAL_S: Mapping[str, float] = {
    "drive": 0.006,
    "faces": 1.0,
    "features tiny": 0.3,
    "features egl": 0.3,
    "features raycast": 0.025,
    "observed": 0.008,
    "log": 0.0004,
    "slam": 0.01,
    "team": 0.03,
    "smooth": 0.02,
    "match": 0.15,
    "aligner": 0.05,
    "fuse": 0.003,
    "align": 0.008,
    "judge": 0.1,
}
_OUTSIDE_S = 10.0  # tables, figures and imports, which a run does every time
_MOST_RUNS = 10  # earlier runs that are read for their rates, the latest ones


@dataclass(frozen=True)
class PlannedStage:
    """Stages of one name in a plan: tasks to do and done, and the estimated work that is left."""

    name: str
    to_do: int
    finished: int
    work_s: float


@dataclass(frozen=True)
class RunPlan:
    """Plan of one run.

    Attributes:
        scenario: the scenario.
        n_frames: frames of each robot by name.
        stages: stages by name, in the order of the run.
        work_s: estimated work of one process at a time that is left.
        elapsed_s: estimated duration.
        process_bytes: estimated memory of each process.
        n_earlier: number of earlier runs that the estimate is based on; 0 for typical rates.
    """

    scenario: AnyScenario
    n_frames: Mapping[str, int]
    stages: tuple[PlannedStage, ...]
    work_s: float
    elapsed_s: float
    process_bytes: float
    n_earlier: int


def require_drive_of(run: EvaluatedRun) -> None:
    """Raise InputError if the robots of a simulation cannot drive as the scenario says."""
    for robot in run.pipeline.simulated[:1]:  # all robots have the same drive
        driven = robot.features.before["drive"]
        assert isinstance(driven, Stage)
        assert isinstance(driven.settings, DriveSettings)
        try:
            require_drive(driven.settings)
        except InputError as error:
            raise InputError(f"scenario {run.scenario.name}: {error}") from error


def plan_run(scenario: AnyScenario, results: Path, jobs: int, fresh: bool = False) -> RunPlan:
    """Plan a run; nothing is computed.

    Args:
        scenario: the scenario.
        results: folder of results and of the store.
        jobs: number of processes.
        fresh: True if finished stages are computed again.

    Raises:
        InputError: a recorded log cannot be read, the robots cannot drive as the scenario says, or
            the machine has too little memory.
    """
    run = EvaluatedRun.of(scenario, Store.of(results))
    require_drive_of(run)
    require_memory(run.pipeline, jobs)
    rates, n_earlier = _rates_of_earlier_runs(results)
    rates, amounts = dict(_TYPICAL_S) | rates, _amounts(run)
    to_do, finished, work_s = Counter[str](), Counter[str](), defaultdict[str, float](float)
    ends_s: dict[Stage, float] = {}  # earliest end of each stage
    for stage in run.stages():
        names = task_names(stage)
        left = [name for name in names if fresh or not run.tasks[name].finished]
        own_s = rates[_kind(stage, scenario)] * amounts[stage] * len(left) / len(names)
        begin_s = max((ends_s[each] for each in stage.before.values() if each in ends_s), default=0)
        ends_s[stage] = begin_s + own_s / min(len(names), jobs)
        to_do[stage.name] += len(left)
        finished[stage.name] += len(names) - len(left)
        work_s[stage.name] += own_s
    total_s = sum(work_s.values())
    stages = tuple(PlannedStage(n, to_do[n], finished[n], work_s[n]) for n in to_do)
    elapsed_s = _OUTSIDE_S + max(total_s / jobs, *ends_s.values())
    n_frames = {robot.name: robot.n_frames for robot in run.pipeline.robots}
    memory = process_bytes(run.pipeline)
    return RunPlan(scenario, n_frames, stages, total_s + _OUTSIDE_S, elapsed_s, memory, n_earlier)


def _kind(stage: Stage, scenario: AnyScenario) -> str:
    """Return the name that a stage's rate is known by; images depend on the renderer."""
    if stage.name == "features" and isinstance(scenario, Simulation):
        return f"features {scenario.render.renderer}"
    return stage.name


def _amounts(run: EvaluatedRun) -> dict[Stage, float]:
    """Return the amount of work of each stage, in the units of `_TYPICAL_S`."""
    pipeline = run.pipeline
    amounts: dict[Stage, float] = dict.fromkeys(run.stages(), 1.0)
    frames = sum(robot.n_frames for robot in pipeline.robots)
    for robot in pipeline.robots:
        amounts |= dict.fromkeys((robot.slam, robot.smooth), float(robot.n_frames))
    for robot in pipeline.simulated:
        own = (robot.features, robot.observed, robot.log)
        amounts |= dict.fromkeys(own, float(robot.n_frames))
        drive = robot.features.before["drive"]
        assert isinstance(drive, Stage)
        amounts[drive] = float(frames)
    maps: dict[Stage, float] = {}
    for pair in pipeline.pairs:
        for each in (pair.filtered, pair.smoothed):
            n_maps = float(len(each.match.settings.iterations))
            maps |= dict.fromkeys((each.match, *each.aligners.values(), each.estimates), n_maps)
    for stage in run.evaluations:
        estimates = stage.before["align"]
        assert isinstance(estimates, Stage)
        maps[stage] = maps[estimates]
    if pipeline.team is not None:
        amounts[pipeline.team] = float(frames)
    return amounts | maps | dict.fromkeys(pipeline.fusers.values(), float(frames))


def _rates_of_earlier_runs(results: Path) -> tuple[dict[str, float], int]:
    """Return seconds per unit by kind of stage over the latest runs, and their number.

    Results that cannot be read are left out, since the estimate does not need them.
    """
    found = [path.parent.parent for path in results.glob("*/tables/timings.parquet")]
    found.sort(key=lambda result: (result / "tables" / "timings.parquet").stat().st_mtime)
    seconds, amounts, n_read = defaultdict[str, float](float), defaultdict[str, float](float), 0
    for result in found[-_MOST_RUNS:]:
        try:
            data = read_scenario(result / "scenario.json")
            scenario = scenario_of(data, str(result))
            run = EvaluatedRun.of(scenario, Store.of(results))
            timings = tables.read(tables.table_path(result, "timings"), "timings")
        except (InputError, OSError):
            continue
        n_read += 1
        worked_s = tables.work_by_stage(timings).set_index("stage")["seconds"]
        for stage, amount in _amounts(run).items():
            if stage.name in worked_s:
                amounts[_kind(stage, scenario)] += amount
        for name, stage in {stage.name: stage for stage in run.stages()}.items():
            seconds[_kind(stage, scenario)] += float(worked_s.get(name, 0.0))
    return {kind: seconds[kind] / amount for kind, amount in amounts.items()}, n_read
