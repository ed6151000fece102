"""Tests of `sim.driver`."""

import hashlib
import math
import subprocess
import sys
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from mapfusion.errors import InputError
from mapfusion.geometry import se2
from sim import driver
from sim.driver import NEAR_M, WITHIN_REACH_M, DriverSettings, SolidWalls, _Driver, _Other, drive
from sim.floorplan import FloorPlan, Wall, segment_distance_m
from sim.odometry import calibrated_track_m, encoder_increments
from sim.p3at import OUTER_RADIUS_M, WIDTH_M, P3at
from sim.routes import Route, check_routes
from sim.trajectory import Trajectory
from sim.world import World

HALL = FloorPlan(
    (
        Wall(np.array([[0, 0], [8, 0], [8, 6], [0, 6], [0, 0]])),
        Wall(np.array([[4, 0], [4, 2]])),
    )
)


def route(name: str, start: list[float], *waypoints: tuple[float, float], loop: bool = False):
    return Route(name, np.array(start), np.array(waypoints), loop)


def drive_two() -> Trajectory:
    """Robot a goes around the stub of a wall and stops, b cycles between two places."""
    routes = [
        route("a", [1, 1, 0.5], (1, 3), (6, 3), (6, 1)),
        route("b", [6, 5, 3], (2, 5), (6, 5), loop=True),
    ]
    return drive(HALL, routes, DriverSettings(), 250, 0.2)


@pytest.fixture(scope="module")
def driven() -> Trajectory:
    return drive_two()


def nearest_m(trajectory: Trajectory, robot: int, point: tuple[float, float]) -> np.ndarray:
    return np.hypot(*(trajectory.T_world_robot[robot, :, :2] - point).T)


def test_waypoints_are_visited_in_order(driven: Trajectory) -> None:
    reached = [
        int(np.argmax(nearest_m(driven, 0, point) < DriverSettings().arrival_m + 0.05))
        for point in ((1, 3), (6, 3), (6, 1))
    ]
    assert 0 < reached[0] < reached[1] < reached[2]


def test_it_starts_where_told_and_its_encoders_at_zero(driven: Trajectory) -> None:
    np.testing.assert_allclose(driven.T_world_robot[0, 0], [1, 1, 0.5], atol=2e-3)
    np.testing.assert_array_equal(driven.wheel_rad[:, 0], 0)
    np.testing.assert_allclose(driven.time_s, 0.2 * np.arange(250))


def test_at_the_end_of_its_route_it_stands_still(driven: Trajectory) -> None:
    rest = driven.T_world_robot[0, -10:, :2]
    assert np.ptp(rest, axis=0).max() < 1e-3
    assert nearest_m(driven, 0, (6, 1))[-1] < 0.25


def test_a_loop_begins_again(driven: Trajectory) -> None:
    there = nearest_m(driven, 1, (2, 5)) < 0.5
    arrivals = np.flatnonzero(np.diff(there.astype(int)) == 1)
    assert len(arrivals) == 2


def test_it_does_not_slide_sideways_in_a_turn(driven: Trajectory) -> None:
    steps = se2.between(driven.T_world_robot[:, :-1], driven.T_world_robot[:, 1:])
    turning = np.abs(steps[..., 2]) > 0.05
    assert turning.sum() > 20
    assert np.abs(steps[..., 1][turning]).max() < 4e-3  # it was 15e-3 when it turned while rolling


def test_speeds_are_respected(driven: Trajectory) -> None:
    steps = np.diff(driven.T_world_robot, axis=1)
    assert np.hypot(steps[..., 0], steps[..., 1]).max() < 0.5 * 0.2 * 1.02
    turns = np.abs(np.diff(np.unwrap(driven.T_world_robot[..., 2]), axis=1))
    # the track follows the heading by a fifth, and with it the turn rate
    assert 0.5 * 0.2 < turns.max() < 0.6 * 0.2 * 1.45


def test_encoders_tell_the_distance(driven: Trajectory) -> None:
    for i in range(2):
        increments = encoder_increments(driven.wheel_rad[i], calibrated_track_m())
        path = np.hypot(*np.diff(driven.T_world_robot[i, :, :2], axis=0).T).sum()
        assert np.hypot(*increments[:, :2].T).sum() == pytest.approx(path, rel=0.01)


def test_poses_and_encoders_are_of_the_same_moment(driven: Trajectory) -> None:
    """Speeding up and braking, a frame goes 0.02 m farther or less far than the one before."""
    for i in range(2):
        increments = encoder_increments(driven.wheel_rad[i], calibrated_track_m())
        steps = np.hypot(*np.diff(driven.T_world_robot[i, :, :2], axis=0).T)
        counted = np.hypot(*increments[1:, :2].T)
        straight = np.abs(increments[1:, 2]) < 0.005
        changing = straight[:-1] & (np.abs(np.diff(counted)) > 0.015)
        assert changing.sum() > 10
        assert np.abs(steps - counted)[straight].max() < 0.006


def test_neither_comes_near_a_wall(driven: Trajectory) -> None:
    assert HALL.clearance_m(driven.T_world_robot[..., :2].reshape(-1, 2)).min() > OUTER_RADIUS_M


def digest(trajectory: Trajectory) -> str:
    bits = trajectory.T_world_robot.tobytes() + trajectory.wheel_rad.tobytes()
    return hashlib.sha256(bits).hexdigest()


def test_the_same_bits_in_another_process(driven: Trajectory) -> None:
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_driver as t\n"
        "print(t.digest(t.drive_two()))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    assert result.stdout.strip() == digest(driven)


@pytest.mark.parametrize(
    ("routes", "message"),
    [
        ([route("a", [1, 1, 0], (4, 1))], r"robot a: waypoint 1 \(4.00, 1.00\) lies inside a wall"),
        ([route("a", [4, 1, 0], (1, 1))], r"robot a: start \(4.00, 1.00\) lies inside a wall"),
        ([route("a", [1, 1, 0], (1, 7))], r"waypoint 1 \(1.00, 7.00\) lies outside the world"),
        ([route("a", [1, 1, 0], (1, 0.3))], r"waypoint 1 \(1.00, 0.30\) is 0.25 m from a wall"),
        (
            [route("a", [1, 1, 0], (1, 3), (7, 0.5))],
            r"robot a: the way from waypoint 1 \(1.00, 3.00\) to waypoint 2 \(7.00, 0.50\) "
            "leads through a wall",
        ),
        ([route("a", [3.4, 1, 0], (4.6, 3.4))], r"passes a wall at 0.\d+ m, the robot needs 0.25"),
        (
            [route("a", [3.4, 1, 0], (4.6, 4.3))],
            r"passes a wall at 0.17 m, the robot needs 0.25 m",
        ),
        (
            [route(n, [x, 1, 0], (x, 3)) for n, x in (("a", 1.0), ("b", 6.0), ("c", 1.5))],
            "robots a and c: they start 0.50 m apart",
        ),
        (
            [route("a", [1, 1, 0], (1, 3)), route("a", [6, 1, 0], (6, 3))],
            "robot a: two robots have this name",
        ),
        (
            [route("a", [1, 1, 0], (1, 3)), route("b", [1.5, 1, 0], (2, 3))],
            "robots a and b: they start 0.50 m apart",
        ),
    ],
)
def test_impossible_routes_are_refused(routes: list[Route], message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_routes(HALL, routes)


def test_the_way_back_of_a_loop_is_checked_too() -> None:
    around = [(1, 3), (6, 3), (6, 1)]
    check_routes(HALL, [route("a", [1, 1, 0], *around)])
    with pytest.raises(InputError, match=r"from waypoint 4 .* to waypoint 1 .* through a wall"):
        check_routes(HALL, [route("a", [1, 1, 0], (1, 1), *around, loop=True)])


def test_hitting_a_wall_names_robot_place_and_time() -> None:
    cannot_brake = DriverSettings(speed_m_s=0.7, acceleration_m_s2=0.06)
    routes = [route("rover", [1, 3, 0], (7.5, 3), (1, 3))]
    with pytest.raises(InputError, match=r"robot rover: hits a wall at \(7.\d\d, 3.\d\d\), t = 1"):
        drive(HALL, routes, cannot_brake, 200, 0.2)


def test_hitting_another_robot_names_both() -> None:
    reckless = DriverSettings(speed_m_s=0.7, acceleration_m_s2=0.1)
    routes = [route("a", [1, 3, 0], (7, 3)), route("b", [6.9, 3, np.pi], (1, 3))]
    with pytest.raises(InputError, match=r"robot a: hits robot b at \(\d.\d\d, 3.\d\d\), t = \d"):
        drive(HALL, routes, reckless, 200, 0.2)


def test_two_that_block_each_other_end_in_an_error() -> None:
    routes = [route("a", [1, 3, 0], (7, 3)), route("b", [6.9, 3, np.pi], (1, 3))]
    hasty = DriverSettings(patience_s=3)
    with pytest.raises(InputError, match=r"robot \w: waits for another robot at .* since t = \d"):
        drive(HALL, routes, hasty, 200, 0.2)


def test_where_ways_cross_the_first_listed_goes_first() -> None:
    routes = [route("a", [1, 3, 0], (7, 3)), route("b", [3.4, 5.2, -np.pi / 2], (3.4, 1.0))]
    both = drive(HALL, routes, DriverSettings(), 110, 0.2)
    alone = drive(HALL, routes[:1], DriverSettings(), 110, 0.2)
    np.testing.assert_allclose(both.T_world_robot[0], alone.T_world_robot[0], atol=0.02)
    assert nearest_m(both, 1, (3.4, 1.0))[-1] < 0.25
    unhindered = drive(HALL, routes[1:], DriverSettings(), 110, 0.2)
    assert np.abs(both.T_world_robot[1] - unhindered.T_world_robot[0]).max() > 0.3


def test_of_two_that_stand_before_each_other_the_one_that_came_so_far_goes_on() -> None:
    """The second has stopped too late: in the way of the first, which it lets by."""
    first = route("a", [4.0, 5.4, -np.pi / 2], (4.0, 3.0), (6.5, 3.0))
    second = route("b", [2.2, 3.0, 0.0], (6.0, 3.0), (6.0, 5.0))
    both = drive(HALL, [first, second], DriverSettings(), 130, 0.2)
    a, b = both.T_world_robot[:, :, :2]
    assert np.hypot(*(a - b).T).min() > WIDTH_M  # they pass each other without touching
    assert nearest_m(both, 1, (6.0, 3.0)).min() < 0.3
    assert nearest_m(both, 0, (4.0, 3.0)).min() < 0.3


def test_robots_that_are_not_looked_at_are_in_nobodys_way() -> None:
    """Skipping distant robots gives the same result as checking each one."""
    rng = np.random.default_rng(0)
    for give_way_m in (0.05, 1.6, 3.0):
        settings = DriverSettings(give_way_m=give_way_m)
        nobody = cast(P3at, None)  # steers by poses alone
        near, asks_all = (
            _Driver(route("a", [1, 3, 0], (7, 3)), nobody, settings) for _ in range(2)
        )
        asks_all._range_m = np.inf
        found = set()
        for _ in range(300):
            pose, *there = map(tuple, rng.uniform([-2, -2, -4], [2, 2, 4], (3, 3)).tolist())
            flags = rng.random((2, 2)) < 0.5
            others = [_Other(T, k, *flags[k].tolist()) for k, T in enumerate(there)]
            found.add(asks_all._blocking_robot(pose, others))
            assert near._blocking_robot(pose, others) == asks_all._blocking_robot(pose, others)
        assert found == {None, 0, 1}


@pytest.mark.parametrize("interval_s", [0.21, 1 / 240, 0.0, -0.2, float("nan")])
def test_rates_that_do_not_divide_are_refused(interval_s: float) -> None:
    with pytest.raises(InputError, match="must be a multiple of 1/60 s"):
        drive(HALL, [route("a", [1, 1, 0], (1, 3))], DriverSettings(), 3, interval_s)


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match=r"speed_m_s: is 0\.8, must be in .0\.01, 0\.7. m/s"):
        DriverSettings(speed_m_s=0.8)
    with pytest.raises(InputError, match="arrival_m: is 0, must be in"):
        DriverSettings(arrival_m=0)
    with pytest.raises(InputError, match="robot a: needs at least one waypoint"):
        Route("a", np.zeros(3), np.zeros((0, 2)))


SOLID_WALLS_HALL = FloorPlan(
    (
        Wall(np.array([[0, 0], [8, 0], [8, 6], [0, 6], [0, 0]])),
        Wall(np.array([[4, 0], [4, 2]]), thickness_m=0.3),
    )
)


Place = tuple[float, float]
MIDDLES: list[Place] = [
    (float(x), float(y)) for x, y in np.mean(SOLID_WALLS_HALL.segments()[:2], axis=0)
]  # no two alike


def standing(world: World) -> set[Place]:
    """Return the positions of the walls in a world."""
    p, client = world.bullet, world.client
    bodies = range(p.getNumBodies(physicsClientId=client))
    places = [p.getBasePositionAndOrientation(body, physicsClientId=client)[0] for body in bodies]
    return {(x, y) for x, y, _ in places}


def test_what_is_within_reach_stands_and_what_never_was_near_does_not() -> None:
    rng = np.random.default_rng(0)
    starts, ends, thickness, _ = SOLID_WALLS_HALL.segments()
    numbers = set()
    for step_m in (0.01, 0.02, 0.05, 3.0):
        with World() as world:
            walls = SolidWalls(world, SOLID_WALLS_HALL, 2)
            poses, was_near = np.array([[0.8, 3.0, 0.0], [6.0, 5.2, 0.0]]), set()
            for _ in range(200):
                poses[:, :2] = (poses[:, :2] + rng.normal(0, step_m, (2, 2))).clip(
                    0.47, [7.53, 5.53]
                )
                walls.stand_near([(x, y, theta) for x, y, theta in poses.tolist()])
                away_m = segment_distance_m(poses[:, None, :2], starts, ends) - thickness / 2
                there = standing(world)
                for middle, nearest_m in zip(MIDDLES, away_m.min(axis=0), strict=True):
                    if nearest_m < NEAR_M:
                        was_near.add(middle)
                    assert nearest_m > WITHIN_REACH_M or middle in there
                assert there <= was_near
            numbers.add(len(there))
    assert min(numbers) < len(MIDDLES) == max(numbers)


def test_motions_are_those_among_all_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    routes = [
        Route("a", np.array([1, 1, 0.5]), np.array([[1, 3], [6, 3], [6, 1]])),
        Route("b", np.array([6, 5, 3.0]), np.array([[1, 5.2], [6, 5]]), loop=True),
    ]
    among_near = drive(SOLID_WALLS_HALL, routes, DriverSettings(), 120, 0.2)
    monkeypatch.setattr(driver, "NEAR_M", math.inf)
    among_all = drive(SOLID_WALLS_HALL, routes, DriverSettings(), 120, 0.2)
    np.testing.assert_array_equal(among_near.T_world_robot, among_all.T_world_robot)
    np.testing.assert_array_equal(among_near.wheel_rad, among_all.wheel_rad)
