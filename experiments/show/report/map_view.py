"""What the map view draws: plans of all evaluated iterations, packed into one block of bytes.

Numbers are little-endian, in the order and with the offsets that the index beside the block tells.
Positions are 16-bit steps of `step_m` in the robot's own frame, ellipses three bytes: both
semi-axes on a logarithmic scale and the direction. A map of 2000 landmarks takes 14 kB.
"""

import base64
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from experiments.run.estimates import inlier_mask
from experiments.show.figures.ellipses import LEVEL_TEXT, semi_axes
from experiments.show.figures.result_tables import Pair, ResultTables, of_pair
from experiments.show.report.curves import rounded
from mapfusion.se2 import Float

MAX_BYTES = 4_000_000  # of the block: with Plotly and the pictures the report stays under 15 MB
_FINEST_STEP_M = 0.001  # a screen never shows a millimetre of a map
_INT16 = np.iinfo(np.int16).max
# Semi-axes from 1 mm to 100 m: 255 steps of 4.6 % each, which no eye tells apart.
ELLIPSE_MIN_M, ELLIPSE_MAX_M = 1e-3, 100.0
_PATHS = {"online": "online", "truth": "truth"}


@dataclass
class Block:
    """Arrays one after the other, each at a multiple of its item size."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, values: np.ndarray) -> list[int]:
        """Append an array; returns [offset in bytes, number of items]."""
        padding = -self.size % values.itemsize
        data = b"\0" * padding + values.tobytes()
        offset = self.size + padding
        self.parts.append(data)
        self.size += len(data)
        return [offset, values.size]

    def text(self) -> str:
        """The block in base64."""
        return base64.b64encode(b"".join(self.parts)).decode("ascii")


def quantised(plan_m: Float, step_m: float) -> np.ndarray:
    """Points (N, 2) as (N, 2) int16 steps."""
    return np.round(np.asarray(plan_m, dtype=np.float64) / step_m).astype("<i2")


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


def map_view(data: ResultTables, table: Callable[[str], pd.DataFrame | None]) -> dict | None:
    """Index and block of the map view.

    Args:
        data: the result.
        table: gives a table, or None where the result does not hold it.

    Returns:
        JSON-able values, the block in base64 under `block`; None where the result keeps no maps.
    """
    history, true_pairs = table("map_history"), table("true_pairs")
    if history is None or true_pairs is None or not data.pairs:
        return None
    robots = _Robots(history, table("clouds"), table("paths"))
    shown = _affordable(history, true_pairs)
    block = Block()
    view = {
        "level": LEVEL_TEXT,
        "ellipse_m": [ELLIPSE_MIN_M, ELLIPSE_MAX_M],
        "robots": {name: robots.packed(name, shown, block) for name in data.robots},
        "pairs": [
            _pair(data, pair, true_pairs, table, shown, robots, block) for pair in data.pairs
        ],
        "starts": {robot: _pose(data.start_pose(robot)) for robot in data.robots},
        "walls": [[rounded(point) for point in wall] for wall in data.walls],
        "index_bytes": robots.index_type.itemsize,
        "merge_aligner": data.scenario.get("merge", {}).get("aligner", ""),
        "left_out": int(true_pairs["iteration"].nunique() - len(shown)),
    }
    return view | {"block": block.text()}


def _affordable(history: pd.DataFrame, true_pairs: pd.DataFrame) -> np.ndarray:
    """Evaluated iterations, evenly thinned until the block fits; the last one stays."""
    iterations = np.unique(true_pairs["iteration"].to_numpy())
    bytes_in_all = 7 * len(history) + 5 * int(true_pairs["n_correspondences"].sum())
    n = int(np.clip(len(iterations) * MAX_BYTES / max(bytes_in_all, 1), 1, len(iterations)))
    return iterations[np.linspace(len(iterations) - 1, 0, n).round().astype(int)[::-1]]


class _Robots:
    """Each robot's maps, particles and paths."""

    def __init__(
        self, history: pd.DataFrame, clouds: pd.DataFrame | None, paths: pd.DataFrame | None
    ) -> None:
        self._history = _by(history, "robot")
        self._clouds = _by(clouds, "robot")
        self._paths = _by(paths, "robot")
        wide = history["landmark"].max() > np.iinfo(np.uint16).max
        self.index_type = np.dtype("<u4" if wide else "<u2")
        self.step_m = {robot: self._step(robot) for robot in self._history}

    def _step(self, robot: str) -> float:
        found = [self._history[robot][["x_m", "y_m"]].to_numpy(dtype=np.float64)]
        if robot in self._clouds:
            found.append(self._clouds[robot][["x_m", "y_m"]].to_numpy())
        if robot in self._paths:
            path = self._paths[robot]
            found += [path[[f"{p}_x_m", f"{p}_y_m"]].to_numpy() for p in _PATHS]
        reach = max((float(np.nanmax(np.abs(f))) for f in found if np.isfinite(f).any()), default=0)
        return max(_FINEST_STEP_M, reach / _INT16)

    def packed(self, robot: str, shown: np.ndarray, block: Block) -> dict[str, Any]:
        """Maps and particles by shown iteration, and the paths."""
        step_m = self.step_m[robot]
        return {
            "step_m": step_m,
            "maps": self._maps(robot, shown, step_m, block),
            "clouds": self._particles(robot, shown, step_m, block),
            "paths": self._lines(robot, step_m, block),
        }

    def _maps(
        self, robot: str, shown: np.ndarray, step_m: float, block: Block
    ) -> list[dict[str, Any]]:
        rows = self._history[robot].sort_values(["iteration", "landmark"])
        by_iteration = _by(rows, "iteration")
        kept: dict[int, dict[str, Any]] = {}
        maps = []
        for wanted in shown.tolist():
            k = max((i for i in by_iteration if i <= wanted), default=None)
            if k is None:  # nothing mapped yet, or an empty map, which has no rows
                maps.append({"at": [0, 0], "ellipses": [0, 0]})
                continue
            if k not in kept:
                kept[k] = _packed_points(by_iteration[k], step_m, block)
            maps.append(kept[k])
        return maps

    def _particles(
        self, robot: str, shown: np.ndarray, step_m: float, block: Block
    ) -> list[dict[str, Any]]:
        rows = self._clouds.get(robot)
        if rows is None or rows.empty:
            return []
        by_iteration = _by(rows, "iteration")
        known = np.array(sorted(by_iteration))
        clouds = []
        for wanted in shown.tolist():
            # the cloud nearest in time; it may be a few frames off
            k = int(known[np.argmin(np.abs(known - wanted))])
            points = by_iteration[k][["x_m", "y_m"]].to_numpy()
            clouds.append({"iteration": k, "at": block.add(quantised(points, step_m))})
        return clouds

    def _lines(self, robot: str, step_m: float, block: Block) -> dict[str, Any]:
        if robot not in self._paths:
            return {}
        rows = self._paths[robot].sort_values("iteration")
        lines: dict[str, Any] = {}
        for name, source in _PATHS.items():
            points = rows[[f"{source}_x_m", f"{source}_y_m"]].to_numpy()
            if np.isfinite(points).all():
                lines[name] = block.add(quantised(points, step_m))
        lines["theta_rad"] = rounded(rows["online_theta_rad"])
        return lines


def _by(rows: pd.DataFrame | None, column: str) -> dict[Any, pd.DataFrame]:
    return {} if rows is None else dict(iter(rows.groupby(column)))


def _packed_points(rows: pd.DataFrame, step_m: float, block: Block) -> dict[str, Any]:
    covariance = np.empty((len(rows), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = rows["cov_xx_m2"], rows["cov_yy_m2"]
    covariance[:, 0, 1] = covariance[:, 1, 0] = rows["cov_xy_m2"]
    return {
        "at": block.add(quantised(rows[["x_m", "y_m"]].to_numpy(), step_m)),
        "ellipses": block.add(packed_ellipses(covariance)),
    }


def _pair(
    data: ResultTables,
    pair: Pair,
    true_pairs: pd.DataFrame,
    table: Callable[[str], pd.DataFrame | None],
    shown: np.ndarray,
    robots: _Robots,
    block: Block,
) -> dict[str, Any]:
    judged = _records(of_pair(true_pairs, pair), ["iteration"])
    offered, fused = (
        _by(_of_pair(table(name), pair), "iteration")
        for name in ("correspondences", "fused_history")
    )
    T_true, start = data.true_alignment(pair), data.start_pose(pair[0])
    frames = []
    for place, k in enumerate(shown.tolist()):
        if (k,) not in judged:
            continue
        frame: dict[str, Any] = {"iteration": k, "map": place}
        if k in offered:
            row = judged[(k,)]
            is_true = inlier_mask(row["true_pair"], row["n_correspondences"])
            rows = offered[k][["index_a", "index_b"]].to_numpy()
            frame["pairs"] = block.add(rows.astype(robots.index_type))
            frame["true"] = block.add(is_true.astype(np.uint8))
            frame["n_true"] = int(is_true.sum())
        if k in fused:
            frame["fused"] = _packed_points(fused[k], robots.step_m[pair[0]], block)
        frames.append(frame)
    return {
        "robots": list(pair),
        "truth": _pose(T_true),
        # a's true start; the view is drawn in the world, where the walls stand as one knows them
        "start": _pose(start) or [0.0, 0.0, 0.0],
        "frames": frames,
        "alignments": _alignments(data, pair, table("estimates"), [f["iteration"] for f in frames]),
    }


def _pose(pose: Float | None) -> list[float | None] | None:
    return None if pose is None else rounded(pose)


def _alignments(
    data: ResultTables, pair: Pair, estimates: pd.DataFrame | None, iterations: list[int]
) -> dict[str, list[dict[str, Any] | None]]:
    """By aligner and iteration: the first repetition's motion, as estimated and refined."""
    if estimates is None:
        return {}
    keys = ["aligner", "iteration"]
    first, errors = (
        _records(rows[rows["repetition"] == 0], keys)
        for rows in (of_pair(estimates, pair), of_pair(data.table("errors"), pair))
    )
    return {
        name: [
            _alignment(first[name, k], errors[name, k]) if (name, k) in first else None
            for k in iterations
        ]
        for name in data.aligners
        if any((name, k) in first for k in iterations)
    }


def _of_pair(rows: pd.DataFrame | None, pair: Pair) -> pd.DataFrame | None:
    return None if rows is None else of_pair(rows, pair)


def _records(rows: pd.DataFrame, keys: list[str]) -> dict[tuple[Any, ...], dict[Any, Any]]:
    """Rows by their keys."""
    return {tuple(row[key] for key in keys): row for row in rows.to_dict("records")}


def _alignment(estimate: dict[Any, Any], error: dict[Any, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "accepted": bool(error.get("accepted", estimate["refined_status"] == "accepted")),
        "status": str(estimate["refined_status"]),
        "reason": str(
            estimate["refined_reason"]
            or estimate["reason"]
            or estimate.get("acceptance_reason")
            or ""
        ),
        "error": {},
    }
    for stage, prefix in (("estimated", ""), ("refined", "refined_")):
        found[stage] = rounded([estimate[f"{prefix}{n}"] for n in ("tx_m", "ty_m", "theta_rad")])
        names = (f"{prefix}translation_error_m", f"{prefix}rotation_error_rad")
        found["error"][stage] = rounded([error[name] for name in names])
    return found
