"""Task set of the leaderboard: pairs of maps with correspondences, and the truth in its own folder.

A set is made from scenarios by one command and then frozen. A task is a pair of smoothed maps of
one run, in the middle of the run or at its end. All methods get the same maps, correspondences and
rival motions, so a result does not depend on our front end, filter and smoother.

The card `croissant.json` (Croissant 1.0 of MLCommons) lists all files with their SHA-256. The
digest of a set is a hash of this list, which identifies its content. Other seeds give a set of the
same kind, for a competition with hidden tasks.
"""

import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.truth import (
    EvaluatedRobot,
    MapPair,
    PathTruth,
    load_robot_smoothed,
)
from experiments.pipeline.stage import library_versions
from experiments.pipeline.stages.align import correspondences_of, rival_rows
from experiments.pipeline.store import Store
from experiments.pipeline.tables import (
    CORRESPONDENCES,
    INT,
    MOTION,
    RIVALS,
    TEXT,
    fields,
    read_rows,
    write_rows,
)
from experiments.pipeline.tasks import OnProgress
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from experiments.scenario.suite import one_scenario
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import match
from mapfusion.errors import InputError
from mapfusion.files import (
    POSITION_FIELDS,
    digest_of,
    float_fields,
    named_columns,
    schema,
    write_all_atomically,
    write_atomically,
)
from mapfusion.landmark_map import map_writes, read_map
from mapfusion.verification.verdict import Verifier

VERSION = 1
# Scenarios of the set that is made by default. The last three have no common ground, so that any
# alignment is wrong.
SCENARIOS = ("corridor", "opposite", "rooms_low", "rooms_high", "plain", "posters", "slip", "dark")
SCENARIOS += ("short", "apart", "posters_apart", "alias_copy_apart")
_RENDERER = "raycast"  # needs no PyBullet
CARD = "croissant.json"
_TASK = {"scenario": TEXT, "seed": INT, "robot_a": TEXT, "robot_b": TEXT, "iteration": INT}
TASKS = schema("leaderboard.tasks", 1, fields(task=TEXT, **_TASK, map_a=TEXT, map_b=TEXT))
_OF_TASK = fields(task=TEXT)
OFFERED = schema("leaderboard.correspondences", 1, [*_OF_TASK, *CORRESPONDENCES])
OFFERED_RIVALS = schema("leaderboard.rivals", 1, [*_OF_TASK, *RIVALS])
# True point of each landmark of each map in the frame of the world; NaN where unknown.
POINTS = schema("leaderboard.points", 1, [*fields(map=TEXT), *float_fields(POSITION_FIELDS)])
# Pose of the frame of each robot's maps in the world.
ORIGINS = schema(
    "leaderboard.origins",
    1,
    [*fields(scenario=TEXT, seed=INT, robot=TEXT), *float_fields(MOTION)],
)
_TASKS, _CORRESPONDENCES, _RIVALS = "tasks.parquet", "correspondences.parquet", "rivals.parquet"
_POINTS, _ORIGINS = "truth/points.parquet", "truth/origins.parquet"
_TABLES = {
    _TASKS: TASKS,
    _CORRESPONDENCES: OFFERED,
    _RIVALS: OFFERED_RIVALS,
    _POINTS: POINTS,
    _ORIGINS: ORIGINS,
}
VERIFIER = Verifier()  # of the rival motions, and of all alignments of the leaderboard
_LABEL = "make the tasks"
_LICENCE = "https://spdx.org/licenses/MIT.html"
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
}


@dataclass(frozen=True)
class Task:
    """Pair of maps to be aligned.

    Attributes:
        name: name of the task in the tables.
        scenario: scenario of the run.
        seed: seed of the run.
        pair: the maps, what all methods are given, and the truth; without estimates.
    """

    name: str
    scenario: str
    seed: int
    pair: MapPair

    @property
    def keys(self) -> dict[str, Any]:
        """Values of the columns that identify the task."""
        run = {"run_id": f"{self.scenario}-{self.seed}", "scenario": self.scenario}
        return {"task": self.name, **run, "seed": self.seed}


@dataclass(frozen=True)
class TaskSet:
    """Set of tasks in a folder.

    Attributes:
        folder: the folder.
        tasks: rows of the table TASKS.
        digest: SHA-256 that identifies the content of all files.
        card: content of the card.
    """

    folder: Path
    tasks: pd.DataFrame
    digest: str
    card: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> "TaskSet":
        """Read the list of tasks and check all files against the card.

        Raises:
            InputError: there is no set, its version is another one, or a file was changed.
        """
        path = folder / CARD
        if not path.is_file():
            made = f"`mapfusion study tasks -o {folder}` makes one"
            raise InputError(f"{folder}: holds no task set (no {CARD}); {made}")
        try:
            card = json.loads(path.read_text())
            files = {str(each["contentUrl"]): str(each["sha256"]) for each in card["distribution"]}
            version = int(card["version"])
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: is no card of a task set ({error})") from error
        if version != VERSION:
            needed = f"this version of mapfusion reads version {VERSION}"
            raise InputError(f"{path}: is a task set of version {version}; {needed}")
        for name, digest in files.items():
            inside = (folder / name).resolve().is_relative_to(folder.resolve())
            if not inside or not (folder / name).is_file():
                raise InputError(f"{folder / name}: is missing; make the task set again")
            if digest_of(folder / name) != digest:
                raise InputError(f"{folder / name}: was changed; make the task set again")
        tasks = read_rows(folder / _TASKS, TASKS)
        return cls(folder, tasks, _set_digest(files), card)

    @property
    def scenarios(self) -> list[str]:
        """Scenarios of the tasks, in order."""
        return list(dict.fromkeys(self.tasks["scenario"]))


@functools.lru_cache(maxsize=1)  # methods follow each other on the same scenario
def tasks_of_scenario(folder: Path, digest: str, scenario: str) -> tuple[Task, ...]:
    """Read the tasks of one scenario from the folder of a set, in the order of the table.

    The last result stays in memory. `digest` is that of the set: a set that was made again is read
    again.
    """
    tasks, origins = (
        rows[rows["scenario"] == scenario]
        for rows in (read_rows(folder / file, _TABLES[file]) for file in (_TASKS, _ORIGINS))
    )
    offered, rivals = (
        dict(iter(read_rows(folder / file, _TABLES[file]).groupby("task")))
        for file in (_CORRESPONDENCES, _RIVALS)
    )
    no_pairs, no_rivals = (
        pd.DataFrame(columns=pd.Index(table.names)) for table in (CORRESPONDENCES, RIVALS)
    )
    points = dict(iter(read_rows(folder / _POINTS, POINTS).groupby("map")))
    T_world_map = origins.set_index(["seed", "robot"])[list(MOTION)]
    found = []
    for row in tasks.to_dict("records"):
        robots, iteration = [], row["iteration"]
        for name, file in ((row["robot_a"], row["map_a"]), (row["robot_b"], row["map_b"])):
            maps = {iteration: read_map(folder / "maps" / file)}
            known = {iteration: points[file][list(POSITION_FIELDS)].to_numpy()}
            origin = T_world_map.loc[(row["seed"], name)].to_numpy()
            robots.append(EvaluatedRobot(name, maps, known, PathTruth(np.empty((0, 3)), origin)))
        a, b = robots
        (map_a, points_a), (map_b, points_b) = a.at(iteration), b.at(iteration)
        pair = MapPair(
            a,
            b,
            iteration,
            (map_a, map_b),
            (points_a, points_b),
            correspondences_of(offered.get(row["task"], no_pairs)),
            estimates=(),
            rivals=rivals.get(row["task"], no_rivals),
        )
        found.append(Task(row["task"], scenario, row["seed"], pair))
    return tuple(found)


def make_task_set(
    folder: Path,
    scenarios: Sequence[str],
    seeds: Sequence[int],
    store: Store,
    jobs: int,
    on_progress: OnProgress,
) -> TaskSet:
    """Simulate the runs and write their smoothed maps as a task set.

    Finished stages are in the store, so an interrupted call continues.

    Args:
        folder: folder to write.
        scenarios: scenario files, or names of the suite.
        seeds: seeds of each scenario.
        store: store of the stages.
        jobs: number of processes.
        on_progress: called with the number of finished runs.

    Raises:
        InputError: a scenario cannot be used.
    """
    paths, names = [one_scenario(word) for word in scenarios], list[str]()
    for path in paths:
        scenario = load_scenario(path)
        if not isinstance(scenario, Simulation):
            raise InputError(f"{path}: is a recording; tasks need the exact truth of a simulation")
        if len(scenario.robots) < 2:
            raise InputError(f"{path}: has one robot; a task needs the maps of two")
        if scenario.name in names:
            raise InputError(f"{path}: its name, {scenario.name}, is that of another scenario too")
        names.append(scenario.name)
    runs = [(path, seed) for path in paths for seed in seeds]
    rows: dict[str, list[pd.DataFrame]] = {file: [] for file in _TABLES}
    maps = list[Path]()
    for n, (path, seed) in enumerate(runs):
        on_progress(_LABEL, n, len(runs))
        scenario = load_scenario(path, [f"render.renderer={_RENDERER}"], seed)
        run = EvaluatedRun.of(scenario, store)
        run.execute(jobs, lambda *_: None, [robot.smooth for robot in run.pipeline.robots])
        maps += _add_run(run, folder, rows)
    on_progress(_LABEL, len(runs), len(runs))
    for file, table in _TABLES.items():
        write_rows(folder / file, table, pd.concat(rows[file]) if rows[file] else [])
    files = sorted([*(path.relative_to(folder).as_posix() for path in maps), *_TABLES])
    _write_card(folder, files, names, seeds)
    return TaskSet.read(folder)


def _add_run(
    run: EvaluatedRun, folder: Path, rows: Mapping[str, list[pd.DataFrame]]
) -> Iterator[Path]:
    """Write the maps of a run, add its rows to the tables, and yield the files of the maps."""
    scenario = run.scenario
    of_run = {"scenario": scenario.name, "seed": scenario.seed}
    robots = dict[str, EvaluatedRobot]()
    for stages in run.pipeline.robots:
        folders = run.robot_folders(stages)._replace(smooth=run.store.path(stages.smooth))
        robot = robots[stages.name] = load_robot_smoothed(folders)
        pose = named_columns(MOTION, robot.path.T_world_map[None])
        rows[_ORIGINS].append(pd.DataFrame(pose).assign(**of_run, robot=robot.name))
    # all pairs of robots are aligned at the same iterations
    iterations = run.pipeline.pairs[0].smoothed.match.settings.iterations
    middle = iterations[(len(iterations) - 1) // 2]
    for iteration in dict.fromkeys((middle, iterations[-1])):
        files = dict[str, str]()
        for name, robot in robots.items():
            files[name] = f"{scenario.name}-{scenario.seed}-{name}-{iteration}.parquet"
            landmarks, points_world_m = robot.at(iteration)
            if iteration != iterations[-1]:  # joint covariances are most of the data
                landmarks = replace(landmarks, joint=None)
            writes = map_writes(folder / "maps" / files[name], landmarks)
            write_all_atomically(writes)
            yield from (path for path, write in writes.items() if write is not None)
            of_map = named_columns(POSITION_FIELDS, points_world_m)
            rows[_POINTS].append(pd.DataFrame(of_map).assign(map=files[name]))
        for pair in run.pipeline.pairs:
            a, b = pair.a.name, pair.b.name
            of_task = {"robot_a": a, "robot_b": b, "iteration": iteration}
            task = "-".join(map(str, (*of_run.values(), *of_task.values())))
            # as every method reads the maps
            map_a, map_b = (read_map(folder / "maps" / files[name]) for name in (a, b))
            pairs = match(map_a, map_b, scenario.align.match, one_floor=True)
            matched = {"index_a": pairs.index_a, "index_b": pairs.index_b}
            matched |= {"descriptor_distance": pairs.distance}
            rows[_CORRESPONDENCES].append(pd.DataFrame(of_task | matched).assign(task=task))
            if evidence := VERIFIER.on(Pairs(map_a, map_b, pairs)).evidence:
                rivals = pd.DataFrame(rival_rows(of_task, evidence))
                rows[_RIVALS].append(rivals.assign(task=task))
            row = {"task": task, **of_run, **of_task, "map_a": files[a], "map_b": files[b]}
            rows[_TASKS].append(pd.DataFrame([row]))


def _write_card(
    folder: Path, files: Sequence[str], scenarios: Sequence[str], seeds: Sequence[int]
) -> None:
    """Write the card of a set: its content, its origin, and the SHA-256 of each file."""
    drawn = f"scenarios {', '.join(scenarios)}; seeds {', '.join(map(str, seeds))}"
    distribution = [
        {
            "@type": "cr:FileObject",
            "@id": file,
            "name": file,
            "contentUrl": file,
            "contentSize": f"{(folder / file).stat().st_size} B",
            "encodingFormat": "application/vnd.apache.parquet",
            "sha256": digest_of(folder / file),
        }
        for file in files
    ]
    card = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": "mapfusion-tasks",
        "version": str(VERSION),
        "description": "Pairs of landmark maps of simulated robots with stereo cameras, which "
        "start at unknown relative poses; correspondences; true motions and true points. Pictures "
        f"by the ray caster of mapfusion, smoothed maps; {drawn}.",
        "license": _LICENCE,
        "isLiveDataset": False,
        "creator": {"@type": "sc:Organization", "name": "mapfusion"},
        "softwareVersions": library_versions(simulator=False),
        "distribution": distribution,
    }
    write_atomically(folder / CARD, lambda path: path.write_text(json.dumps(card, indent=1) + "\n"))


def _set_digest(files: Mapping[str, str]) -> str:
    """Return the SHA-256 of the sorted list of files and their digests, as `sha256sum` prints."""
    lines = "".join(f"{files[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()
