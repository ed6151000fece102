"""What the map view draws: plans of all evaluated iterations, packed into one block of bytes.

Numbers are little-endian, in the order and with the offsets that the index beside the block tells.
Positions are 16-bit steps of `step_m` in the robot's own frame, ellipses three bytes: both
semi-axes on a logarithmic scale and the direction. A map of 2000 landmarks takes 14 kB.
"""

import base64
from typing import Any

import numpy as np
import pandas as pd

from experiments.run.estimates import inlier_mask
from experiments.show.figures.floor_plan import LEVEL_TEXT, semi_axes
from experiments.show.figures.result_tables import Pair, ResultTables, of_pair
from experiments.show.report.charts import rounded
from mapfusion.se2 import Float

TABLES = ("map_history", "true_pairs", "clouds", "paths")
TABLES += ("correspondences", "fused_history", "estimates")
MAX_BYTES = 4_000_000  # of the block: with Plotly and the pictures the report stays under 15 MB
_FINEST_STEP_M = 0.001  # a screen never shows a millimetre of a map
# Semi-axes from 1 mm to 100 m: 255 steps of 4.6 % each, which no eye tells apart.
ELLIPSE_MIN_M, ELLIPSE_MAX_M = 1e-3, 100.0
_PATHS = ("online", "truth")
_NOTHING = {"at": [0, 0], "ellipses": [0, 0]}

Tables = dict[str, pd.DataFrame]


class Block:
    """Arrays one after the other, each at a multiple of its item size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, values: np.ndarray) -> list[int]:
        """Append an array; returns [offset in bytes, number of items]."""
        self._data += b"\0" * (-len(self._data) % values.itemsize)
        offset = len(self._data)
        self._data += values.tobytes()
        return [offset, values.size]

    def text(self) -> str:
        """The block in base64."""
        return base64.b64encode(self._data).decode("ascii")


def packed_ellipses(covariance_m2: Float) -> np.ndarray:
    """Plane covariances (N, 2, 2) as (N, 3) bytes: both semi-axes (logarithm), direction."""
    if not len(covariance_m2):
        return np.empty((0, 3), dtype=np.uint8)
    major, minor, direction = semi_axes(covariance_m2)
    span = np.log(ELLIPSE_MAX_M / ELLIPSE_MIN_M)
    columns = [
        np.clip(np.log(np.maximum(axis, ELLIPSE_MIN_M) / ELLIPSE_MIN_M) / span, 0, 1) * 255
        for axis in (major, minor)
    ]
    columns.append(np.mod(direction, np.pi) / np.pi * 256)
    return np.stack(columns, -1).round().astype(np.int64).astype(np.uint8)  # 256 wraps to 0


def map_view(data: ResultTables, tables: Tables) -> dict[str, Any] | None:
    """Index and block of the map view.

    Args:
        data: the result.
        tables: those of TABLES that the result holds.

    Returns:
        JSON-able values, the block in base64 under `block`; None where the result keeps no maps.
    """
    if not {"map_history", "true_pairs"} <= set(tables) or not data.pairs:
        return None
    view = _View(data, tables)
    return {
        "level": LEVEL_TEXT,
        "ellipse_m": [ELLIPSE_MIN_M, ELLIPSE_MAX_M],
        "robots": {name: view.robot(name) for name in data.robots},
        "pairs": [view.pair(pair) for pair in data.pairs],
        "starts": {robot: _pose(data.start_pose(robot)) for robot in data.robots},
        "walls": [[rounded(point) for point in wall] for wall in data.walls],
        "index_bytes": view.index_type.itemsize,
        "merge_aligner": data.scenario.get("merge", {}).get("aligner", ""),
        "left_out": view.n_left_out,
        "block": view.block.text(),
    }


class _View:
    """Packs robots and pairs of robots into one block, one after the other."""

    def __init__(self, data: ResultTables, tables: Tables) -> None:
        self.block = Block()
        self._data = data
        self._tables = tables
        history, true_pairs = tables["map_history"], tables["true_pairs"]
        self._shown = _affordable(history, true_pairs)
        self.n_left_out = int(true_pairs["iteration"].nunique() - len(self._shown))
        wide = history["landmark"].max() > np.iinfo(np.uint16).max
        self.index_type = np.dtype("<u4" if wide else "<u2")
        self._step_m = {name: self._finest_step(name) for name in data.robots}

    def _of_robot(self, table: str, robot: str) -> pd.DataFrame:
        rows = self._tables.get(table, pd.DataFrame({"robot": []}))
        return rows[rows["robot"] == robot]

    def _of_pair(self, table: str, pair: Pair) -> pd.DataFrame:
        empty = pd.DataFrame({"robot_a": [], "robot_b": [], "iteration": []})
        return of_pair(self._tables.get(table, empty), pair)

    def _finest_step(self, robot: str) -> float:
        """Metres a step, such that all that is drawn of the robot fits into 16 bits."""
        of_robot = [self._of_robot(name, robot) for name in ("map_history", "clouds", "paths")]
        drawn = [rows.filter(regex=r"^((online|truth)_)?[xy]_m$") for rows in of_robot]
        reach = max(np.nanmax(np.abs(points.to_numpy(float)), initial=0.0) for points in drawn)
        return max(_FINEST_STEP_M, float(reach) / np.iinfo(np.int16).max)

    def robot(self, robot: str) -> dict[str, Any]:
        """Maps and particles by shown iteration, and the paths."""
        return {
            "step_m": self._step_m[robot],
            "maps": self._maps(robot),
            "clouds": self._clouds(robot),
            "paths": self._lines(robot),
        }

    def _maps(self, robot: str) -> list[dict[str, Any]]:
        """The latest map at each shown iteration; an empty map has no rows."""
        rows = self._of_robot("map_history", robot).sort_values(["iteration", "landmark"])
        by_iteration = _by_iteration(rows)
        known = np.array(list(by_iteration))  # rising
        latest = np.searchsorted(known, self._shown, side="right") - 1
        packed = {
            place: self._points(by_iteration[known[place]], robot)
            for place in np.unique(latest[latest >= 0]).tolist()
        }
        return [packed.get(place, _NOTHING) for place in latest.tolist()]

    def _clouds(self, robot: str) -> list[dict[str, Any]]:
        """The particles nearest in time; they may be a few frames off."""
        by_iteration = _by_iteration(self._of_robot("clouds", robot))
        if not by_iteration:
            return []
        known = np.array(list(by_iteration))
        nearest = known[np.abs(known[:, None] - self._shown).argmin(axis=0)]
        return [{"at": self._plan(by_iteration[k], robot)} for k in nearest.tolist()]

    def _lines(self, robot: str) -> dict[str, Any]:
        rows = self._of_robot("paths", robot)
        if rows.empty:
            return {}
        rows = rows.sort_values("iteration")
        lines: dict[str, Any] = {
            path: self._plan(rows, robot, f"{path}_")
            for path in _PATHS
            if np.isfinite(rows[[f"{path}_x_m", f"{path}_y_m"]]).all(axis=None)
        }
        return lines | {"theta_rad": rounded(rows["online_theta_rad"])}

    def _plan(self, rows: pd.DataFrame, robot: str, prefix: str = "") -> list[int]:
        points = rows[[f"{prefix}x_m", f"{prefix}y_m"]].to_numpy(dtype=np.float64)
        return self.block.add(np.round(points / self._step_m[robot]).astype("<i2"))

    def _points(self, rows: pd.DataFrame, robot: str) -> dict[str, Any]:
        covariance = rows[["cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2"]].to_numpy()
        at = self._plan(rows, robot)
        ellipses = packed_ellipses(covariance.reshape(-1, 2, 2).astype(np.float64))
        return {"at": at, "ellipses": self.block.add(ellipses)}

    def pair(self, pair: Pair) -> dict[str, Any]:
        """Correspondences, fused landmarks and alignments of two robots, iteration by iteration."""
        judged = self._of_pair("true_pairs", pair).set_index("iteration")
        offered, fused = (
            _by_iteration(self._of_pair(name, pair))
            for name in ("correspondences", "fused_history")
        )
        frames = []
        for place, k in enumerate(self._shown.tolist()):
            if k not in judged.index:
                continue
            frame: dict[str, Any] = {"iteration": k, "map": place}
            if k in offered:
                row = judged.loc[k]
                is_true = inlier_mask(row["true_pair"], row["n_correspondences"])
                index = offered[k][["index_a", "index_b"]].to_numpy()
                frame["pairs"] = self.block.add(index.astype(self.index_type))
                frame["true"] = self.block.add(is_true.astype(np.uint8))
                frame["n_true"] = int(is_true.sum())
            if k in fused:
                frame["fused"] = self._points(fused[k], pair[0])
            frames.append(frame)
        return {
            "robots": list(pair),
            "truth": _pose(self._data.true_alignment(pair)),
            # a's true start: drawn in the world, where the walls stand as one knows them
            "start": _pose(self._data.start_pose(pair[0])) or [0.0, 0.0, 0.0],
            "frames": frames,
            "alignments": self._alignments(pair, [frame["iteration"] for frame in frames]),
        }

    def _alignments(
        self, pair: Pair, iterations: list[int]
    ) -> dict[str, list[dict[str, Any] | None]]:
        """By aligner and iteration: the first repetition's motion, as estimated and refined."""
        if "estimates" not in self._tables:
            return {}
        keys = ["aligner", "iteration", "repetition"]
        estimates = self._of_pair("estimates", pair)
        errors = of_pair(self._data.table("errors"), pair)
        new = [name for name in errors if name in keys or name not in estimates]
        joined = estimates[estimates["repetition"] == 0].merge(errors[new], on=keys)
        found = {
            (row["aligner"], row["iteration"]): _alignment(row) for row in joined.to_dict("records")
        }
        return {
            name: [found.get((name, k)) for k in iterations]
            for name in self._data.aligners
            if any((name, k) in found for k in iterations)
        }


def _affordable(history: pd.DataFrame, true_pairs: pd.DataFrame) -> np.ndarray:
    """Evaluated iterations, evenly thinned until the block fits; the last one stays."""
    iterations = np.unique(true_pairs["iteration"].to_numpy())
    bytes_in_all = 7 * len(history) + 5 * int(true_pairs["n_correspondences"].sum())
    n = int(np.clip(len(iterations) * MAX_BYTES / max(bytes_in_all, 1), 1, len(iterations)))
    return iterations[np.linspace(len(iterations) - 1, 0, n).round().astype(int)[::-1]]


def _by_iteration(rows: pd.DataFrame) -> dict[Any, pd.DataFrame]:
    return dict(iter(rows.groupby("iteration"))) if len(rows) else {}


def _pose(pose: Float | None) -> list[float | None] | None:
    return None if pose is None else rounded(pose)


def _alignment(row: dict[Any, Any]) -> dict[str, Any]:
    """A row of `estimates` joined with that of `errors`."""
    reasons = (row["refined_reason"], row["reason"], row.get("acceptance_reason"))
    found: dict[str, Any] = {
        "accepted": bool(row["accepted"]),
        "status": str(row["refined_status"]),
        "reason": next((str(reason) for reason in reasons if reason), ""),
        "error": {},
    }
    for stage, prefix in (("estimated", ""), ("refined", "refined_")):
        found[stage] = rounded([row[f"{prefix}{name}"] for name in ("tx_m", "ty_m", "theta_rad")])
        names = (f"{prefix}translation_error_m", f"{prefix}rotation_error_rad")
        found["error"][stage] = rounded([row[name] for name in names])
    return found
