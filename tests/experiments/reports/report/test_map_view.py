"""Tests of the map view: its figure holds the values of the tables."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from experiments.evaluation import tables
from experiments.reports.figures.result_tables import ResultTables, of_pair
from experiments.reports.report import map_view as module
from experiments.reports.report.charts import chart_style
from experiments.reports.report.map_view import ellipse_ends, map_figure
from mapfusion.geometry.se2 import compose, transform_points
from tests.helpers.report_page import numbers

Figure = dict[str, Any]


@pytest.fixture(scope="module")
def data(trio_result: Path) -> ResultTables:
    return ResultTables(trio_result)


@pytest.fixture(scope="module")
def figure(data: ResultTables) -> Figure:
    return figure_of(data)


def figure_of(data: ResultTables) -> Figure:
    styles = {name: chart_style(style) for name, style in data.styles.items()}
    found = map_figure(data, styles)
    assert found is not None
    return json.loads(str(found.to_json()))


def frame(figure: Figure, k: int) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the `meta` and the content of each trace at an iteration."""
    found = next(each for each in figure["frames"] if each["name"] == str(k))
    metas = [figure["data"][place].get("meta") or {} for place in found["traces"]]
    return list(zip(metas, found["data"], strict=True))


def layer(figure: Figure, k: int, **meta: Any) -> dict[str, Any]:
    """Return the one trace whose `meta` holds these values, at an iteration."""
    (found,) = [own for said, own in frame(figure, k) if said.items() >= meta.items()]
    return found


def points(trace: dict[str, Any], names: str = "ab") -> np.ndarray:
    return np.stack([numbers(trace[name]) for name in names], axis=-1)


def test_maps_are_those_of_the_table(data: ResultTables, figure: Figure) -> None:
    history = data.table("map_history")
    for robot in data.robots:
        rows = history[(history["robot"] == robot) & (history["iteration"] == 30)]
        shown = points(layer(figure, 30, layer="landmarks", robot=robot))
        np.testing.assert_allclose(shown, rows[["x_m", "y_m"]], atol=1e-5)


def test_fused_maps_are_those_of_the_table(data: ResultTables, figure: Figure) -> None:
    for pair in data.pairs:
        rows = of_pair(data.table("fused_history"), pair)
        last = rows[rows["iteration"] == data.last_iteration(pair)]
        k = data.last_iteration(pair)
        shown = points(layer(figure, k, layer="landmarks", pair=list(pair)))
        np.testing.assert_allclose(shown, last[["x_m", "y_m"]], atol=1e-5)


def test_lines_join_the_true_pairs_in_the_world(data: ResultTables, figure: Figure) -> None:
    history, errors = data.table("map_history"), data.table("errors")
    for pair in data.pairs:
        known = of_pair(errors, pair).groupby("iteration")["n_true"].first()
        offered = of_pair(data.table("correspondences"), pair).groupby("iteration").size()
        start, truth = data.start_pose(pair[0]), data.true_alignment(pair)
        assert start is not None
        assert truth is not None
        for k in (30, data.last_iteration(pair)):
            of = {"pair": list(pair), "placement": ["the truth", ""]}
            true, false = (
                points(layer(figure, k, layer=kind, **of), "xy").reshape(-1, 3, 2)
                for kind in ("true", "false")
            )
            assert len(true) == known[k]
            assert len(true) + len(false) == offered[k]
            assert np.isnan(true[:, 2]).all()
            for end, robot, placed in ((0, pair[0], start), (1, pair[1], compose(start, truth))):
                rows = history[(history["robot"] == robot) & (history["iteration"] == k)]
                plan = transform_points(placed, rows[["x_m", "y_m"]].to_numpy())
                apart = np.linalg.norm(plan[:, None] - true[None, :, end], axis=-1)
                assert apart.min(axis=0).max(initial=0.0) < 1e-4
            if len(true):  # the truth lays true pairs onto each other, but for the maps' errors
                lengths = [
                    np.linalg.norm(each[:, 0] - each[:, 1], axis=1) for each in (true, false)
                ]
                assert np.median(lengths[0]) < 0.3 < np.median(lengths[1])


def test_a_carpet_lays_the_second_map_where_the_aligner_does(
    data: ResultTables, figure: Figure
) -> None:
    """Plotly interpolates a carpet linearly: its corners are the images of the frame's."""
    pair, k = data.pairs[0], data.last_iteration(data.pairs[0])
    rows = of_pair(data.table("estimates"), pair)
    rows = rows[(rows["iteration"] == k) & (rows["repetition"] == 0)].set_index("aligner")
    start = data.start_pose(pair[0])
    assert start is not None
    for stage, prefix in (("as estimated", ""), ("refined", "refined_")):
        motion = rows.loc["ransac", [f"{prefix}{name}" for name in ("tx_m", "ty_m", "theta_rad")]]
        of = {"layer": "alignment", "pair": list(pair), "placement": ["ransac", stage]}
        shown = layer(figure, k, **of)
        corners = np.stack([numbers(shown["x"]), numbers(shown["y"])], axis=-1)  # (b, a, xy)
        (carpet,) = [each for each in figure["data"] if (each.get("meta") or {}) == of]
        low, high = numbers(carpet["a"])
        expected = transform_points(
            compose(start, motion.to_numpy(dtype=float)),
            np.array([[low, low], [high, low], [low, high], [high, high]]),
        )
        np.testing.assert_allclose(corners.reshape(-1, 2), expected, atol=1e-9)


def test_an_alignment_without_estimate_draws_no_second_map(trio_copy: Path) -> None:
    path = tables.table_path(trio_copy, "estimates")
    rows = tables.read(path, "estimates")
    rows.loc[rows["aligner"] == "icp", "refined_tx_m"] = np.nan
    tables.write(path, "estimates", rows)
    shown = figure_of(ResultTables(trio_copy))
    visible = {
        tuple(meta["placement"]): own["visible"]
        for meta, own in frame(shown, 30)
        if meta.get("layer") == "alignment"
    }
    assert not visible["icp", "refined"]
    assert visible["icp", "as estimated"]
    assert visible["ransac", "refined"]


def test_ellipses_lie_on_the_bound(data: ResultTables) -> None:
    """Each end of an axis has the squared Mahalanobis distance of 95 %, and both axes are there."""
    rows = data.table("map_history").iloc[::7]
    ends = ellipse_ends(rows).reshape(len(rows), 6, 2)
    assert np.isnan(ends[:, 5]).all()
    np.testing.assert_array_equal(ends[:, 0], ends[:, 4])
    away = ends[:, :4] - rows[["x_m", "y_m"]].to_numpy()[:, None]
    covariance = rows[["cov_xx_m2", "cov_xy_m2", "cov_xy_m2", "cov_yy_m2"]].to_numpy()
    inverse = np.linalg.inv(covariance.reshape(-1, 2, 2))
    distance = np.einsum("nki,nij,nkj->nk", away, inverse, away)
    np.testing.assert_allclose(distance, chi2.ppf(0.95, 2), rtol=1e-3)  # of single precision
    between = np.einsum("ni,nij,nj->n", away[:, 0], inverse, away[:, 1])
    np.testing.assert_allclose(between, 0, atol=1e-2)  # conjugate directions


def test_marks_tell_error_and_status(data: ResultTables, figure: Figure) -> None:
    pair, k = data.pairs[0], data.last_iteration(data.pairs[0])
    rows = of_pair(data.table("errors"), pair)
    rows = rows[(rows["iteration"] == k) & (rows["repetition"] == 0)].set_index("aligner")
    of = {"pair": list(pair), "placement": ["ransac", "refined"]}
    (text,) = layer(figure, k, layer="frame", **of)["hovertext"]
    (facts,) = layer(figure, k, layer="facts", **of)["text"]
    error = rows.loc["ransac", "refined_translation_error_m"]
    assert f"error {error:.2g}"[:9] in text
    assert "accepted" in text
    assert text in facts
    assert f"true pairs: {rows.loc['ransac', 'n_true']} of" in facts


def test_the_menu_shows_one_pair_and_its_carpets(data: ResultTables, figure: Figure) -> None:
    menu = figure["layout"]["updatemenus"][0]["buttons"]
    labels = [each["label"] for each in menu]
    assert labels[0] == "R1 – R2: placed by ransac, refined"  # that maps are fused by
    assert len(labels) == len(data.pairs) * (2 * (len(data.aligners) - 1) + 1)
    (choice,) = [each for each in menu if each["label"] == "R1 – R3: placed by icp, as estimated"]
    shown, traces = choice["args"]
    carpets = {
        each["carpet"]: each.get("meta") for each in figure["data"] if each["type"] == "carpet"
    }
    for place, visible, carpet in zip(traces, shown["visible"], shown["carpet"], strict=True):
        meta = figure["data"][place].get("meta") or {}
        assert figure["data"][place]["type"] != "carpet"
        if "robot" in meta:
            assert (visible is not False) == (meta["robot"] in {"R1", "R3"})
        if "pair" in meta:
            assert not visible or meta["pair"] == ["R1", "R3"]
        if meta.get("layer") == "landmarks" and meta.get("robot") == "R3":
            placed = {"layer": "alignment", "pair": ["R1", "R3"]}
            assert carpets[carpet] == placed | {"placement": ["icp", "as estimated"]}


def test_too_many_iterations_are_thinned_and_the_last_stays(
    data: ResultTables, figure: Figure, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = len(json.dumps(figure["frames"]))
    monkeypatch.setattr(module, "MAX_BYTES", size // 8)
    thinned = figure_of(data)
    n_left_out = len(figure["frames"]) - len(thinned["frames"])
    assert thinned["layout"]["meta"]["n_left_out"] == n_left_out > 0
    assert thinned["frames"][-1]["name"] == figure["frames"][-1]["name"]
    steps = [step["label"] for step in thinned["layout"]["sliders"][0]["steps"]]
    assert steps == [each["name"] for each in thinned["frames"]]


def test_without_histories_there_is_no_map(trio_copy: Path) -> None:
    tables.table_path(trio_copy, "map_history").unlink()
    data = ResultTables(trio_copy)
    assert map_figure(data, {name: chart_style(s) for name, s in data.styles.items()}) is None
