"""Recording of a result for the Rerun viewer: pictures, maps, paths and alignments over time.

The timeline `frame` is the iteration. `experiments/docs/export.md` lists the entities. The package
of the viewer (500 MB) is optional and imported only here.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.pipeline.stages.align import alignment_of
from experiments.reports.figures.result_tables import Pair, ResultTables, of_pair, read_png
from experiments.reports.figures.style import FUSED_COLOUR
from mapfusion.errors import InputError
from mapfusion.files import write_whole
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import transform_points

_POINT_M, _LINE_M, _PARTICLE_M = 0.02, 0.004, 0.01  # radii
_FEATURE_PX = 2.0
_TIMELINE = "frame"


def write_rerun(data: ResultTables, path: Path) -> None:
    """Write the recording; raises InputError if the viewer's package is not installed."""
    if find_spec("rerun") is None:
        remedy = "pip install 'mapfusion[rerun]' installs it"
        raise InputError(f"--format rerun: the package rerun-sdk is not installed; {remedy}")
    name = data.folder.resolve().name

    def write(temporary: Path) -> None:
        recording = _Recording(name, temporary)
        for robot in data.robots:
            _add_robot(recording, data, robot)
        for pair in data.pairs:
            _add_pair(recording, data, pair)
        # The fused map at the end, coloured by the robots that each landmark comes from, and walls
        fused: pd.DataFrame = data.fused_map()
        recording.at(int(data.table("paths")["iteration"].max()))
        position = fused[["x_m", "y_m", "z_m"]].to_numpy(np.float64)
        several = fused["n_parents"].to_numpy() > 1
        recording.points("fused/several", position[several], FUSED_COLOUR, _POINT_M)
        for robot in data.robots:
            own = ~several & (fused["robot_a"] == robot).to_numpy()
            recording.points(f"fused/{robot}", position[own], data.colours[robot], _POINT_M)
        walls = [_in_plan(*wall[:, :2].T) for wall in data.walls_in_frame_of(data.fused_frame)]
        if walls:
            recording.lines("fused/walls", walls, FUSED_COLOUR)
        recording.close()

    write_whole(path, write)


class _Recording:
    """Rerun recording in a file."""

    def __init__(self, name: str, path: Path) -> None:
        rerun: Any = import_module("rerun")
        self._rerun = rerun
        # A fixed identifier instead of a random one: the viewer shows a result only once.
        self._stream: Any = rerun.RecordingStream(f"mapfusion {name}", recording_id=name)
        self._stream.save(path)
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)

    def at(self, iteration: int) -> None:
        """Set the frame of all later entries."""
        self._stream.set_time(_TIMELINE, sequence=iteration)

    def points(self, where: str, position_m: Float, colour: str, radius_m: float) -> None:
        """Log points, shape (N, 3)."""
        own = self._rerun.Points3D(position_m, radii=radius_m, colors=[_rgb(colour)])
        self._stream.log(where, own)

    def lines(self, where: str, strips_m: list[Float], colour: str) -> None:
        """Log lines, each of shape (n, 3)."""
        own = self._rerun.LineStrips3D(strips_m, radii=_LINE_M, colors=[_rgb(colour)])
        self._stream.log(where, own)

    def image(self, where: str, png: bytes) -> None:
        """Log a picture."""
        own = self._rerun.EncodedImage(contents=png, media_type="image/png")
        self._stream.log(where, own)

    def features(self, where: str, uv_px: Float, labels: list[str], colour: str) -> None:
        """Log points of a picture, shape (N, 2)."""
        own = self._rerun.Points2D(
            uv_px, radii=_FEATURE_PX, colors=[_rgb(colour)], labels=labels, show_labels=False
        )
        self._stream.log(where, own)

    def close(self) -> None:
        """Write everything to the file."""
        self._stream.flush()
        self._stream.disconnect()


def _rgb(colour: str) -> tuple[int, ...]:
    """Convert #RRGGBB to three values from 0 to 255."""
    return tuple(bytes.fromhex(colour.removeprefix("#")))


def _in_plan(x_m: Float, y_m: Float, z_m: float = 0.0) -> Float:
    """Return points at one height, shape (N, 3)."""
    return np.column_stack([x_m, y_m, np.full(len(x_m), z_m)])


def _add_robot(recording: _Recording, data: ResultTables, robot: str) -> None:
    """Log key frames with features; path, particles and map in the robot's own frame."""
    where, colour = f"robots/{robot}", data.colours[robot]
    tracks = data.rows("tracks")
    tracks = tracks[tracks["robot"] == robot]
    for file in sorted((data.folder / "keyframes").glob(f"{robot}_[0-9]*.png")):
        iteration = int(file.stem.removeprefix(f"{robot}_"))
        now = tracks[tracks["iteration"] == iteration]
        recording.at(iteration)
        recording.image(f"images/{robot}", read_png(file))
        labels = [
            f"track {t}, {n} frames" for t, n in zip(now["track"], now["length"], strict=True)
        ]
        uv_px = now[["u_px", "v_px"]].to_numpy(np.float64)
        recording.features(f"images/{robot}/features", uv_px, labels, colour)
    path = _in_plan(*data.path_of(robot).T)
    for iteration, landmarks in _history(data, robot).items():
        recording.at(iteration)
        recording.lines(f"{where}/path", [path[: iteration + 1]], colour)
        recording.points(f"{where}/map", landmarks, colour, _POINT_M)
    clouds = data.rows("clouds")
    for iteration, cloud in clouds[clouds["robot"] == robot].groupby("iteration"):
        recording.at(int(iteration))  # pyright: ignore[reportArgumentType]
        position = _in_plan(cloud["x_m"].to_numpy(), cloud["y_m"].to_numpy())
        recording.points(f"{where}/particles", position, colour, _PARTICLE_M)


def _history(data: ResultTables, robot: str) -> dict[int, Float]:
    """Return the landmarks in plan, shape (N, 3), by evaluated iteration."""
    rows = data.rows("map_history")
    rows = rows[rows["robot"] == robot].sort_values(["iteration", "landmark"])
    groups = rows.groupby("iteration")
    return {int(k): _in_plan(own["x_m"], own["y_m"]) for k, own in groups}  # pyright: ignore[reportArgumentType]


def _add_pair(recording: _Recording, data: ResultTables, pair: Pair) -> None:
    """Log both maps as aligned for the merge, their pairs, and the fused landmarks."""
    rows = of_pair(data.rows("estimates"), pair)
    used = rows["aligner"] == data.scenario.get("merge", {}).get("aligner")
    rows = rows[used & (rows["repetition"] == 0)].sort_values("iteration")
    maps = [_history(data, robot) for robot in pair]
    offered = of_pair(data.rows("correspondences"), pair)
    fused = of_pair(data.rows("fused_history"), pair)
    where = f"pairs/{pair[0]}-{pair[1]}"
    for row in rows.to_dict("records"):
        k = int(row["iteration"])
        found = alignment_of(row, int(row["n_correspondences"]))
        if not found.ok or any(k not in own for own in maps):
            continue
        a, b = maps[0][k], transform_points(found.T_a_b, maps[1][k])
        own = offered[offered["iteration"] == k]
        index_a, index_b = own[["index_a", "index_b"]].to_numpy()[found.inlier].T
        recording.at(k)
        for robot, points in zip(pair, (a, b), strict=True):
            recording.points(f"{where}/{robot}", points, data.colours[robot], _POINT_M)
        strips = list(np.stack([a[index_a], b[index_b]], axis=1))
        recording.lines(f"{where}/correspondences", strips, FUSED_COLOUR)
        now = fused[fused["iteration"] == k]
        position = _in_plan(now["x_m"].to_numpy(), now["y_m"].to_numpy())
        recording.points(f"{where}/fused", position, FUSED_COLOUR, _POINT_M)
