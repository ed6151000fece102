"""What a result folder holds, read when a figure asks for it."""

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from experiments.judge.judged_maps import methods_in
from experiments.judge.tables import read, table_path
from experiments.show.figures.style import aligner_styles, robot_colours
from mapfusion.align.result import Status
from mapfusion.errors import InputError
from mapfusion.se2 import Float, between, inverse, transform_points
from mapfusion.storage import COVARIANCE_FIELDS, POSITION_FIELDS, points_from

Pair = tuple[str, str]


class NothingToDraw(Exception):  # noqa: N818  # no error: the result simply holds no such data
    """A figure has nothing to show; the text says why, in one line."""


class ResultTables:
    """The tables, key frames and descriptions of one result folder, or what several runs share.

    Every access raises InputError that names the file when it is missing or damaged; only
    `world.json` (the walls, known in simulation alone) and the key frames may be absent.
    """

    def __init__(self, folder: Path, of_runs: Mapping[str, pd.DataFrame] | None = None) -> None:
        """Read from a result folder, or show rows of several runs that are in memory already.

        Args:
            folder: written by `run`; of several runs where their figures go.
            of_runs: rows of tables, by name, with `run_id`: `errors` with one row per run where a
                result has one per repetition.
        """
        self.folder = folder
        self.several_runs = of_runs is not None
        self._tables = dict(of_runs or {})

    def table(self, name: str) -> pd.DataFrame:
        """The table of that name (see experiments.judge.tables)."""
        if name not in self._tables:
            self._tables[name] = read(table_path(self.folder, name), name)
        if self._tables[name].columns.empty:
            raise NothingToDraw(f"no run has a table {name}")
        return self._tables[name]

    @cached_property
    def scenario(self) -> dict[str, Any]:
        """The resolved scenario."""
        return _read_json(self.folder / "scenario.json")

    @cached_property
    def robots(self) -> list[str]:
        """Names in display order; the first one's frame is the fused map's."""
        return self.table("robots")["robot"].drop_duplicates().tolist()

    @cached_property
    def colours(self) -> dict[str, str]:
        """Each robot's colour, in display order."""
        return robot_colours(self.robots)

    @cached_property
    def pairs(self) -> list[Pair]:
        """Robot pairs that were aligned, in display order."""
        return pairs_in(self.table("errors"))

    @cached_property
    def aligners(self) -> list[str]:
        """Aligners that were run, in the scenario's order as the table has it, the oracle last."""
        return methods_in(self.table("errors"), oracle=True)

    @cached_property
    def styles(self) -> dict[str, dict[str, Any]]:
        """Each aligner's line style."""
        return aligner_styles(self.aligners)

    @cached_property
    def labels(self) -> dict[str, str]:
        """Each aligner's name in legends, with a word where its package is not installed."""
        errors = self.table("errors")
        absent = errors["aligner"][errors["status"] == Status.ABSENT] if "status" in errors else ()
        return {name: f"{name} (absent)" if name in set(absent) else name for name in self.aligners}

    def last_iteration(self, pair: Pair) -> int:
        """The last iteration at which the pair's maps were aligned: that of the stored maps."""
        return int(of_pair(self.table("errors"), pair)["iteration"].max())

    def last_correspondences(self, pair: Pair) -> pd.DataFrame:
        """The pairs offered to the aligners at the end: rows of the two stored maps."""
        rows = of_pair(self.table("correspondences"), pair)
        return rows[rows["iteration"] == self.last_iteration(pair)]

    def landmarks_of(self, robot: str) -> tuple[Float, Float]:
        """Positions (N, 3) and covariances (N, 3, 3) of the last map, by landmark number."""
        return positions_and_covariances(self._own_rows("landmarks", robot, "landmark"))

    def path_of(self, robot: str) -> Float:
        """Poses (T, 3) of the best particle's whole path at the end, in the robot's frame."""
        rows = self._own_rows("paths", robot, "iteration")
        return rows[["final_x_m", "final_y_m", "final_theta_rad"]].to_numpy()

    def clouds_of(self, robot: str) -> pd.DataFrame:
        """A robot's particles at the kept iterations."""
        return self._own_rows("clouds", robot, "iteration")

    def _own_rows(self, name: str, robot: str, order: str) -> pd.DataFrame:
        table = self.table(name)
        return table[table["robot"] == robot].sort_values(order, kind="stable")

    @cached_property
    def walls(self) -> list[Float]:
        """The walls' corner points, (n, 2) each, in the world; none where unknown."""
        return [np.array(wall) for wall in (self._world or {}).get("walls", [])]

    @cached_property
    def _world(self) -> dict[str, Any] | None:
        path = self.folder / "world.json"
        return _read_json(path) if path.is_file() else None

    def walls_in_frame_of(self, robot: str) -> list[Float]:
        """The walls' corner points, (n, 2) each, in a robot's map frame; none where unknown."""
        T_world_map = self.start_pose(robot)
        if T_world_map is None:
            return []
        return [transform_points(inverse(T_world_map), wall) for wall in self.walls]

    def true_alignment(self, pair: Pair) -> Float | None:
        """The true T_a_b (3,) of two map frames, or None where it is unknown."""
        starts = [self.start_pose(robot) for robot in pair]
        if starts[0] is None or starts[1] is None:
            return None
        return between(starts[0], starts[1])

    def start_pose(self, robot: str) -> Float | None:
        """The true T_world_map (3,) of a robot, or None where it is unknown."""
        pose = (self._world or {}).get("robots", {}).get(robot)
        return None if pose is None else np.array(pose, dtype=np.float64)


def pairs_in(errors: pd.DataFrame) -> list[Pair]:
    """Robot pairs in the order of their appearance."""
    pairs = errors[["robot_a", "robot_b"]].drop_duplicates()
    return list(pairs.itertuples(index=False, name=None))


def of_pair(rows: pd.DataFrame, pair: Pair) -> pd.DataFrame:
    """The rows of one robot pair."""
    return rows[(rows["robot_a"] == pair[0]) & (rows["robot_b"] == pair[1])]


def positions_and_covariances(rows: pd.DataFrame) -> tuple[Float, Float]:
    """Positions (N, 3) and covariances (N, 3, 3) of rows with the columns of a map."""
    columns = rows[POSITION_FIELDS + COVARIANCE_FIELDS]
    return points_from(pa.Table.from_pandas(columns, preserve_index=False))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (expected a result folder of `run`)") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error
