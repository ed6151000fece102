"""What the map view draws: plans of all evaluated iterations, packed into one block of bytes.

Numbers are little-endian, in the order and with the offsets that the index beside the block tells.
Positions are 16-bit steps of `step_m` in the robot's own frame, ellipses three bytes: both
semi-axes on a logarithmic scale and the direction. A map of 2000 landmarks takes 14 kB.
"""

import base64
from typing import Any

import numpy as np
import pandas as pd

from experiments.pipeline.tables import unpacked
from experiments.reports.figures.floor_plan import LEVEL_TEXT, semi_axes
from experiments.reports.figures.result_tables import Pair, ResultTables, of_pair
from experiments.reports.report.charts import rounded, thinned
from mapfusion.geometry.numerics import Float

MAP_TABLES = ("map_history", "true_pairs", "clouds", "paths")
MAP_TABLES += ("correspondences", "fused_history", "estimates")
MAX_BYTES = 4_000_000  # of the block: with Plotly and the pictures the report stays under 15 MB
_FINEST_STEP_M = 0.001  # a screen never shows a millimetre of a map
# Semi-axes from 1 mm to 100 m: 255 steps of 4.6 % each, which no eye tells apart.
ELLIPSE_MIN_M, ELLIPSE_MAX_M = 1e-3, 100.0
_COVARIANCE = ["cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2"]
_NO_LANDMARKS = {"at": [0, 0], "ellipses": [0, 0]}
_ANSWER = ["aligner", "iteration", "repetition"]
_STAGES = (("estimated", ""), ("refined", "refined_"))
_MOTION = ("tx_m", "ty_m", "theta_rad")
_ERROR = ("translation_error_m", "rotation_error_rad")

Json = dict[Any, Any]


def packed_ellipses(covariance_m2: Float) -> np.ndarray:
    """Plane covariances (N, 2, 2) as (N, 3) bytes: both semi-axes (logarithm), direction."""
    major, minor, direction = semi_axes(covariance_m2)
    span = np.log(ELLIPSE_MAX_M / ELLIPSE_MIN_M)
    axes = np.maximum([major, minor], ELLIPSE_MIN_M)
    lengths = np.clip(np.log(axes / ELLIPSE_MIN_M) / span, 0, 1) * 255
    columns = [*lengths, np.mod(direction, np.pi) / np.pi * 256]
    return np.stack(columns, -1).round().astype(np.int64).astype(np.uint8)  # 256 wraps to 0


def map_view(data: ResultTables) -> Json | None:
    """Index and block (in base64) of the map view; None where the result keeps no maps."""
    if not (data.has("map_history") and data.has("true_pairs") and data.pairs):
        return None
    view = _View(data)
    return {
        "level": LEVEL_TEXT,
        "no_truth": data.no_truth,
        "ellipse_m": [ELLIPSE_MIN_M, ELLIPSE_MAX_M],
        "robots": {name: view.robot(name) for name in data.robots},
        "pairs": [view.pair(pair) for pair in data.pairs],
        "starts": {robot: _pose(data.start_pose(robot)) for robot in data.robots},
        "walls": [[rounded(point) for point in wall] for wall in data.walls],
        "index_bytes": view.index_type.itemsize,
        "merge_aligner": data.scenario.get("merge", {}).get("aligner", ""),
        "left_out": view.n_left_out,
        "block": base64.b64encode(view.block).decode(),
    }


class _View:
    """Packs robots and pairs of robots into one block, one after the other."""

    def __init__(self, data: ResultTables) -> None:
        self.block = bytearray()
        self._data = data
        history, true_pairs = data.table("map_history"), data.table("true_pairs")
        iterations = np.unique(data.answers["iteration"])
        bytes_in_all = 7 * len(history) + 5 * int(true_pairs["n_correspondences"].sum())
        n_affordable = int(len(iterations) * MAX_BYTES / max(bytes_in_all, 1))
        self._shown = thinned(iterations, max(n_affordable, 1))
        self.n_left_out = len(iterations) - len(self._shown)
        wide = history["landmark"].max() > np.iinfo(np.uint16).max
        self.index_type = np.dtype("<u4" if wide else "<u2")
        self._step_m = {name: self._finest_step(name) for name in data.robots}

    def _of_robot(self, table: str, robot: str) -> pd.DataFrame:
        rows = self._data.rows(table)
        return rows[rows["robot"] == robot]

    def _finest_step(self, robot: str) -> float:
        """Metres a step, such that all that is drawn of the robot fits into 16 bits."""
        of_robot = [self._of_robot(name, robot) for name in ("map_history", "clouds", "paths")]
        drawn = [rows.filter(regex=r"^((online|truth)_)?[xy]_m$") for rows in of_robot]
        reach = max(np.nanmax(np.abs(points.to_numpy(float)), initial=0.0) for points in drawn)
        return max(_FINEST_STEP_M, float(reach) / np.iinfo(np.int16).max)

    def _pack(self, values: np.ndarray) -> list[int]:
        """Append an array at a multiple of its item size: [offset in bytes, number of items]."""
        self.block += b"\0" * (-len(self.block) % values.itemsize)
        offset = len(self.block)
        self.block += values.tobytes()
        return [offset, values.size]

    def _positions(self, rows: pd.DataFrame, robot: str, prefix: str = "") -> list[int]:
        points = rows[[f"{prefix}x_m", f"{prefix}y_m"]].to_numpy(dtype=np.float64)
        return self._pack(np.round(points / self._step_m[robot]).astype("<i2"))

    def _landmarks(self, rows: pd.DataFrame, robot: str) -> Json:
        at = self._positions(rows, robot)
        covariance_m2 = rows[_COVARIANCE].to_numpy(dtype=np.float64).reshape(-1, 2, 2)
        return {"at": at, "ellipses": self._pack(packed_ellipses(covariance_m2))}

    def robot(self, robot: str) -> Json:
        """Maps and particles by shown iteration, and the paths."""
        return {
            "step_m": self._step_m[robot],
            "maps": self._maps(robot),
            "clouds": self._clouds(robot),
            "paths": self._paths(robot),
        }

    def _maps(self, robot: str) -> list[Json]:
        """The latest map at each shown iteration; an empty map has no rows."""
        rows = self._of_robot("map_history", robot).sort_values(["iteration", "landmark"])
        maps = [own for _, own in rows.groupby("iteration")]
        known = np.unique(rows["iteration"])
        latest = (np.searchsorted(known, self._shown, side="right") - 1).tolist()
        packed = {k: self._landmarks(maps[k], robot) for k in sorted(set(latest)) if k >= 0}
        return [packed.get(k, _NO_LANDMARKS) for k in latest]

    def _clouds(self, robot: str) -> list[Json]:
        """The particles nearest in time; they may be a few frames off."""
        clouds = _by_iteration(self._of_robot("clouds", robot))
        if not clouds:
            return []
        known = np.array(list(clouds))
        nearest = known[np.abs(known[:, None] - self._shown).argmin(axis=0)]
        return [{"at": self._positions(clouds[k], robot)} for k in nearest.tolist()]

    def _paths(self, robot: str) -> Json:
        rows = self._of_robot("paths", robot).sort_values("iteration")
        if rows.empty:
            return {}
        paths: Json = {"theta_rad": rounded(rows["online_theta_rad"])}
        for path in ("online", "truth"):
            if np.isfinite(rows[[f"{path}_x_m", f"{path}_y_m"]]).all(axis=None):
                paths[path] = self._positions(rows, robot, f"{path}_")
        return paths

    def pair(self, pair: Pair) -> Json:
        """Correspondences, fused landmarks and alignments of two robots, iteration by iteration."""
        judged = of_pair(self._data.rows("true_pairs"), pair).set_index("iteration")
        offered = _by_iteration(of_pair(self._data.rows("correspondences"), pair))
        fused = _by_iteration(of_pair(self._data.rows("fused_history"), pair))
        met, frames = set(of_pair(self._data.answers, pair)["iteration"]), []
        for place, k in enumerate(self._shown.tolist()):
            if k not in met:
                continue
            frame: Json = {"iteration": k, "map": place}
            if k in offered and k in judged.index:
                is_true = unpacked(judged["true_pair"][k], judged["n_correspondences"][k])
                index = offered[k][["index_a", "index_b"]].to_numpy()
                frame["pairs"] = self._pack(index.astype(self.index_type))
                frame["true"] = self._pack(is_true.astype(np.uint8))
                frame["n_true"] = int(is_true.sum())
            if k in fused:
                frame["fused"] = self._landmarks(fused[k], pair[0])
            frames.append(frame)
        return {
            "robots": list(pair),
            "truth": _pose(self._data.true_alignment(pair)),
            # a's true start: drawn in the world, where the walls stand as one knows them
            "start": _pose(self._data.start_pose(pair[0])) or [0.0, 0.0, 0.0],
            "frames": frames,
            "alignments": self._alignments(pair, [frame["iteration"] for frame in frames]),
        }

    def _alignments(self, pair: Pair, iterations: list[int]) -> dict[str, list[Json | None]]:
        """By aligner and iteration: the first repetition's motion, as estimated and refined."""
        estimates = of_pair(self._data.rows("estimates"), pair)
        errors = of_pair(self._data.table("errors"), pair)
        first = estimates[estimates["repetition"] == 0]
        rows = first.merge(errors, "left", _ANSWER, suffixes=("", "_of_error")).to_dict("records")
        found = {(row["aligner"], row["iteration"]): _alignment(row) for row in rows}
        return {
            name: [found.get((name, k)) for k in iterations]
            for name in self._data.aligners
            if any((name, k) in found for k in iterations)
        }


def _by_iteration(rows: pd.DataFrame) -> dict[Any, pd.DataFrame]:
    return dict(iter(rows.groupby("iteration")))


def _pose(pose: Float | None) -> list[float | None] | None:
    return None if pose is None else rounded(pose)


def _alignment(row: Json) -> Json:
    """A row of `estimates` joined with that of `errors`."""
    reasons = (row["refined_reason"], row["reason"], row["acceptance_reason"])
    motion, error = (
        {stage: rounded([row[f"{prefix}{name}"] for name in names]) for stage, prefix in _STAGES}
        for names in (_MOTION, _ERROR)
    )
    return motion | {
        "accepted": bool(row["accepted"]),
        "status": str(row["refined_status"]),
        "reason": next((str(reason) for reason in reasons if reason), ""),
        "error": error,
    }
