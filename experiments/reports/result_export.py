"""Export of a result: trajectories, pose graphs, point clouds, recordings for Rerun.

Everything comes from the result folder. `mapfusion docs export` describes files, keys, frames and
the entities of recordings. The package of the Rerun viewer (500 MB) is optional.
"""

import re
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.alignment_criteria import is_used_by_team
from experiments.evaluation.result import require_result
from experiments.pipeline.stages.align import alignment_of
from experiments.reports.export import write_text
from experiments.reports.figures.result_tables import Pair, ResultTables, of_pair, read_png
from experiments.scenario.world_settings import NAME_PATTERN
from mapfusion.datasets.kitti import kitti_text
from mapfusion.datasets.text_files import tum_covariance_text, tum_text
from mapfusion.errors import InputError, not_installed
from mapfusion.exchange import G2oGraph
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.files import POSE_FIELDS, write_atomically
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import coloured_ply, joint_path, read_map
from mapfusion.plotting import FUSED_COLOUR
from mapfusion.viewing import viewing_paths

# Smallest standard deviation of an odometry edge. A solver needs a positive one, but the motion
# noise of a robot at rest is zero. A tenth of the resolution of encoders over a frame.
_LEAST_SIGMA = np.array([1e-4, 1e-4, 1e-4])  # m, m, rad
_SOURCES = ("final", "online", "odometry", "truth")
_MOTION = ["tx_m", "ty_m", "theta_rad"]
_FUSED, _SMOOTHED = "fused", "smoothed"
_RERUN = "rerun"
_POINT_M, _LINE_M, _PARTICLE_M = 0.02, 0.004, 0.01  # radii
_FEATURE_PX = 2.0
_TIMELINE = "frame"  # of recordings: the iteration


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
    # All texts are made before the first file is written.
    made = [(target / name, text) for name, text in _FILES[kind](data)]
    for path, text in made:
        write_text(path, text)
    return [path for path, _ in made]


def _tum_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each robot and path, with the times of the log, and covariances."""
    if not data.has("frame_times"):
        raise InputError(f"{data.folder}: holds no times of frames; run it again")
    for robot, source, frame, path in _paths(data):
        time_s = data.of_robot("frame_times", robot)["time_s"].to_numpy()[: len(path)]
        yield f"{robot}.{source}.tum", tum_text(time_s, path, f"{robot}, {source}: {frame}")
        if source == _SMOOTHED:
            covariances = tum_covariance_text(time_s, *data.smoothed_path_of(robot))
            yield f"{robot}.{source}.cov", covariances


def _kitti_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each robot and path that is known in every frame, as KITTI requires."""
    for robot, source, _, path in _paths(data):
        if np.isfinite(path).all():
            yield f"{robot}.{source}.kitti.txt", kitti_text(path)


def _paths(data: ResultTables) -> Iterator[tuple[str, str, str, Float]]:
    """Yield robot, path, description of its frame, and poses (T, 3) in that frame."""
    for robot in data.robots:
        paths = {source: _path(data, robot, source) for source in _SOURCES}
        paths[_SMOOTHED] = data.smoothed_path_of(robot)[0]
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
    """Yield one graph of all robots: poses, landmarks, odometry and the alignments used."""
    try:
        noise = MotionNoise(**data.scenario["slam"]["filter"]["motion"])  # assumed by the filter
    except (KeyError, TypeError, ValueError) as error:
        reason = f"slam.filter.motion: cannot be read ({error})"
        raise InputError(f"{data.folder / 'scenario.json'}: {reason}") from error
    graph, first = G2oGraph(), dict[str, int]()
    for robot in data.robots:
        T = _placed(data, robot)
        whose = robot if T is None else data.fused_frame
        T = np.zeros(3) if T is None else T
        graph.add_comment(f"{robot}, in the frame of {whose}: poses, one a frame; then landmarks")
        poses = graph.add_poses(se2.compose(T, _path(data, robot, "final")))
        first[robot] = int(poses[0])
        path = _path(data, robot, "odometry")
        motions = se2.between(path[:-1], path[1:])
        for i, j, motion in zip(poses[:-1].tolist(), poses[1:].tolist(), motions, strict=True):
            sigma = np.maximum(noise.standard_deviations(motion), _LEAST_SIGMA)
            graph.add_motion(i, j, motion, np.diag(sigma**2))
        # Landmarks are seen from the first pose, the origin of the robot's map.
        position, covariance = data.landmarks_of(robot)
        points = graph.add_points(se2.transform_points(T, position)[:, :2])
        seen = zip(points.tolist(), position[:, :2], covariance[:, :2, :2], strict=True)
        for point, p, S in seen:
            graph.add_sighting(first[robot], point, p, S)
    edges = data.rows("team_edges")
    for a, b in edges.loc[is_used_by_team(edges), ["robot_a", "robot_b"]].itertuples(index=False):
        row: dict[Any, Any] = _merge_estimates(data, (a, b)).iloc[-1].to_dict()
        found = alignment_of(row, int(row["n_correspondences"]))
        graph.add_motion(first[a], first[b], found.T_a_b, found.covariance)
    yield "team.g2o", graph.text()


def _merge_estimates(data: ResultTables, pair: Pair) -> pd.DataFrame:
    """Return a pair's estimates by the aligner of the merge, by iteration."""
    rows = of_pair(data.rows("estimates"), pair)
    used = rows["aligner"] == data.scenario.get("merge", {}).get("aligner")
    return rows[used & (rows["repetition"] == 0)].sort_values("iteration")


def _ply_files(data: ResultTables) -> Iterator[tuple[str, str]]:
    """Yield one file for each map of the result."""
    files = sorted((data.folder / "maps").glob("*.parquet"))
    # Joint covariances and viewing evidence are stored beside the maps.
    beside = {each for path in files for each in (joint_path(path), *viewing_paths(path))}
    for path in (file for file in files if file not in beside):
        landmarks, name = read_map(path), path.stem
        robot = name.partition(".")[0]  # R1.smoothed belongs to R1 too
        colours = np.tile(_rgb(data.colours.get(robot, FUSED_COLOUR)), (len(landmarks), 1))
        if name == _FUSED:
            # Fused landmarks of a single robot have the colour of this robot.
            rows: pd.DataFrame = data.fused_map().sort_values("landmark")
            if len(rows) != len(landmarks):
                counts = f"{len(rows)} rows, the fused map has {len(landmarks)} landmarks"
                raise InputError(f"{data.folder}: table of fused landmarks has {counts}")
            for parent, colour in data.colours.items():
                alone = (rows["n_parents"] == 1) & (rows["robot_a"] == parent)
                colours[alone.to_numpy()] = _rgb(colour)
        yield f"{name}.ply", coloured_ply(landmarks, colours)


def _rgb(colour: str) -> tuple[int, ...]:
    """Convert #RRGGBB to three values from 0 to 255."""
    return tuple(bytes.fromhex(colour.removeprefix("#")))


_FILES: dict[str, Callable[[ResultTables], Iterator[tuple[str, str]]]] = {
    "tum": _tum_files,
    "kitti": _kitti_files,
    "g2o": _g2o_files,
    "ply": _ply_files,
}


def write_rerun(data: ResultTables, path: Path) -> None:
    """Write the recording; raises InputError if the viewer's package is not installed."""
    if find_spec("rerun") is None:
        raise InputError(f"--format rerun: {not_installed('rerun-sdk', 'rerun')}")

    def write(temporary: Path) -> None:
        recording = _Recording(data, temporary)
        for robot in data.robots:
            recording.add_robot(robot)
        for pair in data.pairs:
            recording.add_pair(pair)
        recording.add_fused_map()
        recording.close()

    write_atomically(path, write)


class _Recording:
    """Rerun recording of a result in a file."""

    def __init__(self, data: ResultTables, path: Path) -> None:
        rerun: Any = import_module("rerun")
        self._data, self._rerun = data, rerun
        # A fixed identifier instead of a random one: the viewer shows a result only once.
        name = data.folder.resolve().name
        self._stream: Any = rerun.RecordingStream(f"mapfusion {name}", recording_id=name)
        self._stream.save(path)
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)

    def close(self) -> None:
        """Write everything to the file."""
        self._stream.flush()
        self._stream.disconnect()

    def add_robot(self, robot: str) -> None:
        """Log key frames with features; path, particles and map in the robot's own frame."""
        data, where, colour = self._data, f"robots/{robot}", self._data.colours[robot]
        tracks = data.rows("tracks")
        tracks = tracks[tracks["robot"] == robot]
        for file in sorted((data.folder / "keyframes").glob(f"{robot}_[0-9]*.png")):
            iteration = int(file.stem.removeprefix(f"{robot}_"))
            now = tracks[tracks["iteration"] == iteration]
            self._set_iteration(iteration)
            image = self._rerun.EncodedImage(contents=read_png(file), media_type="image/png")
            self._stream.log(f"images/{robot}", image)
            labels = [
                f"track {t}, {n} frames" for t, n in zip(now["track"], now["length"], strict=True)
            ]
            features = self._rerun.Points2D(
                now[["u_px", "v_px"]].to_numpy(np.float64),
                radii=_FEATURE_PX,
                colors=[_rgb(colour)],
                labels=labels,
                show_labels=False,
            )
            self._stream.log(f"images/{robot}/features", features)
        path = _in_plan(*data.path_of(robot).T)
        for iteration, landmarks in self._map_history(robot).items():
            self._set_iteration(iteration)
            self._add_lines(f"{where}/path", [path[: iteration + 1]], colour)
            self._add_points(f"{where}/map", landmarks, colour)
        clouds = data.rows("clouds")
        for iteration, cloud in clouds[clouds["robot"] == robot].groupby("iteration"):
            self._set_iteration(int(iteration))  # pyright: ignore[reportArgumentType]
            position = _in_plan(cloud["x_m"].to_numpy(), cloud["y_m"].to_numpy())
            self._add_points(f"{where}/particles", position, colour, _PARTICLE_M)

    def add_pair(self, pair: Pair) -> None:
        """Log both maps as aligned for the merge, their pairs, and the fused landmarks."""
        data, where = self._data, f"pairs/{pair[0]}-{pair[1]}"
        maps = [self._map_history(robot) for robot in pair]
        offered = of_pair(data.rows("correspondences"), pair)
        fused = of_pair(data.rows("fused_history"), pair)
        for row in _merge_estimates(data, pair).to_dict("records"):
            k = int(row["iteration"])
            found = alignment_of(row, int(row["n_correspondences"]))
            if not found.ok or any(k not in own for own in maps):
                continue
            a, b = maps[0][k], se2.transform_points(found.T_a_b, maps[1][k])
            own = offered[offered["iteration"] == k]
            index_a, index_b = own[["index_a", "index_b"]].to_numpy()[found.inlier].T
            self._set_iteration(k)
            for robot, points in zip(pair, (a, b), strict=True):
                self._add_points(f"{where}/{robot}", points, data.colours[robot])
            strips = list(np.stack([a[index_a], b[index_b]], axis=1))
            self._add_lines(f"{where}/correspondences", strips, FUSED_COLOUR)
            now = fused[fused["iteration"] == k]
            position = _in_plan(now["x_m"].to_numpy(), now["y_m"].to_numpy())
            self._add_points(f"{where}/fused", position, FUSED_COLOUR)

    def add_fused_map(self) -> None:
        """Log the last fused map, coloured by the robots of each landmark, and the walls."""
        data = self._data
        fused: pd.DataFrame = data.fused_map()
        self._set_iteration(int(data.table("paths")["iteration"].max()))
        position = fused[["x_m", "y_m", "z_m"]].to_numpy(np.float64)
        several = fused["n_parents"].to_numpy() > 1
        self._add_points("fused/several", position[several], FUSED_COLOUR)
        for robot in data.robots:
            own = ~several & (fused["robot_a"] == robot).to_numpy()
            self._add_points(f"fused/{robot}", position[own], data.colours[robot])
        walls = [_in_plan(*wall[:, :2].T) for wall in data.walls_in_frame_of(data.fused_frame)]
        if walls:
            self._add_lines("fused/walls", walls, FUSED_COLOUR)

    def _map_history(self, robot: str) -> dict[int, Float]:
        """Return the landmarks in plan, shape (N, 3), by evaluated iteration."""
        rows = self._data.rows("map_history")
        rows = rows[rows["robot"] == robot].sort_values(["iteration", "landmark"])
        groups = rows.groupby("iteration")
        return {int(k): _in_plan(landmarks["x_m"], landmarks["y_m"]) for k, landmarks in groups}  # pyright: ignore[reportArgumentType]

    def _set_iteration(self, iteration: int) -> None:
        """Set the iteration of all later entries."""
        self._stream.set_time(_TIMELINE, sequence=iteration)

    def _add_points(
        self, where: str, position_m: Float, colour: str, radius_m: float = _POINT_M
    ) -> None:
        """Log points, shape (N, 3)."""
        points = self._rerun.Points3D(position_m, radii=radius_m, colors=[_rgb(colour)])
        self._stream.log(where, points)

    def _add_lines(self, where: str, strips_m: list[Float], colour: str) -> None:
        """Log lines, each of shape (n, 3)."""
        lines = self._rerun.LineStrips3D(strips_m, radii=_LINE_M, colors=[_rgb(colour)])
        self._stream.log(where, lines)


def _in_plan(x_m: Float, y_m: Float) -> Float:
    """Return points on the ground, shape (N, 3)."""
    return np.column_stack([x_m, y_m, np.zeros(len(x_m))])
