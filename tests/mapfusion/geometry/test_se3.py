"""Motions of space, against those of the plane and against SciPy."""

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.geometry import se2, se3


def test_motions_of_the_plane_are_those_of_space() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-3, 3, (2, 50, 3))
    upright = se3.from_planar(a), se3.from_planar(b)
    np.testing.assert_allclose(se3.planar(upright[0] @ upright[1]), se2.compose(a, b), atol=1e-12)
    np.testing.assert_allclose(se3.planar(se3.between(*upright)), se2.between(a, b), atol=1e-12)
    np.testing.assert_allclose(se3.planar(se3.inverse(upright[0])), se2.inverse(a), atol=1e-12)


def test_the_inverse_undoes_any_motion() -> None:
    rng = np.random.default_rng(1)
    T = se3.pose(Rotation.random(20, rng=rng).as_matrix(), rng.normal(size=(20, 3)))
    np.testing.assert_allclose(T @ se3.inverse(T), np.tile(np.eye(4), (20, 1, 1)), atol=1e-14)


def test_quaternions_are_scipys() -> None:
    rng = np.random.default_rng(2)
    turned, t = Rotation.random(20, rng=rng), rng.normal(size=(20, 3))
    T = se3.from_quaternions(t, turned.as_quat())
    np.testing.assert_allclose(T[:, :3, :3], turned.as_matrix(), atol=1e-15)
    again = se3.from_quaternions(t, se3.quaternions(T))
    np.testing.assert_allclose(again, T, atol=1e-14)
