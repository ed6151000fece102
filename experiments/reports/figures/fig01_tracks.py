"""Figure 1: Harris points, described by U-SURF, tracked over consecutive key frames."""

import io
import re
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.reports.figures.result_tables import NothingToDraw, ResultTables, read_png
from experiments.reports.figures.style import PAGE_WIDTH_IN

READS = ("robots", "tracks")
_MAX_FRAMES, _TRAIL_FRAMES = 4, 5
_KEY_FRAME = re.compile(r"(?P<robot>.+)_(?P<iteration>\d+)\.png")


def draw(data: ResultTables) -> Figure:
    """The last consecutive key frames of one robot, points coloured by the age of their track."""
    robot, frames = _consecutive_frames(data)
    tracks = data.of_robot("tracks", robot)
    shown = tracks[tracks["iteration"].isin(list(frames))]
    if shown.empty:
        raise NothingToDraw(f"no tracked points at {robot}'s key frames")
    columns = min(2, len(frames))
    rows = -(-len(frames) // columns)
    figure = Figure(figsize=(PAGE_WIDTH_IN, 2.55 * rows * 2 / columns + 0.5))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    colours = ScalarMappable(Normalize(1, max(2, shown["length"].max())), "viridis")
    for axes, (iteration, path) in zip(panels, frames.items(), strict=False):
        _show_image(axes, path)
        _add_tracks(axes, tracks, iteration, {"cmap": colours.cmap, "norm": colours.norm})
        axes.set_title(f"{robot}, k = {iteration}")
    for axes in panels[len(frames) :]:
        axes.set_axis_off()
    figure.supxlabel("u (pixels)", fontsize=8)
    figure.supylabel("v (pixels)", fontsize=8)
    ages = {"label": "age of the track (frames)", "ticks": MaxNLocator(integer=True)}
    figure.colorbar(colours, ax=list(panels), shrink=0.8, aspect=30, **ages)
    return figure


def _consecutive_frames(data: ResultTables) -> tuple[str, dict[int, Path]]:
    """The robot with the longest run of consecutive key frames, and the end of that run."""
    robot, best = "", {}
    named = [(_KEY_FRAME.fullmatch(p.name), p) for p in (data.folder / "keyframes").glob("*.png")]
    for each in data.robots:
        run: dict[int, Path] = {}
        frames = {int(m["iteration"]): path for m, path in named if m and m["robot"] == each}
        for iteration, path in sorted(frames.items()):
            run = (run if iteration - 1 in run else {}) | {iteration: path}
            if len(run) > len(best):
                robot, best = each, run
    if not best:
        raise NothingToDraw("no key frames were kept: no images, or none from `keep.images_at` on")
    return robot, dict(list(best.items())[-_MAX_FRAMES:])


def _show_image(axes: Axes, path: Path) -> None:
    image = matplotlib.image.imread(io.BytesIO(read_png(path)))
    axes.imshow(image, cmap="gray", vmin=0, vmax=1)
    axes.autoscale(enable=False)  # points near the border must not widen the view
    axes.grid(visible=False)


def _add_tracks(axes: Axes, tracks: pd.DataFrame, iteration: int, colours: dict[str, Any]) -> None:
    now = tracks[tracks["iteration"] == iteration]
    if now.empty:
        return
    since = tracks["iteration"].between(iteration - _TRAIL_FRAMES, iteration)
    recent = tracks[tracks["track"].isin(now["track"]) & since].sort_values("track", kind="stable")
    track = recent["track"].to_numpy()
    ends = np.flatnonzero(np.append(track[1:] != track[:-1], True))
    trails = np.split(recent[["u_px", "v_px"]].to_numpy(), ends[:-1] + 1)
    lengths = recent["length"].to_numpy(np.float64)[ends]
    lines = LineCollection(trails, array=lengths, linewidths=1.2, zorder=2, **colours)
    axes.add_collection(lines, autolim=False)
    rim = {"s": 14, "edgecolors": "white", "linewidths": 0.5, "zorder": 3}
    axes.scatter(now["u_px"], now["v_px"], c=now["length"], **rim, **colours)
