"""How a path bends where loops close, against dense algebra on the bend of every frame."""

import numpy as np
import pytest

from mapfusion.fastslam.loop_closing import SPACING, Bends
from mapfusion.geometry.numerics import Float

SURE = 1 - 1e-12  # every closure is believed
FAR = np.array([1e3, 1e3])  # where the least turn moves a robot by a millimetre


def spread_matrix(rng: np.random.Generator, size: float) -> Float:
    root = size * rng.standard_normal((3, 3))
    return root @ root.T


class AnyFrames:
    """The same Gaussian, dense, over the bends at these frames, which ascend."""

    def __init__(self, steps: Float, frames: np.ndarray) -> None:
        walk, n = np.cumsum(steps, axis=0)[frames], len(frames)
        earlier = np.minimum(*np.indices((n, n)))
        self.covariance = walk[earlier].transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
        self.frames, self.mean = frames, np.zeros(3 * n)

    def closed(self, now: int, then: int, motion: Float, noise: Float) -> None:
        """Bend now less bend then was observed to be a motion."""
        slope = np.zeros((len(self.frames), 3, 3))
        slope[self.frames == now], slope[self.frames == then] = np.eye(3), -np.eye(3)
        slope = slope.transpose(1, 0, 2).reshape(3, -1)
        gain = self.covariance @ slope.T @ np.linalg.inv(slope @ self.covariance @ slope.T + noise)
        self.mean = self.mean + gain @ (motion - slope @ self.mean)
        self.covariance = self.covariance - gain @ slope @ self.covariance


@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.parametrize("n_spacings", [7, 70])  # the latter more than there are knots
def test_loops_one_inside_the_other_bend_the_path_as_dense_algebra_has_it(n_spacings, taken):
    rng = np.random.default_rng(n_spacings)
    n = n_spacings * SPACING
    steps = np.array([spread_matrix(rng, 1e-2) for _ in range(n)])
    steps[0] = 0  # before the first frame there is no path
    knots = np.arange(4 * SPACING, n - SPACING, 4 * SPACING)  # of those that are kept to the end
    loops = {4 * SPACING + 3: 0, 6 * SPACING + 7: 2 * SPACING, n - 1: 4 * SPACING}
    frames = np.unique([0, 2 * SPACING, *knots, *loops])
    bends, dense, total = Bends(), AnyFrames(steps, frames), np.zeros((n, 3))
    for frame, step in enumerate(steps):
        bends.went_on(step)
        if frame not in loops:
            continue
        then, motion = loops[frame], rng.normal(0, 0.05, 3)
        noise, now = spread_matrix(rng, 0.02), spread_matrix(rng, 0.01)
        dense.closed(frame, then, motion, noise + now)
        # the map shows no more what it was bent by before
        seen = motion - total[frame] + total[then]
        information = np.linalg.inv(noise)
        bends.closed(np.array([then]), information[None], (information @ seen)[None], now, SURE)
        if taken or frame == n - 1:
            found = bends.due(FAR)
            assert found is not None
            total[: frame + 1] += bends.at(found, np.arange(frame + 1))
            total[frame + 1 :] = total[frame]
    checked = frames[(frames >= 4 * SPACING) & np.isin(frames, [*knots, n - 1])]
    expected = dense.mean.reshape(-1, 3)[np.isin(frames, checked)]
    np.testing.assert_allclose(total[checked], expected, atol=1e-9)
    assert np.abs(total[n - 1]).max() > 1e-3


def test_between_two_knots_a_bend_grows_evenly():
    bends = Bends()
    for _ in range(3 * SPACING):
        bends.went_on(1e-4 * np.eye(3))
    given = np.array([[0, 0, 0], [0, 0, 0], [0.4, 0, 0.2], [0.4, 0, 0.2]])
    frame = np.array([SPACING, SPACING + SPACING // 2, 2 * SPACING])
    expected = [[0, 0, 0], [0.2, 0, 0.1], [0.4, 0, 0.2]]
    np.testing.assert_allclose(bends.at(given, frame), expected, atol=1e-12)


def test_one_landmark_says_nothing_of_the_turn_about_it():
    """Seen off by 0.1 m in x at (2, 3), where the path may have turned about the origin alone."""
    bends = Bends()
    for _ in range(2 * SPACING):
        bends.went_on(np.diag([0, 0, 1e-3]))
    slope = np.array([[1.0, 0, -3], [0, 1, 2]])
    information = 1e4 * slope.T @ slope
    pull = 1e4 * slope.T @ [0.1, 0.0]
    bends.closed(np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE)
    # a turn t is seen as (-3 t, 2 t): least squares with its prior
    turn = 1e4 * -0.3 / (1e4 * 13 + 1 / (2 * SPACING * 1e-3))
    found = bends.due(np.zeros(2) + 10)
    assert found is not None
    np.testing.assert_allclose(found[-1], [0, 0, turn], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("sigmas", "believed"), [(3.9, True), (5.0, False)])
def test_a_closure_that_no_drift_explains_is_not_believed(sigmas, believed):
    """The 0.9999 quantile of chi-square with 3 degrees of freedom is 21.1, 4.6 squared."""
    bends, sigma_m = Bends(), 0.03
    for _ in range(2 * SPACING):
        bends.went_on(sigma_m**2 / (4 * SPACING) * np.eye(3))
    information = 2 / sigma_m**2 * np.eye(3)  # half of the variance each
    pull = information @ [sigmas * sigma_m, 0, 0]
    bends.closed(np.array([0]), information[None], pull[None], np.zeros((3, 3)), 0.9999)
    assert (bends.due(np.zeros(2)) is not None) == believed


def test_bends_of_less_than_a_millimetre_are_put_off():
    bends = Bends()
    for _ in range(2 * SPACING):
        bends.went_on(1e-2 * np.eye(3))

    def seen(shift_m: float) -> None:
        information = 1e6 * np.eye(3)
        pull = information @ [shift_m, 0.0, 0.0]
        bends.closed(np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE)

    seen(6e-4)
    assert bends.due(np.zeros(2)) is None
    seen(2e-3)  # of the map as it is, so the mean of both
    found = bends.due(np.zeros(2))
    assert found is not None
    assert found[-1, 0] == pytest.approx(1.3e-3, rel=1e-4)
    assert bends.due(np.zeros(2)) is None


@pytest.mark.parametrize(("sigmas", "believed"), [(4.1, True), (4.45, False)])
def test_the_gate_counts_the_directions_that_are_seen(sigmas, believed):
    """The 0.9999 quantile of chi-square with 2 degrees of freedom is 18.4, 4.29 squared."""
    bends, sigma_m = Bends(), 0.03
    for _ in range(2 * SPACING):
        bends.went_on(sigma_m**2 / (4 * SPACING) * np.diag([1, 1, 0]))
    information = 2 / sigma_m**2 * np.diag([1.0, 1.0, 0.0])  # half of the variance each
    pull = information @ [sigmas * sigma_m, 0, 0]
    bends.closed(np.array([0]), information[None], pull[None], np.zeros((3, 3)), 0.9999)
    assert (bends.due(np.zeros(2)) is not None) == believed


def test_a_bend_is_due_where_it_moves_the_robot():
    """A turn of the plane about (2, 3) does not move a robot there; it moves one at (-2, -3)."""
    bends, about = Bends(), np.array([2.0, 3.0])
    for _ in range(2 * SPACING):
        bends.went_on(1e2 * np.eye(3))
    information = 1e6 * np.eye(3)
    pull = information @ (0.01 * np.array([about[1], -about[0], 1.0]))
    bends.closed(np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE)
    assert bends.due(about) is None
    assert bends.due(-about) is not None
