"""Two fusions of the same maps, given in different orders, compared up to the frame."""

import numpy as np
import pytest

from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry import se2
from mapfusion.geometry.se2 import transform_points


def clusters(fused, order):
    """Landmarks as sets of (robot, row of its map), with their rows in the fused map."""
    return {
        frozenset((order[k], int(row)) for k, row in enumerate(parents) if row != ABSENT): place
        for place, parents in enumerate(fused.parents)
    }


def by_robot(fused, order):
    """T_first_map of each robot, robots as in the world."""
    T = np.full((len(order), 3), np.nan)
    T[list(order)] = fused.T_first_map
    return T


def assert_same_map(one, two, order, within=1e-9):
    """The same robots, motions, landmarks and reasons, but for the frame."""
    assert_same_points(one, two, order, within)
    found, again = clusters(one, range(len(order))), clusters(two, order)
    rows = np.array([[found[key], again[key]] for key in found])
    root = by_robot(one, range(len(order)))[order[int(two.members[0])]]
    covariance = se2.transform_covariances(
        se2.inverse(root), one.landmarks.covariance_m2[rows[:, 0]]
    )
    np.testing.assert_allclose(
        two.landmarks.covariance_m2[rows[:, 1]], covariance, atol=1e-3 * within
    )
    assert two.duplicate_share == pytest.approx(one.duplicate_share)


def assert_same_points(one, two, order, within):
    """The same but for covariances, which some fusers tell as seen from the first map."""
    T_one, T_two = by_robot(one, range(len(order))), by_robot(two, order)
    members = np.flatnonzero(np.isfinite(T_one[:, 0]))
    np.testing.assert_array_equal(members, np.flatnonzero(np.isfinite(T_two[:, 0])))
    root = order[int(two.members[0])]
    np.testing.assert_array_equal(T_two[root], 0.0)
    np.testing.assert_allclose(
        se2.between(T_one[root], T_one[members]), T_two[members], atol=within
    )
    assert dict(one.left_out) == dict(two.left_out)
    found, again = clusters(one, range(len(order))), clusters(two, order)
    assert found.keys() == again.keys()
    rows = np.array([[found[key], again[key]] for key in found])
    position = transform_points(se2.inverse(T_one[root]), one.landmarks.position_m[rows[:, 0]])
    np.testing.assert_allclose(two.landmarks.position_m[rows[:, 1]], position, atol=within)
