"""Maps of two robots in plan at every evaluated iteration, as a Plotly figure with a slider.

Landmarks, paths and particles keep the coordinates of their robot's map frame. An invisible carpet
trace of Plotly maps each frame into the world. The first robot's traces stand on the carpet of its
true start, and the second robot's on the carpet of the chosen alignment. So a coordinate is stored
once an iteration, although many alignments can be chosen.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from experiments.pipeline.stages.align import unpacked
from experiments.reports.figures.result_tables import Pair, ResultTables, of_pair
from experiments.reports.layout import metres, radians
from experiments.reports.report.charts import NEUTRAL, Attributes, Styles, escaped, faint, thinned
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, transform_points
from mapfusion.plotting import LEVEL_TEXT, ORANGE, semi_axes

MAP_TABLES = ("map_history", "true_pairs", "clouds", "paths")
MAP_TABLES += ("correspondences", "fused_history", "estimates")
MAX_BYTES = 8_000_000  # of coordinates in the file, about twice the size of Plotly itself
_BYTES_OF_POINT = 2 * 4 * 4 / 3  # two single-precision numbers, in base64
# Plotly draws a closed smooth curve through the four ends of an ellipse's axes. At its strongest
# smoothing the curve lies at most 6 % of the radius inside of the ellipse.
_ELLIPSE_ENDS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0], [np.nan, np.nan]])
SMOOTH = {"shape": "spline", "smoothing": 1.3, "width": 0}
_MAX_PATH_POINTS = 200
# Outline in metres of a robot that drives along x
_ROBOT_M = 0.4 * np.array([[1, 0], [-0.7, 0.65], [-0.35, 0], [-0.7, -0.65], [1, 0]])
_CARPET_SHARE = 10  # half the side of a carpet over the largest coordinate, for wide ellipses
_OUTLIER_SHARE = 0.005  # landmarks on each side that the first view may leave out
_MARGIN = 0.06  # of the view
_MS_PER_FRAME = 125  # of the animation
_COVARIANCE = ["cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2"]
_MOTION = ("tx_m", "ty_m", "theta_rad")
_ANSWER = ["aligner", "iteration", "repetition"]
_STAGES = {"refined": "refined_", "as estimated": ""}
_NO_POINTS = np.zeros((0, 2))
_HIDDEN_AT_FIRST = {"ellipses", "particles", "true", "false"}

Placement = tuple[str, str]  # aligner and stage
_View = tuple[Attributes, list[int]]  # values of each attribute, and indices of the traces
TRUTH: Placement = ("the truth", "")


class _Layer(NamedTuple):
    """Trace with its attributes at each iteration, and the selections that show it."""

    trace: Attributes
    at: Callable[[int], Attributes] | None = None  # None: constant attributes
    robot: str = ""  # shown with the pairs of this robot, on the robot's carpet
    pair: Pair | None = None  # shown with this pair
    placement: Placement | None = None  # shown with this placement


def map_figure(data: ResultTables, styles: Styles) -> go.Figure | None:
    """Draw the maps of all pairs of robots; None if the result keeps no maps.

    A menu selects the pair and the alignment that places the second map. The figure's
    `layout.meta.n_left_out` counts evaluated iterations that are left out to keep the file small.
    """
    if not (data.has("map_history") and data.has("true_pairs") and data.pairs):
        return None
    maps = _Maps(data, styles)
    layers, iterations = list(maps.layers()), maps.shown.tolist()
    moving = [(place, layer, layer.at) for place, layer in enumerate(layers) if layer.at]
    views = [
        (
            f"{pair[0]} – {pair[1]}: placed by {', '.join(filter(None, placement))}",
            _view(layers, maps, pair, placement),
        )
        for pair in data.pairs
        for placement in maps.placements[pair]
    ]
    traces = [layer.trace | (layer.at(iterations[-1]) if layer.at else {}) for layer in layers]
    attributes, drawn = views[0][1]
    for name, values in attributes.items():
        for place, value in zip(drawn, values, strict=True):
            traces[place] |= {} if value is None else {name: value}
    frames = [
        {
            "name": str(k),
            "traces": [place for place, _, _ in moving],
            "data": [{"type": layer.trace["type"], **at(k)} for _, layer, at in moving],
        }
        for k in iterations
    ]
    figure = go.Figure(data=traces, frames=frames)
    # A slider shows the frame of each iteration, two buttons play and stop them, and a menu selects
    # the pair and the alignment.
    show = {"mode": "immediate", "transition": {"duration": 0}}
    at_once = show | {"frame": {"duration": 0, "redraw": True}}
    steps = [
        {"label": str(k), "method": "animate", "args": [[str(k)], at_once]} for k in iterations
    ]
    slider = {"steps": steps, "active": len(steps) - 1, "x": 0.12, "len": 0.88, "pad": {"t": 40}}
    slider |= {"currentvalue": {"prefix": "iteration ", "xanchor": "left"}}
    run = show | {"frame": {"duration": _MS_PER_FRAME, "redraw": True}, "fromcurrent": True}
    play = {"label": "▶", "method": "animate", "args": [None, run]}
    stop = {"label": "❚❚", "method": "animate", "args": [[None], run | {"fromcurrent": False}]}
    buttons = {"type": "buttons", "direction": "left", "showactive": False, "buttons": [play, stop]}
    buttons |= {"x": 0, "xanchor": "left", "y": 0, "yanchor": "top", "pad": {"t": 50}}
    choices = [
        {"label": escaped(label), "method": "restyle", "args": list(view)} for label, view in views
    ]
    menu = {"buttons": choices, "x": 0, "xanchor": "left", "y": 1.01, "yanchor": "bottom"}
    (left, low), (right, high) = maps.bounds()
    axes = {"zeroline": False, "ticksuffix": " m"}
    of_text = {"visible": False, "range": [0, 1], "fixedrange": True}
    return figure.update_layout(
        height=780,
        hovermode="closest",
        dragmode="pan",
        meta={"n_left_out": maps.n_left_out},
        xaxis=axes | {"range": [left, right], "constrain": "domain"},
        yaxis=axes | {"range": [low, high], "scaleanchor": "x"},
        xaxis2=of_text | {"overlaying": "x"},
        yaxis2=of_text | {"overlaying": "y"},
        legend={"tracegroupgap": 0},
        sliders=[slider],
        updatemenus=[menu, buttons],
        margin={"t": 70, "b": 90},
    )


def _view(layers: list[_Layer], maps: "_Maps", pair: Pair, placement: Placement) -> _View:
    """Return the attributes that a pair of robots and a placement give to all drawn traces."""
    carpets = {pair[0]: maps.carpet_of(pair[0]), pair[1]: maps.carpet_of(pair, placement)}
    drawn = [place for place, layer in enumerate(layers) if layer.trace["type"] != "carpet"]
    chosen = [layers[place] for place in drawn]
    attributes = {
        "visible": [
            _at_first(layer, placement)
            if (not layer.robot or layer.robot in pair)
            and layer.pair in {None, pair}
            and layer.placement in {None, placement}
            else False
            for layer in chosen
        ],
        "carpet": [
            carpets.get(layer.robot, layer.trace.get("carpet"))
            if layer.trace["type"] == "scattercarpet"
            else None
            for layer in chosen
        ],
    }
    return attributes, drawn


def _at_first(layer: _Layer, placement: Placement) -> bool | str:
    """Return Plotly's visibility of a trace that a placement has: shown, or in the legend only.

    At first walls, paths and landmarks are shown; everything else would cover them.
    """
    meta = layer.trace.get("meta") or {}
    if meta.get("layer") == "frame":
        return meta["placement"][0] == placement[0] or "legendonly"
    fused = meta.get("layer") == "landmarks" and layer.pair is not None
    return "legendonly" if fused or meta.get("layer") in _HIDDEN_AT_FIRST else True


class _Maps:
    """Layers of the plan, made from the tables of a result."""

    def __init__(self, data: ResultTables, styles: Styles) -> None:
        self._data = data
        self._styles = styles
        history, true_pairs = data.table("map_history"), data.table("true_pairs")
        iterations = np.unique(data.answers["iteration"])
        n_landmarks = len(history) + len(data.rows("fused_history"))
        n_lines = int(true_pairs["n_correspondences"].sum())
        n_points = (1 + len(_ELLIPSE_ENDS)) * n_landmarks + len(data.rows("clouds"))
        n_points += 3 * 2 * n_lines  # two ends and a gap, of two placements
        n_affordable = int(len(iterations) * MAX_BYTES / (_BYTES_OF_POINT * max(n_points, 1)))
        self.shown = thinned(iterations, max(n_affordable, 1))
        self.n_left_out = len(iterations) - len(self.shown)
        self._maps: dict[str, dict[Any, pd.DataFrame]] = {
            str(robot): dict(iter(own.sort_values("landmark").groupby("iteration")))
            for robot, own in history.groupby("robot")
        }
        self._of_pair = {
            (name, pair): dict(iter(of_pair(data.rows(name), pair).groupby("iteration")))
            for name in ("correspondences", "fused_history", "true_pairs")
            for pair in data.pairs
        }
        # Answers of the first repetition with their errors, by aligner and iteration
        self._answers = dict[Pair, dict[tuple[str, int], dict[Any, Any]]]()
        for pair in data.pairs:
            estimates = of_pair(data.rows("estimates"), pair)
            errors = of_pair(data.table("errors"), pair)
            first = estimates[estimates["repetition"] == 0]
            rows = first.merge(errors, "left", _ANSWER, suffixes=("", "_of_error"))
            answers = rows.to_dict("records")
            self._answers[pair] = {(row["aligner"], row["iteration"]): row for row in answers}
        used = data.scenario.get("merge", {}).get("aligner", "")
        names = sorted(data.aligners, key=lambda name: name != used)
        self.placements: dict[Pair, list[Placement]] = {}
        for pair in data.pairs:
            answered = {name for name, _ in self._answers[pair]}
            known = [(name, stage) for name in names if name in answered for stage in _STAGES]
            truth = [TRUTH] if data.true_alignment(pair) is not None else []
            self.placements[pair] = known + truth

    def carpet_of(self, frame: str | Pair, placement: Placement | None = None) -> str:
        """Name the carpet of a robot at its true start, or of a pair's second robot as placed."""
        if isinstance(frame, str):
            return str(self._data.robots.index(frame))
        number = self.placements[frame].index(placement or TRUTH)
        return f"{self._data.pairs.index(frame)}/{number}"

    def _start(self, robot: str) -> Float:
        """Return the robot's true start pose, shape (3,); the identity without truth."""
        start = self._data.start_pose(robot)
        return np.zeros(3) if start is None else start

    def _placed(self, pair: Pair, placement: Placement, k: int) -> Float | None:
        """Return the second robot's map frame in the world at iteration k; None if unknown."""
        if placement == TRUTH:
            motion = self._data.true_alignment(pair)
        else:
            answer = self._answers[pair].get((placement[0], k), {})
            names = [f"{_STAGES[placement[1]]}{name}" for name in _MOTION]
            motion = np.array([answer.get(name, np.nan) for name in names], dtype=float)
        if motion is None or not np.isfinite(motion).all():
            return None
        return compose(self._start(pair[0]), motion)

    def bounds(self) -> Float:
        """Return the corners of the first view, shape (2, 2): all walls, or both maps."""
        points = list(self._data.walls)
        if not points:
            pair, k = self._data.pairs[0], int(self.shown[-1])
            frames = (self._start(pair[0]), self._placed(pair, self.placements[pair][0], k))
            for robot, frame in zip(pair, frames, strict=True):
                plan = _points(self._latest(robot, k))
                if frame is not None and len(plan):
                    middle = np.quantile(plan, [_OUTLIER_SHARE, 1 - _OUTLIER_SHARE], axis=0)
                    inside = ((plan >= middle[0]) & (plan <= middle[1])).all(axis=1)
                    points.append(transform_points(frame, plan[inside]))
        every = np.concatenate(points) if points else np.array([[-1.0, -1.0], [1.0, 1.0]])
        margin = _MARGIN * max(float(np.ptp(every, axis=0).max()), 1.0)
        return np.array([every.min(axis=0) - margin, every.max(axis=0) + margin])

    def layers(self) -> Iterator[_Layer]:
        """Yield all traces, the lowest first."""
        yield from self._carpets()
        yield _Layer(_line("walls", self._data.walls, width=1.2))
        for robot in self._data.robots:
            start = self._data.start_pose(robot)
            path = _points(self._rows_of("paths", robot), "truth_")
            if start is not None and len(path) and np.isfinite(path).all():
                drawn = [transform_points(start, thinned(path, _MAX_PATH_POINTS))]
                line = _line("true paths", drawn, width=1.2, dash="dash")
                first = robot == self._data.robots[0]
                yield _Layer(line | {"legendgroup": "true", "showlegend": first}, robot=robot)
        for pair in self._data.pairs:
            # Lines of correspondences, for the first placement and the truth. Lines for all
            # placements would make the file large: their ends are points of the world.
            for placement in self.placements[pair]:
                if placement not in {self.placements[pair][0], TRUTH}:
                    continue
                for wanted, kind in ((False, "false"), (True, "true")):
                    look = {"width": 1.1} if wanted else {"width": 0.8, "dash": "dot"}
                    meta = {"layer": kind, "pair": list(pair), "placement": list(placement)}
                    lines = _line(f"{kind} correspondences", [], **look)
                    yield _Layer(
                        lines | {"meta": meta, "opacity": 0.9 if wanted else 0.45},
                        lambda k, pair=pair, placement=placement, wanted=wanted: _xy(
                            self._ends(pair, placement, k, wanted)
                        ),
                        pair=pair,
                        placement=placement,
                    )
        for robot in self._data.robots:
            yield from self._layers_of_robot(robot)
        for pair in self._data.pairs:
            yield from self._layers_of_pair(pair)

    def _carpets(self) -> Iterator[_Layer]:
        """Yield the carpets of all robots at their true starts and of all alignments."""
        tables = [self._data.rows(name) for name in ("map_history", "clouds", "paths")]
        drawn = [rows.filter(regex=r"^(online_)?[xy]_m$").to_numpy(float) for rows in tables]
        largest = max(np.nanmax(np.abs(points), initial=1.0) for points in drawn)
        half = _CARPET_SHARE * float(largest)
        a, b = np.meshgrid([-half, half], [-half, half])
        off = {"showgrid": False, "showline": False, "startline": False, "endline": False}
        off |= {"showticklabels": "none"}
        sides: Attributes = {"type": "carpet", "a": [-half, half], "b": [-half, half]}
        sides |= {"aaxis": off, "baxis": off}

        def spread(frame: Float | None) -> Attributes:
            if frame is None:
                return {"visible": False}  # traces on an invisible carpet are not drawn
            corners = transform_points(frame, np.stack([a.ravel(), b.ravel()], -1))
            return {"visible": True, **{n: corners[:, i].reshape(2, 2) for i, n in enumerate("xy")}}

        for robot in self._data.robots:
            yield _Layer(sides | spread(self._start(robot)) | {"carpet": self.carpet_of(robot)})
        for pair in self._data.pairs:
            for placement in self.placements[pair]:
                meta = {"layer": "alignment", "pair": list(pair), "placement": list(placement)}
                named = {"carpet": self.carpet_of(pair, placement), "meta": meta}
                yield _Layer(
                    sides | spread(np.zeros(3)) | named,
                    lambda k, pair=pair, placement=placement: spread(
                        self._placed(pair, placement, k)
                    ),
                )

    def _ends(self, pair: Pair, placement: Placement, k: int, wanted: bool) -> Float:
        """Return both ends of true or false pairs in the world and a gap, shape (3 N, 2)."""
        rows, is_true = self._of_pair["correspondences", pair].get(k), self._is_true(pair, k)
        frame = self._placed(pair, placement, k)
        if rows is None or is_true is None or frame is None:
            return _NO_POINTS
        chosen = rows[is_true == wanted]
        ends = [
            transform_points(place, _points(self._latest(robot, k))[chosen[column]])
            for robot, column, place in zip(
                pair, ("index_a", "index_b"), (self._start(pair[0]), frame), strict=True
            )
        ]
        return np.stack([*ends, np.full_like(ends[0], np.nan)], axis=1).reshape(-1, 2)

    def _is_true(self, pair: Pair, k: int) -> np.ndarray | None:
        judged = self._of_pair["true_pairs", pair].get(k)
        if judged is None:
            return None
        return unpacked(judged["true_pair"].iloc[0], judged["n_correspondences"].iloc[0])

    def _layers_of_robot(self, robot: str) -> Iterator[_Layer]:
        """Yield the map, path, pose and particles in the robot's map frame."""
        colour, shown = self._data.colours[robot], escaped(robot)

        latest = partial(self._latest, robot)
        yield from self._landmarks(f"map of {shown}", colour, latest, robot=robot)
        path = self._rows_of("paths", robot)
        line = _points(path, "online_")
        if len(line) and np.isfinite(line).all():
            turn = path["online_theta_rad"].to_numpy()
            look = {"mode": "lines", "line": {"color": colour, "width": 2}}
            named = {"name": f"path of {shown}", "legendgroup": robot, "hoverinfo": "skip"}
            meta = {"layer": "path", "robot": robot}
            yield _Layer(
                _in_frame(**look, **named, meta=meta),
                lambda k: _ab(thinned(line[: k + 1], _MAX_PATH_POINTS)),
                robot=robot,
            )
            look = {"mode": "none", "fill": "toself", "fillcolor": colour, "showlegend": False}

            def outline(k: int) -> Attributes:
                last = min(k, len(line) - 1)
                return _ab(transform_points([*line[last], turn[last]], _ROBOT_M))

            yield _Layer(_in_frame(**look, **named, meta=None), outline, robot=robot)
        clouds = dict(iter(self._rows_of("clouds", robot).groupby("iteration")))
        if clouds:
            known = np.array(list(clouds))

            def cloud(k: int) -> Attributes:  # the nearest iteration with stored particles
                return _ab(_points(clouds[known[np.abs(known - k).argmin()]]))

            first = robot == self._data.robots[0]
            look = {"mode": "markers", "marker": {"size": 3, "color": ORANGE}, "opacity": 0.7}
            named = {"name": "particles", "legendgroup": "particles", "showlegend": first}
            meta = {"layer": "particles", "robot": robot}
            yield _Layer(
                _in_frame(**look, **named, meta=meta, hoverinfo="skip"), cloud, robot=robot
            )

    def _layers_of_pair(self, pair: Pair) -> Iterator[_Layer]:
        """Yield the fused map, the second robot's frame by each aligner, and the facts."""
        fused = self._of_pair["fused_history", pair]
        if fused:
            none = next(iter(fused.values())).iloc[:0]
            name = f"fused ({escaped(self.placements[pair][0][0])})"
            yield from self._landmarks(
                name, NEUTRAL, lambda k: fused.get(k, none), symbol="square-open", pair=pair
            )
        for placement in self.placements[pair]:
            meta = {"pair": list(pair), "placement": list(placement)}
            if placement[1] == "refined":
                style = self._styles[placement[0]]
                name = escaped(f"frame of {pair[1]} by {placement[0]}")
                mark = {"size": 11, "symbol": style["marker"], "color": style["hex"]}
                named = {"name": name, "meta": meta | {"layer": "frame"}}
                named |= {"carpet": self.carpet_of(pair, placement)}
                yield _Layer(
                    _in_frame(mode="markers", marker=mark, hoverinfo="text", **named)
                    | _ab(np.zeros((1, 2))),
                    lambda k, placement=placement: {
                        "hovertext": [self._answer_text(pair, placement, k)]
                    },
                    pair=pair,
                )
            text: Attributes = {"type": "scatter", "mode": "text", "x": [0.01], "y": [0.99]}
            text |= {"xaxis": "x2", "yaxis": "y2", "textposition": "bottom right"}
            text |= {"hoverinfo": "skip", "showlegend": False, "meta": meta | {"layer": "facts"}}
            yield _Layer(
                text,
                lambda k, placement=placement: {"text": [self._facts(pair, placement, k)]},
                pair=pair,
                placement=placement,
            )

    def _landmarks(
        self,
        name: str,
        colour: str,
        rows: Callable[[int], pd.DataFrame],
        *,
        symbol: str = "circle",
        robot: str = "",
        pair: Pair | None = None,
    ) -> Iterator[_Layer]:
        """Yield ellipses and points of a map, given its rows at an iteration."""
        carpet = None if pair is None else self.carpet_of(pair[0])
        meta = {"robot": robot} if pair is None else {"pair": list(pair)}
        ellipses = {"name": f"{LEVEL_TEXT} ellipses, {name}", "mode": "none", "hoverinfo": "skip"}
        ellipses |= {"fill": "toself", "fillcolor": faint(colour, 0.25), "line": SMOOTH}
        yield _Layer(
            _in_frame(**ellipses, carpet=carpet, meta=meta | {"layer": "ellipses"}),
            lambda k: _ab(ellipse_ends(rows(k))),
            robot=robot,
            pair=pair,
        )
        points = {"name": name, "mode": "markers"}
        points |= {"marker": {"size": 4, "color": colour, "symbol": symbol}}
        points["hovertemplate"] = f"{name}<br>landmark %{{pointNumber}}<extra></extra>"
        yield _Layer(
            _in_frame(**points, carpet=carpet, meta=meta | {"layer": "landmarks"}),
            lambda k: _ab(_points(rows(k))),
            robot=robot,
            pair=pair,
        )

    def _latest(self, robot: str, k: int) -> pd.DataFrame:
        """Return the robot's latest map at iteration k, by landmark; an empty map has no rows."""
        known = self._maps.get(robot, {})
        last = max((each for each in known if each <= k), default=None)
        return self._data.table("map_history").iloc[:0] if last is None else known[last]

    def _rows_of(self, table: str, robot: str) -> pd.DataFrame:
        rows = self._data.rows(table)
        return rows[rows["robot"] == robot].sort_values("iteration")

    def _answer_text(self, pair: Pair, placement: Placement, k: int) -> str:
        """Describe an aligner's answer at iteration k: error, status and reason."""
        answer = self._answers[pair].get((placement[0], k))
        what = escaped(", ".join(placement))
        if answer is None:
            return f"{what}: no answer"
        prefix = _STAGES[placement[1]]
        errors = [answer[f"{prefix}{n}"] for n in ("translation_error_m", "rotation_error_rad")]
        if self._data.no_truth:
            error = "no truth"
        elif np.isfinite(errors).all():
            error = f"error {metres(errors[0])}, {radians(abs(errors[1]))}"
        else:
            error = "no estimate"
        status = str(answer["refined_status"])
        status = "accepted" if answer["accepted"] else status.replace("accepted", "refused")
        names = ("refined_reason", "reason", "acceptance_reason")
        reasons = [escaped(str(answer[name])) for name in names if answer[name]]
        return "<br>".join([f"{what}: {error}, {status}", *reasons[:1]])

    def _facts(self, pair: Pair, placement: Placement, k: int) -> str:
        """Describe both maps at iteration k, and the answer that places the second one."""
        sizes = [f"{escaped(robot)}: {len(self._latest(robot, k))} landmarks" for robot in pair]
        fused, is_true = self._of_pair["fused_history", pair].get(k), self._is_true(pair, k)
        sizes += [] if fused is None else [f"fused: {len(fused)}"]
        if is_true is not None:
            sizes.append(f"true pairs: {int(is_true.sum())} of {len(is_true)}")
        lines = [", ".join(sizes)]
        if placement != TRUTH:
            lines.append(self._answer_text(pair, placement, k))
        if self._placed(pair, placement, k) is None:
            lines.append(f"{escaped(pair[1])} is not drawn")
        return "<br>".join(lines)


def ellipse_ends(rows: pd.DataFrame) -> Float:
    """Return the polygons of `ellipse_polygons` for rows of a table of landmarks."""
    covariance_m2 = rows[_COVARIANCE].to_numpy(dtype=np.float64).reshape(-1, 2, 2)
    return ellipse_polygons(_points(rows), covariance_m2)


def ellipse_polygons(position_m: Float, covariance_m2: Float) -> Float:
    """Return closed polygons of the ellipses of N landmarks with gaps, shape (6 N, 2)."""
    major, minor, direction = semi_axes(covariance_m2)
    ends = _ELLIPSE_ENDS * np.stack([major, minor], -1)[:, None]
    cos, sin = np.cos(direction)[:, None], np.sin(direction)[:, None]
    x, y = ends[..., 0], ends[..., 1]
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return (position_m[:, None] + turned).reshape(-1, 2)


def _points(rows: pd.DataFrame, prefix: str = "") -> Float:
    return rows[[f"{prefix}x_m", f"{prefix}y_m"]].to_numpy(dtype=np.float64)


def _xy(points: Float) -> Attributes:
    return {name: points[:, k].astype(np.float32) for k, name in enumerate("xy")}


def _ab(points: Float) -> Attributes:
    return {name: points[:, k].astype(np.float32) for k, name in enumerate("ab")}


def _in_frame(**attributes: Any) -> Attributes:
    """Return a trace in the coordinates of a carpet."""
    return {"type": "scattercarpet"} | attributes


def _line(name: str, lines: list[Float], **look: Any) -> Attributes:
    """Return a trace of lines (n, 2) in the world."""
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([_NO_POINTS, *(part for line in lines for part in (line, gap))])
    trace = {"type": "scatter", "mode": "lines", "hoverinfo": "skip", "name": name}
    return trace | _xy(points) | {"line": {"color": NEUTRAL, **look}}
