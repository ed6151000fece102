"""Figures of maps: fused pairs of landmarks, chosen landmark and enlarged part."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from experiments.evaluation import tables
from experiments.reports.figures.drawing import draw_figure
from experiments.reports.figures.map_figures import choose_landmark, choose_zoom
from experiments.reports.figures.result_tables import (
    FusedPairs,
    NothingToDraw,
    ResultTables,
    positions_and_covariances,
)


@pytest.mark.parametrize("robot", ["R1", "R2", "R3"])
def test_maps_lie_where_the_merge_put_them(robot: str, trio_result: Path) -> None:
    """Landmarks that no other robot had lie in the fused map just as the merge moved them."""
    data = ResultTables(trio_result)
    position, covariance, own_covariance = data.moved_map(robot)
    fused = data.table("fused")
    carried = fused[(fused["n_parents"] == 1) & (fused["robot_a"] == robot)]
    rows = carried["landmark_a"].to_numpy()
    assert 10 < len(rows) < len(position)
    there, there_covariance = positions_and_covariances(carried)
    np.testing.assert_allclose(position[rows], there, atol=1e-9)
    np.testing.assert_allclose(covariance[rows], there_covariance, atol=1e-10)
    # the others were moved along: all distances are those of the robot's own map
    own, unmoved_covariance = data.landmarks_of(robot)
    np.testing.assert_allclose(pdist(position), pdist(own), atol=1e-9)
    # a turn changes no eigenvalue, and the drift was added in x and y, alike to all
    np.testing.assert_allclose(
        np.linalg.eigvalsh(own_covariance), np.linalg.eigvalsh(unmoved_covariance), rtol=1e-9
    )
    added = covariance - own_covariance
    drift = added[0, 0, 0] * np.diag([1.0, 1.0, 0.0])
    np.testing.assert_allclose(added, np.broadcast_to(drift, added.shape), atol=1e-10)


def test_parents_fuse_into_the_stored_landmark(trio_result: Path) -> None:
    pairs = ResultTables(trio_result).fused_pairs()
    assert {2, 3} == set(pairs.n_parents)
    two = pairs.n_parents == 2
    pairs = pairs._replace(
        position_m=pairs.position_m[:, two], covariance_m2=pairs.covariance_m2[:, two]
    )
    information = np.linalg.inv(pairs.covariance_m2)
    total = information[0] + information[1]
    np.testing.assert_allclose(total, information[2], rtol=1e-6)
    weighted = np.einsum("knij,knj->ni", information[:2], pairs.position_m[:2])
    fused = np.linalg.solve(total, weighted[:, :, None])[:, :, 0]
    np.testing.assert_allclose(fused, pairs.position_m[2], atol=1e-8)


def test_a_result_made_before_motions_were_stored_says_so(trio_copy: Path) -> None:
    tables.table_path(trio_copy, "fused_motions").unlink()
    with pytest.raises(NothingToDraw, match="made before fused motions were stored"):
        ResultTables(trio_copy).fused_pairs()


@pytest.mark.usefixtures("quick_save")
@pytest.mark.parametrize("name", ["fig08_fused_landmark", "fig09_aligned_maps"])
def test_landmarks_that_all_three_robots_knew_are_drawn_too(name: str, trio_copy: Path) -> None:
    path = tables.table_path(trio_copy, "fused")
    rows = tables.read(path, "fused")
    tables.write(path, "fused", rows[rows["n_parents"] != 2])
    drawn = draw_figure(ResultTables(trio_copy), name)
    assert drawn.skipped == []
    assert len(drawn.files) == 2


def test_ellipses_in_the_zoom_are_whole() -> None:
    """Around neighbours none of whose ellipses its rim cuts, and nobody else's where it can."""
    rng = np.random.default_rng(0)
    places = np.repeat([[0.0, 0.0, 1.0], [9.0, 3.0, 1.0], [9.0, -3.0, 1.0]], 6, axis=0)
    position = places + rng.normal(0, 0.2, (3, 18, 3))
    covariance = np.broadcast_to(np.diag([4e-2, 1e-3, 1e-3]), (3, 18, 3, 3)).copy()
    covariance[:, :6] *= 100  # the first six overlap with everything near them
    zoom = choose_zoom(position, covariance)
    assert zoom.n_cut == 0
    assert zoom.whole.sum() >= 5
    reach = np.sqrt(5.991464547107979 * covariance[:, :, [0, 1], [0, 1]])
    low, high = (
        (position[..., :2] - reach)[:, zoom.whole],
        (position[..., :2] + reach)[:, zoom.whole],
    )
    assert (low >= zoom.corner_m).all()
    assert (high <= zoom.corner_m + zoom.side_m).all()
    assert choose_zoom(position[:, :1], covariance[:, :1]).whole.tolist() == [True]


def one_pair(separation_m: float, sigma_a: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    position = np.array([[0.0, 0.0, 1.0], [separation_m, 0.0, 1.0], [separation_m / 2, 0.0, 1.0]])
    covariance = np.array([np.diag([*np.square(sigma_a), 1e-4]), np.diag([1e-2, 1e-2, 1e-4])] * 2)
    covariance[2] = np.diag([4e-3, 4e-3, 5e-5])
    return position, covariance[:3]


def test_legible_landmark_is_chosen() -> None:
    needle = one_pair(0.1, (0.5, 0.01))
    on_top = one_pair(0.0, (0.1, 0.1))
    clear = one_pair(0.12, (0.1, 0.08))
    far = one_pair(3.0, (0.1, 0.1))
    cases = [needle, on_top, clear, far]
    pairs = FusedPairs(
        ("R1", "R2"),
        np.stack([position for position, _ in cases], axis=1),
        np.stack([covariance for _, covariance in cases], axis=1),
        np.zeros((2, len(cases), 3, 3)),
        np.full(len(cases), 2),
    )
    assert choose_landmark(pairs) == 2
    # one of two parents comes before any of three, however clear
    assert choose_landmark(pairs._replace(n_parents=np.array([2, 2, 3, 2]))) != 2
    assert choose_landmark(pairs._replace(n_parents=np.full(4, 3))) == 2


def test_singular_covariances_are_not_chosen() -> None:
    flat = FusedPairs(
        ("R1", "R2"),
        np.zeros((3, 2, 3)),
        np.zeros((3, 2, 3, 3)),
        np.zeros((2, 2, 3, 3)),
        np.full(2, 2),
    )
    assert choose_landmark(flat) is None
