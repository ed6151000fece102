"""Generated plans, held against the walls alone: a flood fill knows nothing of rooms and doors."""

from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.errors import InputError
from sim.floorplan import FloorPlan, Wall
from sim.p3at import OUTER_RADIUS_M
from sim.plan_generator import NORTH, SOUTH, GeneratedPlan, PlanParameters, generate_plan

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
