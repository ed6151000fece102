"""Robots that would wait for each other for ever get through, by one of them waiting earlier."""

import math
from typing import cast
from unittest.mock import patch

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mapfusion.errors import InputError
from sim.driver import DriverSettings, _Driver, _others, drive
from sim.floorplan import FloorPlan, Wall
from sim.p3at import OUTER_RADIUS_M, P3at
from sim.routes import (
    ActiveHold,
    DriveRecord,
    Hold,
    Passage,
    Progress,
    Route,
    find_deadlock,
    resolve_deadlock,
)
from sim.trajectory import Trajectory
from tests.helpers.wheels_alone import wheels_alone

HALL = FloorPlan((Wall(np.array([[0, 0], [9, 0], [9, 8], [0, 8], [0, 0]])),))
UP, DOWN = math.pi / 2, -math.pi / 2


def joining(first: str = "south", y_north_m: float = 5.28) -> list[Route]:
    """Two robots that come to one place from opposite sides and both go on to the east."""
    ways = {
        "south": Route("south", np.array([1, 2.58, UP]), np.array([[1, 4], [7, 4], [7, 2]])),
        "north": Route("north", np.array([1, y_north_m, DOWN]), np.array([[1, 4], [7, 4], [7, 6]])),
    }
    return [ways[first], *(way for name, way in ways.items() if name != first)]


def driven(routes: list[Route], n_frames: int = 300) -> Trajectory:
    with wheels_alone():
        return drive(HALL, routes, DriverSettings(patience_s=10), n_frames, 0.2)


def arrived(trajectory: Trajectory, routes: list[Route]) -> list[bool]:
    ends = np.stack([route.waypoints_m[-1] for route in routes])
    off = trajectory.T_world_robot[:, -1, :2] - ends
    return (np.linalg.norm(off, axis=1) < 0.3).tolist()


@pytest.mark.parametrize("first", ["south", "north"])
def test_two_that_come_head_on_get_through(first: str) -> None:
    routes = joining(first)
    never = patch("sim.driver.resolve_deadlock", return_value=None)
    with never, pytest.raises(InputError, match="waits"):
        driven(routes)
    both = driven(routes)
    assert arrived(both, routes) == [True, True]
    alone = driven(routes[:1])
    # the first listed has the right of way: it drives as if it were alone
    np.testing.assert_array_equal(both.T_world_robot[0], alone.T_world_robot[0])
    apart_m = np.linalg.norm(np.diff(both.T_world_robot[:, :, :2], axis=0)[0], axis=1)
    assert apart_m.min() > 2 * OUTER_RADIUS_M


def test_a_robot_that_holds_lets_the_others_by() -> None:
    """The other robots do not give way to a holding robot, although it is listed first."""
    here, there = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    hold = Hold(0, Progress(0, -9.0), (Passage(1, Progress(0, -1.0), (0.0, 0.0)),))
    drivers = [
        _Driver(route, cast(P3at, None), DriverSettings(), holds)
        for route, holds in zip(joining(), ([hold], []), strict=True)
    ]
    came = [driver.progress(here) for driver in drivers]
    drivers[0].hold(came, [here, there], 1.0)
    (seen,) = _others(1, [here, there], [False, False], drivers)
    assert (seen.goes_first, seen.yields) == (True, True)


def test_a_circle_of_three_is_found() -> None:
    assert find_deadlock({0: [1], 1: [2], 2: [0]}) == (0, 1, 2)
    assert find_deadlock({0: [1], 1: [2]}) == ()
    assert find_deadlock({3: [0, 1], 0: [2], 1: [3]}) == (1, 3)


def test_circles_are_those_of_strongly_connected_robots() -> None:
    rng, n_found = np.random.default_rng(0), 0
    for _ in range(300):
        n = int(rng.integers(2, 8))
        waits = rng.random((n, n)) < rng.uniform(0, 2 / n)
        np.fill_diagonal(waits, False)
        _, component = connected_components(csr_array(waits), directed=True, connection="strong")
        tangled = np.bincount(component)[component] > 1
        circle = list(
            find_deadlock({i: np.flatnonzero(row).tolist() for i, row in enumerate(waits)})
        )
        assert bool(circle) == tangled.any()
        n_found += bool(circle)
        assert circle == sorted(set(circle))
        assert len(set(component[circle].tolist())) == bool(circle)
        assert waits[np.ix_(circle, circle)].any(axis=1).all()
    assert 50 < n_found < 250


def straight(*x_m: float, y_m: float = 0.0) -> DriveRecord:
    """A robot on its way along x to a waypoint at x = 10."""
    own = DriveRecord()
    for x in x_m:
        own.add((x, y_m, 0.0), Progress(0, x - 10), stopping_m=0.1)
    return own


def test_the_place_is_the_last_one_clear_of_the_other_s_way() -> None:
    """The other goes along y at x = 5: 1.25 m and the way to stop are kept from there."""
    mine, other = straight(*np.arange(0, 4.3, 0.1)), straight(5.0, y_m=-1.0)
    ahead = [np.array([[10.0, 0.0]]), np.array([[5.0, 6.0]])]
    hold = resolve_deadlock((0, 1), [other, mine], ahead[::-1], 1.25)
    assert hold is not None
    assert (hold.robot, hold.at.visited) == (1, 0)
    assert hold.at.minus_left_m == pytest.approx(3.6 - 10)
    (passage,) = hold.passages
    assert passage[:2] == (0, Progress(0, -5.0))
    assert passage.from_m == pytest.approx((4.2, 0.0))
    again = resolve_deadlock((0, 1), [other, mine], ahead[::-1], 1.25, [hold])
    assert again is not None
    assert again.at.minus_left_m == pytest.approx(3.3 - 10)


def test_the_one_listed_before_holds_where_the_last_has_no_place() -> None:
    mine, other = straight(*np.arange(0, 4.3, 0.1)), straight(5.0, y_m=-0.5)
    ahead = [np.array([[10.0, 0.0]]), np.array([[5.0, 6.0]])]
    hold = resolve_deadlock((0, 1), [mine, other], ahead, 1.25)
    assert hold is not None
    assert hold.robot == 0
    assert [passage.robot for passage in hold.passages] == [1]


def test_nobody_holds_where_all_stand_on_the_others_ways() -> None:
    towards = DriveRecord()
    for x in (7.0, 6.0, 5.0):
        towards.add((x, 0.0, math.pi), Progress(0, -x), 0.0)
    ahead = [np.array([[10.0, 0.0]]), np.array([[0.0, 0.0]])]
    assert resolve_deadlock((0, 1), [straight(2.0, 3.0, 4.0), towards], ahead, 1.2) is None


def test_a_hold_begins_at_its_place_and_ends_once_the_other_is_past() -> None:
    holding = ActiveHold(Hold(1, Progress(2, -3.0), (Passage(0, Progress(5, -1.0), (4.0, 0.0)),)))

    def waits(own: Progress, other: Progress, x_m: float) -> set[int]:
        return holding.waits_for([other, own], [(x_m, 0.0, 0.0), (0.0, 0.0, 0.0)], 1.0)

    early, there = Progress(2, -3.1), Progress(2, -3.0)
    assert waits(early, Progress(4, -0.5), 9.0) == set()
    assert waits(there, Progress(4, -0.5), 9.0) == {0}
    assert waits(early, Progress(4, -0.5), 9.0) == {0}  # it trembles, and holds all the same
    assert waits(there, Progress(5, -0.9), 4.5) == {0}  # far enough, but still there
    assert waits(there, Progress(5, -0.8), 5.1) == set()
    assert waits(there, Progress(5, -0.8), 4.5) == set()  # on its next round
