"""Tables and files of a result folder, read on demand."""

import io
import json
from collections.abc import Collection, Mapping
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from PIL import Image

from experiments.evaluation.alignment_criteria import methods_in
from experiments.evaluation.tables import ALL, read, read_scenario, read_world, table_path
from experiments.pipeline.tables import covariances_of
from experiments.reports.figures.style import aligner_styles
from mapfusion.align.alignment import Status
from mapfusion.errors import DamagedFileError, InputError
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSE_FIELDS,
    POSITION_FIELDS,
    points_from,
    require_file,
)
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, inverse, transform_covariances, transform_points
from mapfusion.plotting import FUSED_COLOUR, ROBOT_COLOURS

Pair = tuple[str, str]


class NothingToDraw(Exception):  # noqa: N818  # no error: the result has no such data
    """Signal that a figure has no data; the text gives the reason in one line."""


def read_png(path: Path) -> bytes:
    """Return the bytes of a PNG picture; the checksums of its parts are verified.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    require_file(path, "PNG picture")
    data = path.read_bytes()
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.verify()
    except (OSError, SyntaxError, ValueError) as error:  # Pillow's errors for damaged files
        raise DamagedFileError(path, "damaged or not a PNG picture") from error
    return data


class FusedPairs(NamedTuple):
    """N landmarks in the maps of two robots, and the landmarks fused from them.

    The first axis is parent a, parent b, fused. Maps of further robots may contain a landmark too;
    the fused landmark then has more parents.

    Attributes:
        robots: both robots.
        position_m: positions, shape (3, N, 3).
        covariance_m2: covariances as the merge used them, with drift added, shape (3, N, 3, 3).
        own_covariance_m2: covariances of the parents without drift, shape (2, N, 3, 3).
        n_parents: number of parents, at least 2, shape (N,).
    """

    robots: Pair
    position_m: Float
    covariance_m2: Float
    own_covariance_m2: Float
    n_parents: np.ndarray


class ResultTables:
    """Tables, key frames and descriptions of one result folder, or tables of several runs.

    Every access raises InputError that names a missing or damaged file. Only `world.json` (the
    walls, known in simulations) and the key frames may be absent.
    """

    def __init__(
        self,
        folder: Path,
        of_runs: Mapping[str, pd.DataFrame] | None = None,
        written: Collection[str] | None = None,
    ) -> None:
        """Take a result folder, or the tables of several runs.

        Args:
            folder: folder of the result.
            of_runs: tables of runs by name, with a column `run_id`; `errors` has one row per run
                instead of one per repetition.
            written: tables (and `scenario`) that may be read while the folder is being written.
        """
        self.folder = folder
        self._written = written
        self.several_runs = of_runs is not None
        self._tables = dict(of_runs or {})

    def table(self, name: str) -> pd.DataFrame:
        """Return a table by name (see experiments.evaluation.tables)."""
        self._require_written(name)
        if name not in self._tables:
            rows = read(table_path(self.folder, name), name)
            self._tables[name] = rows
            if name != "robots" and self._written is None and self.has("robots"):
                for column in {"robot", "robot_a", "robot_b"} & set(rows.columns):
                    named = {each for each in rows[column].dropna() if each}
                    if others := sorted(named - set(self.robots)):
                        known = f"which has {', '.join(self.robots)}"
                        raise InputError(
                            f"{table_path(self.folder, name)}: column {column}: robot {others[0]}"
                            f" is not in robots.parquet, {known}; the tables are of different runs"
                        )
        if self._tables[name].columns.empty:
            raise NothingToDraw(f"no run has a table {name}")
        return self._tables[name]

    def has(self, name: str) -> bool:
        """Return True if there is a table of this name; older results lack some."""
        self._require_written(name)
        return name in self._tables or table_path(self.folder, name).is_file()

    def _require_written(self, name: str) -> None:
        if self._written is not None and name not in self._written:
            raise LookupError(f"{name}: may be that of an earlier run")

    def rows(self, name: str) -> pd.DataFrame:
        """Return a table by name; without rows if there is none."""
        return self.table(name) if self.has(name) else ALL[name].empty_table().to_pandas()

    @cached_property
    def scenario(self) -> dict[str, Any]:
        """The resolved scenario."""
        self._require_written("scenario")
        return read_scenario(self.folder / "scenario.json")

    @cached_property
    def robots(self) -> list[str]:
        """Names of the robots in display order."""
        return self.table("robots")["robot"].drop_duplicates().tolist()

    @cached_property
    def colours(self) -> dict[str, str]:
        """Colours by robot, in display order."""
        return dict(zip(self.robots, cycle(ROBOT_COLOURS), strict=False))

    @cached_property
    def answers(self) -> pd.DataFrame:
        """Results of the aligners: `errors`, or `estimates` if no truth is known."""
        errors = self.table("errors")
        return errors if len(errors) or self.several_runs else self.rows("estimates")

    @property
    def no_truth(self) -> bool:
        """True if there are answers but no truth."""
        return self.table("errors").empty and not self.answers.empty

    @cached_property
    def pairs(self) -> list[Pair]:
        """Robot pairs that were aligned, in display order."""
        pairs = self.answers[["robot_a", "robot_b"]].drop_duplicates()
        return list(pairs.itertuples(index=False, name=None))

    @cached_property
    def aligners(self) -> list[str]:
        """Aligners that were run, in the order of the scenario, the oracle last."""
        return methods_in(self.answers, oracle=True)

    @cached_property
    def styles(self) -> dict[str, dict[str, Any]]:
        """Line styles by aligner."""
        return aligner_styles(self.aligners)

    @cached_property
    def labels(self) -> dict[str, str]:
        """Names in legends by aligner; they say if the package is not installed."""
        rows = self.answers
        absent = rows["aligner"][rows["status"] == Status.ABSENT] if "status" in rows else ()
        return {name: f"{name} (absent)" if name in set(absent) else name for name in self.aligners}

    def last_iteration(self, pair: Pair) -> int:
        """Return the last iteration at which a pair was aligned: that of the stored maps."""
        return int(of_pair(self.answers, pair)["iteration"].max())

    def last_correspondences(self, pair: Pair) -> pd.DataFrame:
        """Return the correspondences given to the aligners at the last iteration."""
        rows = of_pair(self.table("correspondences"), pair)
        return rows[rows["iteration"] == self.last_iteration(pair)]

    def of_robot(self, name: str, robot: str, order: str = "iteration") -> pd.DataFrame:
        """Return the rows of one robot of a table, sorted by a column."""
        table = self.table(name)
        return table[table["robot"] == robot].sort_values(order, kind="stable")

    def landmarks_of(self, robot: str) -> tuple[Float, Float]:
        """Return positions (N, 3) and covariances (N, 3, 3) of the last map, by landmark number."""
        return positions_and_covariances(self.of_robot("landmarks", robot, "landmark"))

    def plan_at(self, robot: str, iteration: int) -> tuple[Float, Float]:
        """Return plan positions (N, 2) and covariances (N, 2, 2) of a map at an iteration.

        A robot whose log ended earlier has its last map.
        """
        rows = self.of_robot("map_history", robot, "landmark")
        known = rows.loc[rows["iteration"] <= iteration, "iteration"]
        rows = rows[rows["iteration"] == known.max()]
        xx, xy, yy = (rows[f"cov_{name}_m2"].to_numpy(np.float64) for name in ("xx", "xy", "yy"))
        covariance = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
        return rows[["x_m", "y_m"]].to_numpy(np.float64), covariance

    @property
    def sightings(self) -> str:
        """Description of the number of observations that a landmark needs to enter a map."""
        return f"seen {self.scenario['slam']['min_count']} times or more"

    def path_of(self, robot: str) -> Float:
        """Return the final path of the best particle in the robot's frame, shape (T, 2)."""
        return self.of_robot("paths", robot)[["final_x_m", "final_y_m"]].to_numpy()

    def smoothed_path_of(self, robot: str) -> tuple[Float, Float]:
        """Return the last smoothed path in the robot's frame, (T, 3) or (0, 3), and covariances."""
        rows = self.rows("smoothed_paths")
        own = rows[rows["robot"] == robot]
        last = own[own["iteration"] == own["iteration"].max()].sort_values("frame")
        return last[list(POSE_FIELDS)].to_numpy(np.float64), covariances_of(last)

    @property
    def fused_frame(self) -> str:
        """Robot whose frame is the frame of the fused map: the first robot in the map."""
        motions = self.rows("fused_motions")
        inside = motions.loc[motions["tx_m"].notna(), "robot"].tolist()
        return inside[0] if inside else self.robots[0]

    def moved_map(self, robot: str) -> tuple[Float, Float, Float]:
        """Return a robot's last map as the merge used it, in the fused frame.

        Returns:
            Positions (N, 3), covariances with drift (N, 3, 3), covariances without drift.
        """
        if not self.has("fused_motions"):
            raise NothingToDraw("made before fused motions were stored: run it again")
        motions = self.table("fused_motions").set_index("robot").loc[robot]
        T_fused_robot = motions[["tx_m", "ty_m", "theta_rad"]].to_numpy(dtype=np.float64)
        position, covariance = self.landmarks_of(robot)
        turned = transform_covariances(T_fused_robot, covariance)
        drift_m2 = motions["drift_sigma_m"] ** 2 * np.diag([1.0, 1.0, 0.0])  # no drift of heights
        return transform_points(T_fused_robot, position), turned + drift_m2, turned

    def fused_map(self) -> pd.DataFrame:
        """Return the map of `merge.fuser`, or the map `fused` of an older result."""
        return self.table("fused_map" if self.has("fused_map") else "fused")

    def fused_pairs(self) -> FusedPairs:
        """Return the fused landmarks of the robot pair that shares most landmarks.

        Raises:
            NothingToDraw: no landmark was fused.
        """
        fused = self.table("fused")
        rows = fused[fused["n_parents"] >= 2]
        if rows.empty:
            raise NothingToDraw("no two landmarks were fused")
        robots: Any = rows.groupby(["robot_a", "robot_b"], sort=False).size().idxmax()
        rows = of_pair(rows, robots)
        parents = [
            [values[rows[index].to_numpy()] for values in self.moved_map(robot)]
            for robot, index in zip(robots, ("landmark_a", "landmark_b"), strict=True)
        ]
        moved, widened, own = (np.stack(values) for values in zip(*parents, strict=True))
        position, covariance = positions_and_covariances(rows)
        three = np.concatenate([moved, position[None]])
        covariances = np.concatenate([widened, covariance[None]])
        return FusedPairs(robots, three, covariances, own, rows["n_parents"].to_numpy())

    def parents_and_fused(self, robots: Pair) -> list[tuple[str, str, str]]:
        """Return label, marker and colour of two parents and of the fused landmark."""
        colours = [self.colours[robot] for robot in robots] + [FUSED_COLOUR]
        return list(zip([*robots, "fused"], "*^s", colours, strict=True))

    @cached_property
    def walls(self) -> list[Float]:
        """Lines of the faces of the walls in the world, each of shape (n, 2); empty if unknown.

        Older results without faces give the middle lines of the walls.
        """
        known = self._world.get("faces", self._world.get("walls", []))
        return [np.array(line) for line in known]

    @cached_property
    def _world(self) -> dict[str, Any]:
        path = self.folder / "world.json"
        return read_world(path) if path.is_file() else {}

    def walls_in_frame_of(self, robot: str) -> list[Float]:
        """Return the `walls` in a robot's map frame."""
        start = self.start_pose(robot)
        return [transform_points(inverse(start), wall) for wall in self.walls if start is not None]

    def true_alignment(self, pair: Pair) -> Float | None:
        """Return the true T_a_b (3,) of two map frames, or None if it is unknown."""
        start_a, start_b = (self.start_pose(robot) for robot in pair)
        return None if start_a is None or start_b is None else between(start_a, start_b)

    def start_pose(self, robot: str) -> Float | None:
        """Return the true T_world_map (3,) of a robot, or None if it is unknown."""
        pose = self._world.get("robots", {}).get(robot)
        return None if pose is None else np.array(pose, dtype=np.float64)


def of_pair(rows: pd.DataFrame, pair: Pair) -> pd.DataFrame:
    """Return the rows of one robot pair."""
    return rows[(rows["robot_a"] == pair[0]) & (rows["robot_b"] == pair[1])]


def positions_and_covariances(rows: pd.DataFrame) -> tuple[Float, Float]:
    """Return positions (N, 3) and covariances (N, 3, 3) of rows with the columns of a map."""
    columns = rows[POSITION_FIELDS + COVARIANCE_FIELDS]
    return points_from(pa.table({name: columns[name].to_numpy() for name in columns}))


def parse_json_object(text: str, where: Path) -> dict[str, Any]:
    """Parse a JSON object; raises InputError that names its origin if the text is no object."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: cannot be read as a JSON object ({error})") from error
    if not isinstance(found, dict):
        raise InputError(f"{where}: holds a {type(found).__name__}, expected a JSON object")
    return found
