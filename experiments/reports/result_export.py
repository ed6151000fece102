"""Export of a result: trajectories, pose graphs, point clouds.

Made from the result folder alone. How files, keys and frames are to be read is said in
`experiments/docs/export.md`.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.result import require_result
from experiments.evaluation.team_errors import is_used_by_team
from experiments.pipeline.tables import alignment_of
from experiments.reports.export import write_text
from experiments.reports.figures.result_tables import ResultTables
from experiments.reports.figures.style import FUSED_COLOUR
from experiments.reports.rerun_recording import write_rerun
from experiments.scenario.world_settings import NAME_PATTERN
from mapfusion.datasets.export import G2oGraph, ply_text
from mapfusion.datasets.kitti import kitti_text
from mapfusion.datasets.tum import tum_text
from mapfusion.errors import InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.files import POSE_FIELDS
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap, joint_path, read_map
from mapfusion.viewing import viewing_paths

# The least an odometry edge may claim to know: a solver cannot weigh what has no error at all, as
# standing still has none. A tenth of what encoders resolve over a frame.
_LEAST_SIGMA = np.array([1e-4, 1e-4, 1e-4])  # m, m, rad
_SOURCES = ("final", "online", "odometry", "truth")
_MOTION = ["tx_m", "ty_m", "theta_rad"]
_FUSED = "fused"
_RERUN = "rerun"


def export_result(result: Path, kind: str, folder: Path | None = None) -> list[Path]:
    """Write a result's files of one format, by default to `RESULT/export`, and return them.

    Raises:
        InputError: an unknown format, no result folder, or one that lacks what the format needs.
    """
    if kind not in (*_FILES, _RERUN):
        raise InputError(f"--format {kind}: unknown; known: {', '.join((*_FILES, _RERUN))}")
    require_result(result)
    data, target = ResultTables(result), folder or result / "export"
    for robot in data.robots:
        if not re.fullmatch(NAME_PATTERN, robot):
            raise InputError(f"{result}: robot is named {robot!r}, expected {NAME_PATTERN}")
    if kind == _RERUN:
        path = target / f"{result.resolve().name}.rrd"
        write_rerun(data, path)
        return [path]
    made = [
        (target / name, text) for name, text in _FILES[kind](data)
    ]  # all, before any is written
    for path, text in made:
        write_text(path, text)
    return [path for path, _ in made]


def _tum_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each robot and path, with the times of the log."""
    if not data.has("frame_times"):
        raise InputError(f"{data.folder}: holds no times of frames; run it again")
    for robot, source, frame, path in _paths(data):
        time_s = data.of_robot("frame_times", robot)["time_s"].to_numpy()
        yield f"{robot}.{source}.tum", tum_text(time_s, path, f"{robot}, {source}: {frame}")


def _kitti_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each robot and path that is known in every frame, as KITTI requires."""
    for robot, source, _, path in _paths(data):
        if np.isfinite(path).all():
            yield f"{robot}.{source}.kitti.txt", kitti_text(path)


def _paths(data: ResultTables) -> Iterator[tuple[str, str, str, Float]]:
    """Yield robot, path, description of its frame, and poses (T, 3) in that frame."""
    for robot in data.robots:
        paths = {source: _path(data, robot, source) for source in _SOURCES}
        placed, start = _placed(data, robot), data.start_pose(robot)
        frames = dict.fromkeys(paths, f"in {robot}'s own frame")
        if placed is not None:
            paths["fused"] = se2.compose(placed, paths["final"])
            frames["fused"] = f"the final path in the frame of the fused map, {data.fused_frame}'s"
        if start is not None:
            paths["world"] = se2.compose(start, paths["truth"])
            frames["world"] = "the truth in the world"
        for source, path in paths.items():
            if np.isfinite(path).any():
                yield robot, source, frames[source], path


def _path(data: ResultTables, robot: str, source: str) -> Float:
    """Return poses (T, 3) in the robot's own frame."""
    columns = [f"{source}_{name}" for name in POSE_FIELDS]
    return data.of_robot("paths", robot)[columns].to_numpy(dtype=np.float64)


def _placed(data: ResultTables, robot: str) -> Float | None:
    """Return T_fused_robot (3,), or None for a robot that shares no map with others."""
    motions = data.rows("fused_motions").set_index("robot")
    if robot not in motions.index or motions["tx_m"].notna().sum() < 2:
        return None
    T = motions.loc[robot, _MOTION].to_numpy(dtype=np.float64)
    return T if np.isfinite(T).all() else None


def _g2o_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield poses, landmarks and odometry of all robots, and the alignments that the team uses."""
    graph, first, noise = G2oGraph(), dict[str, int](), _motion_noise(data)
    for robot in data.robots:
        T = _placed(data, robot)
        whose = robot if T is None else data.fused_frame
        T = np.zeros(3) if T is None else T
        graph.add_comment(f"{robot}, in the frame of {whose}: poses, one a frame; then landmarks")
        poses = graph.add_poses(se2.compose(T, _path(data, robot, "final")))
        first[robot] = int(poses[0])
        _add_odometry(graph, poses, _path(data, robot, "odometry"), noise)
        _add_map(graph, int(poses[0]), T, *data.landmarks_of(robot))
    for a, b, row in _believed_alignments(data):
        found = alignment_of(row, int(row["n_correspondences"]))
        graph.add_motion(first[a], first[b], found.T_a_b, found.covariance)
    yield "team.g2o", graph.text()


def _motion_noise(data: ResultTables) -> MotionNoise:
    """Return the motion noise that the filter assumed."""
    try:
        return MotionNoise(**data.scenario["slam"]["filter"]["motion"])
    except (KeyError, TypeError, ValueError) as error:
        reason = f"slam.filter.motion: cannot be read ({error})"
        raise InputError(f"{data.folder / 'scenario.json'}: {reason}") from error


def _add_odometry(graph: G2oGraph, poses: np.ndarray, path: Float, noise: MotionNoise) -> None:
    motions = se2.between(path[:-1], path[1:])
    for i, j, motion in zip(poses[:-1].tolist(), poses[1:].tolist(), motions, strict=True):
        sigma = np.maximum(noise.standard_deviations(motion), _LEAST_SIGMA)
        graph.add_motion(i, j, motion, np.diag(sigma**2))


def _add_map(graph: G2oGraph, pose: int, T: Float, position: Float, covariance: Float) -> None:
    """Return landmarks (N, 3) in the frame of the robot's first pose, the origin of its map."""
    points = graph.add_points(se2.transform_points(T, position)[:, :2])
    for point, p, S in zip(points.tolist(), position[:, :2], covariance[:, :2, :2], strict=True):
        graph.add_sighting(pose, point, p, S)


def _believed_alignments(data: ResultTables) -> Iterator[tuple[str, str, dict[Any, Any]]]:
    """Yield robots a and b with the row of `estimates` that merged their maps."""
    edges, estimates = data.rows("team_edges"), data.rows("estimates")
    used = estimates["aligner"] == data.scenario.get("merge", {}).get("aligner")
    used &= estimates["repetition"] == 0
    for a, b in edges.loc[is_used_by_team(edges), ["robot_a", "robot_b"]].itertuples(index=False):
        of_pair = used & (estimates["robot_a"] == a) & (estimates["robot_b"] == b)
        rows = estimates[of_pair].sort_values("iteration")
        yield a, b, rows.iloc[-1].to_dict()


def _ply_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each map of the result."""
    files = sorted((data.folder / "maps").glob("*.parquet"))
    # what a map's landmarks have in common, and how they were seen, is no map
    beside = {each for path in files for each in (joint_path(path), *viewing_paths(path))}
    for path in (file for file in files if file not in beside):
        landmarks, name = read_map(path), path.stem
        robot = name.partition(".")[0]  # R1.smoothed is R1's, too
        colours = np.tile(_rgb(data.colours.get(robot, FUSED_COLOUR)), (len(landmarks), 1))
        if name == _FUSED:
            _colour_single(colours, data, landmarks)
        yield f"{name}.ply", ply_text(landmarks, colours)


def _colour_single(colours: np.ndarray, data: ResultTables, landmarks: LandmarkMap) -> None:
    """Colour fused landmarks of a single robot in its colour."""
    rows: pd.DataFrame = data.fused_map().sort_values("landmark")
    if len(rows) != len(landmarks):
        counts = f"{len(rows)} rows, the fused map has {len(landmarks)} landmarks"
        raise InputError(f"{data.folder}: table of fused landmarks has {counts}")
    for robot, colour in data.colours.items():
        alone = (rows["n_parents"] == 1) & (rows["robot_a"] == robot)
        colours[alone.to_numpy()] = _rgb(colour)


def _rgb(colour: str) -> np.ndarray:
    """Convert #RRGGBB to three values from 0 to 255."""
    return np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)])


_FILES: dict[str, Callable[[ResultTables], Iterator[tuple[str, str]]]] = {
    "tum": _tum_files,
    "kitti": _kitti_files,
    "g2o": _g2o_files,
    "ply": _ply_files,
}
