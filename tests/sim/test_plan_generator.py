"""Tests of `sim.plan_generator`."""

import functools
import itertools
from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.errors import InputError
from sim.driver import DriverSettings, drive
from sim.floorplan import FloorPlan, Wall
from sim.p3at import OUTER_RADIUS_M
from sim.plan_generator import (
    GROUND_HALF_WIDTH_M,
    NORTH,
    SOUTH,
    TOLERANCE,
    GeneratedPlan,
    GeneratedWorld,
    PlanParameters,
    RouteParameters,
    generate_plan,
    generate_world,
    ground_overlaps,
    length_m,
)
from sim.routes import Route, check_routes

CELL_M = 0.2
seeds = st.integers(0, 2**32 - 1)


def floor_plan(plan: GeneratedPlan) -> FloorPlan:
    return FloorPlan(tuple(Wall(wall, 2.5, 0.12) for wall in plan.walls_m))


def reachable(walls: FloorPlan, start: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Cells where a turning robot has room, and those of them it can get to from the start."""
    _, high = walls.extent_m
    shape = np.ceil(high / CELL_M).astype(int)
    middles = (np.stack(np.indices(shape), -1) + 0.5) * CELL_M
    free = (walls.clearance_m(middles.reshape(-1, 2)) > OUTER_RADIUS_M).reshape(shape)
    reached = np.zeros_like(free)
    todo = deque([tuple((np.array(start) / CELL_M).astype(int))])
    while todo:
        i, j = todo.popleft()
        if 0 <= i < shape[0] and 0 <= j < shape[1] and free[i, j] and not reached[i, j]:
            reached[i, j] = True
            todo += [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
    return free, reached


def rooms(plan: GeneratedPlan) -> list[tuple[float, float]]:
    """A place in each room."""
    return [
        ((west + east) / 2, (row.outer_wall_m + row.corridor_wall_m) / 2)
        for wing in plan.wings
        for row in wing.rows
        for west, east in pairwise(row.edges_m.tolist())
    ]


@settings(max_examples=15)
@given(seeds, st.integers(1, 4), st.integers(1, 2))
def test_every_room_of_a_wing_can_be_reached_from_every_other(
    seed: int, rooms_a_side: int, doors_a_room: int
) -> None:
    parameters = PlanParameters(rooms_a_side, doors_a_room)
    plan = generate_plan(parameters, 1, np.random.default_rng(seed))
    free, reached = reachable(floor_plan(plan), rooms(plan)[0])
    assert np.all(reached[free])
    for x, y in rooms(plan):
        assert reached[int(x / CELL_M), int(y / CELL_M)]


@settings(max_examples=8)
@given(seeds)
def test_no_way_leads_from_wing_to_wing(seed: int) -> None:
    plan = generate_plan(PlanParameters(2), 2, np.random.default_rng(seed))
    first, second = plan.wings
    _, reached = reachable(floor_plan(plan), (first.rows[SOUTH].doors_m[0], first.corridor_m))
    border = int(np.ceil(first.rows[SOUTH].edges_m[-1] / CELL_M))
    assert reached[:border].any()
    assert not reached[border:].any()
    assert second.rows[SOUTH].edges_m[0] == first.rows[NORTH].edges_m[-1]


@settings(max_examples=25)
@given(seeds, st.floats(1.2, 1.7))
def test_doors_are_as_wide_as_asked_and_rooms_as_large(seed: int, door_m: float) -> None:
    parameters = PlanParameters(door_m=door_m, room_width_m=(4.4, 5))
    plan = generate_plan(parameters, 2, np.random.default_rng(seed))
    walls = floor_plan(plan)
    for row in (row for wing in plan.wings for row in wing.rows):
        widths = np.diff(row.edges_m)
        assert widths.min() > 4.4 - 2e-3
        assert 3.0 - 2e-3 < abs(row.outer_wall_m - row.corridor_wall_m) < 4.0 + 2e-3
        doors = [(x, row.corridor_wall_m) for x in row.doors_m]
        doors += [(x, row.enfilade_m) for x in row.edges_m[1:-1]]
        # the wall's ends count as rounded: half its thickness is taken off the door's half width
        np.testing.assert_allclose(walls.clearance_m(doors), door_m / 2 - 0.06, atol=2e-3)
        beside = [
            (x + s * (door_m / 2 + 0.1), y) for x, y in doors[: len(row.doors_m)] for s in (-1, 1)
        ]
        assert walls.clearance_m(beside).max() < 0  # and beside it there is wall


def test_a_plan_depends_on_its_seed_alone() -> None:
    def walls(seed: int) -> np.ndarray:
        return np.concatenate(
            generate_plan(PlanParameters(), 1, np.random.default_rng(seed)).walls_m
        )

    np.testing.assert_array_equal(walls(1), walls(1))
    assert not np.array_equal(walls(1), walls(2))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"rooms_a_side": 0}, "rooms_a_side"),
        ({"doors_a_room": 3}, "doors_a_room"),
        ({"door_m": 1.0}, "door_m: is 1.0, must be in .1.2"),
        ({"door_m": np.nan}, "door_m"),
        ({"room_width_m": (2.0, 4.0)}, "room_width_m: is 2 to 4"),
        ({"room_depth_m": (4.0, 3.0)}, "room_depth_m: is 4 to 3"),
        ({"corridor_m": 1.0}, "corridor_m: is 1.0, must be in .1.64"),
    ],
)
def test_sizes_that_cannot_be_driven_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        PlanParameters(**settings)


@functools.cache
def generated(seed: int, overlap: float = 0.5, robots: int = 2) -> GeneratedWorld:
    parameters = RouteParameters(robots, overlap)
    return generate_world(PlanParameters(), parameters, np.random.default_rng(seed))


def closed(waypoints_m: np.ndarray) -> np.ndarray:
    return np.concatenate([waypoints_m, waypoints_m[:1]])


def route_planner_floor_plan(world: GeneratedWorld) -> FloorPlan:
    return FloorPlan(tuple(Wall(wall, 2.5, 0.12) for wall in world.plan.walls_m))


def routes(world: GeneratedWorld) -> list[Route]:
    return [
        Route(f"R{i}", route.T_world_start, route.waypoints_m, loop=True)
        for i, route in enumerate(world.routes)
    ]


def ground_overlap(path_a_m: np.ndarray, path_b_m: np.ndarray) -> float:
    """Return intersection over union of the ground along two paths."""
    return float(ground_overlaps([path_a_m, path_b_m])[0, 1])


def test_overlap_of_straight_paths_is_that_of_their_areas() -> None:
    """Two stadiums of half width r, shifted along themselves: areas by hand."""
    r, length, shift = GROUND_HALF_WIDTH_M, 10.0, 4.0
    a = np.array([[0, 0], [length, 0]])
    area = 2 * r * length + np.pi * r**2
    both = 2 * r * (length - shift) + np.pi * r**2
    expected = both / (2 * area - both)
    assert ground_overlap(a, a + np.array([shift, 0.0])) == pytest.approx(expected, abs=0.01)


def test_overlap_is_symmetric_one_with_itself_and_nothing_far_away() -> None:
    a = np.array([[0.0, 0], [3, 1], [2, 4]])
    b = np.array([[1.0, 0], [3, 3]])
    assert ground_overlap(a, b) == ground_overlap(b, a)
    assert 0 < ground_overlap(a, b) < 1
    assert ground_overlap(a, a[::-1]) == 1
    assert ground_overlap(a, b + 20) == 0


@pytest.mark.parametrize("robots", [2, 3])
def test_overlap_is_near_the_one_asked_for_and_grows_with_it(robots: int) -> None:
    asked = [0.0, 0.15, 0.3, 0.5, 0.7, 1.0]
    achieved = np.array([[generated(seed, o, robots).overlap for o in asked] for seed in range(5)])
    assert np.abs(achieved - asked).max() <= TOLERANCE
    assert np.all(np.diff(achieved, axis=1) > 0)
    np.testing.assert_array_equal(achieved[:, [0, -1]], [[0, 1]] * 5)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("overlap", [0.0, 0.4, 1.0])
def test_what_is_reported_is_what_the_routes_share(seed: int, overlap: float) -> None:
    world = generated(seed, overlap)
    a, b = (closed(route.waypoints_m) for route in world.routes)
    assert world.overlap == pytest.approx(ground_overlap(a, b), abs=0.02)


@pytest.mark.parametrize("seed", range(12))
def test_routes_have_room_and_the_length_asked_for(seed: int) -> None:
    world = generated(seed, [0.0, 0.3, 0.6, 1.0][seed % 4], 2 + seed % 2)
    plan = route_planner_floor_plan(world)
    check_routes(plan, routes(world))
    for route in world.routes:
        assert 12 <= length_m(route.waypoints_m) <= 22
        assert plan.clearance_m(route.waypoints_m).min() > 0.59  # to turn, 0.2 m off, 0.03 spare
        for start, end in itertools.pairwise(closed(route.waypoints_m)):
            assert plan.leg_clearance_m(start, end) > 0.5  # half a door of 1.4 m, less the wall


def test_twenty_robots_find_loops_in_a_hundred_rooms() -> None:
    """There are more sets of loops than can be listed; those that are drawn reach the overlap."""
    world = generate_world(
        PlanParameters(rooms_a_side=50), RouteParameters(20, 0.1), np.random.default_rng(1)
    )
    assert world.overlap == pytest.approx(0.1, abs=0.02)
    check_routes(route_planner_floor_plan(world), routes(world))
    paths = [closed(route.waypoints_m) for route in world.routes]
    shared = [ground_overlap(a, b) for a, b in itertools.combinations(paths, 2)]
    assert np.mean(shared) == pytest.approx(world.overlap, abs=0.005)


def test_all_robots_drive_the_corridor_the_same_way() -> None:
    rows_apart = 0
    for seed in range(8):
        world = generated(seed, 0.15)
        y = world.plan.wings[0].corridor_m
        ways, sides = [], []
        for route in world.routes:
            sides.append(np.sign(route.waypoints_m[:, 1] - y).sum())
            for start, end in itertools.pairwise(closed(route.waypoints_m)):
                if start[1] == end[1] == y:
                    ways.append(np.sign(end[0] - start[0]))
        assert len(ways) == 2
        assert ways[0] == ways[1]
        rows_apart += sides[0] != sides[1]
    assert rows_apart > 0  # one loop in the north, the other in the south: it could have differed


@pytest.mark.parametrize(("seed", "overlap"), [(0, 0.0), (1, 0.3), (2, 0.7), (3, 1.0)])
def test_generated_worlds_drive_without_collision(seed: int, overlap: float) -> None:
    world = generated(seed, overlap)
    driven = drive(route_planner_floor_plan(world), routes(world), DriverSettings(), 130, 0.3)
    way_m = np.linalg.norm(np.diff(driven.T_world_robot[:, :, :2], axis=1), axis=2).sum(axis=1)
    assert way_m.min() > 9


def test_a_seed_gives_the_same_world() -> None:
    again = generated.__wrapped__
    first, second, other = generated(5), again(5), generated(6)
    for a, b in zip(first.routes, second.routes, strict=True):
        np.testing.assert_array_equal(a.T_world_start, b.T_world_start)
        np.testing.assert_array_equal(a.waypoints_m, b.waypoints_m)
    assert not np.array_equal(first.routes[0].waypoints_m, other.routes[0].waypoints_m)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"robots": 0}, "robots: is 0"),
        ({"robots": 21}, "robots: is 21"),
        ({"overlap": 1.5}, "overlap: is 1.5"),
        ({"overlap": np.nan}, "overlap: is nan"),
        ({"loop_m": (5.0, 3.0)}, "loop_m: is 5 to 3"),
    ],
)
def test_impossible_wishes_are_refused(settings: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        RouteParameters(**settings)


def test_a_plan_without_such_loops_says_so() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="loop_m: no loop of 90 to 100 m"):
        generate_world(PlanParameters(), RouteParameters(loop_m=(90, 100)), rng)
    small = PlanParameters(rooms_a_side=2, doors_a_room=1, room_width_m=(3, 3.2))
    with pytest.raises(InputError, match=r"overlap: 0.7 cannot be had .* the nearest is"):
        generate_world(small, RouteParameters(overlap=0.7, loop_m=(8, 30)), rng)
