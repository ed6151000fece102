"""What the page unpacks is what the tables hold."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.evaluation.tables import table_path
from experiments.reports.figures.floor_plan import semi_axes
from experiments.reports.figures.result_tables import ResultTables, of_pair
from experiments.reports.report import map_view as module
from experiments.reports.report.map_view import (
    ELLIPSE_MAX_M,
    ELLIPSE_MIN_M,
    map_view,
    packed_ellipses,
)


@pytest.fixture(scope="module")
def data(trio_result: Path) -> ResultTables:
    return ResultTables(trio_result)


@pytest.fixture(scope="module")
def view(data: ResultTables) -> dict[str, Any]:
    return view_of(data)


def view_of(data: ResultTables) -> dict[str, Any]:
    found = map_view(data)
    assert found is not None
    return found


def unpacked(view: dict[str, Any], at: list[int], kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(view["block"]), kind, count=at[1], offset=at[0])


def test_maps_come_back_to_a_millimetre(data: ResultTables, view: dict[str, Any]) -> None:
    history = data.table("map_history")
    for robot, packed in view["robots"].items():
        rows = history[(history["robot"] == robot) & (history["iteration"] == 30)]
        own = packed["maps"][[f["iteration"] for f in view["pairs"][0]["frames"]].index(30)]
        steps = unpacked(view, own["at"], "<i2").reshape(-1, 2)
        assert packed["step_m"] == 0.001
        np.testing.assert_allclose(steps * packed["step_m"], rows[["x_m", "y_m"]], atol=6e-4)


def test_true_pairs_are_those_of_the_errors(data: ResultTables, view: dict[str, Any]) -> None:
    errors = data.table("errors")
    for pair in view["pairs"]:
        known = of_pair(errors, tuple(pair["robots"])).groupby("iteration")["n_true"].first()
        offered = of_pair(data.table("correspondences"), tuple(pair["robots"]))
        for frame in pair["frames"]:
            assert unpacked(view, frame["true"], "u1").sum() == frame["n_true"]
            assert frame["n_true"] == known[frame["iteration"]]
            rows = offered[offered["iteration"] == frame["iteration"]]
            index = unpacked(view, frame["pairs"], "<u2").reshape(-1, 2)
            np.testing.assert_array_equal(index, rows[["index_a", "index_b"]])


def test_ellipses_keep_their_shape_to_a_few_percent() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(scale=0.1, size=(200, 2, 2))
    covariance = root @ root.swapaxes(1, 2) + 1e-6 * np.eye(2)
    packed = packed_ellipses(covariance).astype(float)
    axes = ELLIPSE_MIN_M * (ELLIPSE_MAX_M / ELLIPSE_MIN_M) ** (packed[:, :2] / 255)
    major, minor, direction = semi_axes(covariance)
    np.testing.assert_allclose(axes, np.stack([major, minor], -1), rtol=0.025)
    off = np.abs(packed[:, 2] / 256 * np.pi - direction)
    assert (np.minimum(off % np.pi, np.pi - off % np.pi) < 0.0063).all()


def test_too_many_iterations_are_thinned_and_the_last_stays(
    data: ResultTables, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = view_of(data)
    monkeypatch.setattr(module, "MAX_BYTES", len(whole["block"]) // 3)
    thinned = view_of(data)
    frames = thinned["pairs"][0]["frames"]
    assert thinned["left_out"] == len(whole["pairs"][0]["frames"]) - len(frames) > 0
    assert frames[-1]["iteration"] == whole["pairs"][0]["frames"][-1]["iteration"]
    assert len(thinned["block"]) < len(whole["block"])


def test_without_histories_there_is_no_map(trio_copy: Path) -> None:
    table_path(trio_copy, "map_history").unlink()
    assert map_view(ResultTables(trio_copy)) is None
