"""Simulated robots whose odometry is what their pictures tell: maps as sure as they say."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.stats import chi2

from experiments.evaluation.map_consistency import Consistency, fit_to_truth, relative_consistency
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from mapfusion.align.alignment import Alignment, Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.fusion.fusers import AlignedPair
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import merge
from mapfusion.geometry import se2
from tests.helpers.by_pictures import Mapped, mapped_by_pictures
from tests.helpers.tiny_scenario import TINY

SAME_M = 0.03  # true points that are one corner


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> list[Mapped]:
    root = tmp_path_factory.mktemp("pictures")
    (root / "tiny.yaml").write_text(TINY, encoding="utf-8")
    # of this camera a pixel is four usual ones, and a corner's tracks lie 5 mm apart and not 2
    settings = ["render.renderer=raycast", "smooth.stray_m=0.004"]
    scenario = load_scenario(root / "tiny.yaml", settings)
    assert isinstance(scenario, Simulation)
    return mapped_by_pictures(scenario, root)


def assert_as_sure_as_stated(nees_per_dof: float, coverage_95: float) -> None:
    """The band of long runs; of some fifty landmarks all may be covered."""
    assert 0.5 < nees_per_dof < 2.0
    assert 0.85 < coverage_95 <= 1.0


def consistency_of(each: Mapped) -> Consistency:
    assert len(each.landmarks) > 50
    return relative_consistency(each.landmarks, fit_to_truth(each.landmarks, each.point_m))


def test_smoothed_maps_are_as_sure_as_they_say(mapped: list[Mapped]) -> None:
    """The band is one of medians over robots: fifty landmarks are a small sample."""
    found = [consistency_of(each) for each in mapped]
    coverage = np.median([own.coverage_95 for own in found])
    assert_as_sure_as_stated(float(np.median([own.nees_per_dof for own in found])), float(coverage))
    assert max(own.nees_per_dof for own in found) < 2.0


def test_maps_fused_jointly_are_as_sure_as_they_say(mapped: list[Mapped]) -> None:
    a, b = mapped
    apart, nearest = KDTree(a.point_m).query(b.point_m)
    _, first = np.unique(nearest, return_index=True)  # one to one
    rows = first[apart[first] < SAME_M]
    pairs = Correspondences(nearest[rows], rows, np.zeros(len(rows)))
    T, certain = se2.between(a.start, b.start), np.ones(len(rows), dtype=bool)
    aligned = Alignment(T, np.eye(3) * 1e-4, certain, 0.0, Status.ACCEPTED, drift_sigma_m=0.01)
    fused = merge([a.landmarks, b.landmarks], [AlignedPair(0, 1, aligned, pairs)]).fused[0]
    assert fused.fallback == ""
    known = fused.parents != ABSENT
    world = np.where(known[:, :1], a.point_m[fused.parents[:, 0]], b.point_m[fused.parents[:, 1]])
    fit = fit_to_truth(fused.landmarks, se2.transform_points(se2.inverse(a.start), world))
    found = relative_consistency(fused.landmarks, fit)
    assert_as_sure_as_stated(found.nees_per_dof, found.coverage_95)
    off = fused.T_first_map[1] - T
    assert off @ np.linalg.solve(fused.motion_covariance[1], off) < chi2.ppf(0.999, 3)
