"""Generated floor plans, and routes through them that share ground.

A wing has a corridor with a row of rooms to the north and one to the south. Every room has one or
two doors to the corridor and one door to each neighbour in its row. The doors between neighbours
are in line (an enfilade), so a robot can drive straight through a row. Wings are closed and have no
doors to each other, so a camera in one wing never sees another wing.

A loop leaves the corridor through a door, runs through the doors between the rooms of that row and
returns through another door: a rectangle whose legs cross every door in its middle. All robots
drive along the corridor in the same direction, because a camera that looks ahead sees a wall from
one side only.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.geometry.numerics import Float
from mapfusion.parameters import Range, require_in_range
from sim.floorplan import segment_distance_m
from sim.p3at import OUTER_RADIUS_M

SOUTH, NORTH = 0, 1
# Room to turn in place: the outer circle, the arrival tolerance (0.2 m) by which a robot may be
# beside its leg, and a margin of 0.1 m.
CLEARANCE_M = OUTER_RADIUS_M + 0.2 + 0.1
PIER_M = 0.3  # least wall between two doors, or between a door and a corner
NARROWEST_DOOR_M = 1.2  # twice: half the body 0.25 m, arrival tolerance 0.2 m, margin 0.15 m

_ROOM_TO_TURN_M = round(2.5 * CLEARANCE_M, 2)
_RoomSide = Annotated[float, Range(0.1, 50, "m")]


@dataclass(frozen=True)
class PlanParameters:
    """Ranges of the sizes of rooms, corridors and doors.

    Attributes:
        rooms_a_side: number of rooms on each side of a wing's corridor.
        doors_a_room: number of doors from each room to the corridor, 1 or 2; two doors allow more
            loops.
        room_width_m: smallest and largest size along the corridor.
        room_depth_m: smallest and largest size across the corridor.
        corridor_m: width of the corridor, in which the robot turns.
        door_m: width of every door.
    """

    rooms_a_side: Annotated[int, Range(1, 50, "rooms")] = 3
    doors_a_room: Annotated[int, Range(1, 2, "doors")] = 2
    room_width_m: tuple[_RoomSide, _RoomSide] = (3.8, 4.8)
    room_depth_m: tuple[_RoomSide, _RoomSide] = (3.0, 4.0)
    corridor_m: Annotated[float, Range(_ROOM_TO_TURN_M, 50, "m")] = 2.4
    door_m: Annotated[float, Range(NARROWEST_DOOR_M, 20, "m")] = 1.4

    def __post_init__(self) -> None:
        require_in_range(self)
        least_depth_m = 2 * self.beside_door_m
        least_width_m = least_depth_m + (self.doors_a_room - 1) * (self.door_m + PIER_M)
        for name, least_m in (("room_width_m", least_width_m), ("room_depth_m", least_depth_m)):
            low, high = getattr(self, name)
            if not least_m <= low <= high:
                raise InputError(
                    f"{name}: is {low:g} to {high:g}, must be a range from {least_m:.2f} on "
                    "(for the doors, and to turn before them)"
                )

    @property
    def beside_door_m(self) -> float:
        """Least distance from a door's middle to a corner of the room."""
        return max(CLEARANCE_M, self.door_m / 2 + PIER_M)


@dataclass(frozen=True)
class Row:
    """Rooms on one side of a corridor.

    Attributes:
        edges_m: x of the walls between n rooms, from west to east, shape (n + 1,).
        doors_m: x of the centres of the doors to the corridor, from west to east.
        corridor_wall_m: y of the wall on the corridor.
        outer_wall_m: y of the opposite wall.
        enfilade_m: y of the centres of the doors from room to room.
    """

    edges_m: Float
    doors_m: Float
    corridor_wall_m: float
    outer_wall_m: float
    enfilade_m: float


@dataclass(frozen=True)
class Wing:
    """Two rows of rooms on one corridor.

    Attributes:
        rows: southern and northern row.
        corridor_m: y of the centre line of the corridor.
    """

    rows: tuple[Row, Row]
    corridor_m: float


@dataclass(frozen=True)
class GeneratedPlan:
    """Wings side by side, and their walls.

    Attributes:
        wings: wings from west to east.
        walls_m: all walls as polylines, shape (K, 2).
        door_m: width of every door.
    """

    wings: tuple[Wing, ...]
    walls_m: tuple[Float, ...]
    door_m: float


def generate_plan(
    parameters: PlanParameters, n_wings: int, rng: np.random.Generator
) -> GeneratedPlan:
    """Draw a plan of wings without doors to each other; the south-west corner is (0, 0)."""
    depths = [float(rng.uniform(*parameters.room_depth_m)) for _ in (SOUTH, NORTH)]
    wall_y = np.cumsum([0.0, depths[SOUTH], parameters.corridor_m, depths[NORTH]])
    wings: list[Wing] = []
    west_m = 0.0
    for _ in range(n_wings):
        wing = _draw_wing(parameters, west_m, wall_y, rng)
        wings.append(wing)
        west_m = float(wing.rows[SOUTH].edges_m[-1])
    north_m = float(np.round(wall_y, 3)[-1])
    outline = [[0.0, 0.0], [west_m, 0.0], [west_m, north_m], [0.0, north_m], [0.0, 0.0]]
    walls, door_m = [np.array(outline)], parameters.door_m
    for i, wing in enumerate(wings):
        for row in wing.rows:
            west, east, y = float(row.edges_m[0]), float(row.edges_m[-1]), row.corridor_wall_m
            walls += _with_doors([west, y], [east, y], row.doors_m, door_m)
            for x in row.edges_m[1:-1].tolist():
                low, high = sorted([row.corridor_wall_m, row.outer_wall_m])
                walls += _with_doors([x, low], [x, high], np.array([row.enfilade_m]), door_m)
        if i + 1 < n_wings:  # wall to the next wing
            x = float(wing.rows[SOUTH].edges_m[-1])
            ends = [[x, wing.rows[side].outer_wall_m] for side in (SOUTH, NORTH)]
            walls.append(np.array(ends))
    return GeneratedPlan(tuple(wings), tuple(walls), door_m)


def _draw_wing(
    parameters: PlanParameters, west_m: float, wall_y: Float, rng: np.random.Generator
) -> Wing:
    """Draw rooms and doors of a wing whose walls along the corridor have y of `wall_y` (4,)."""
    low, high = parameters.room_width_m
    n_rooms, n_doors = parameters.rooms_a_side, parameters.doors_a_room
    length_m = round(float(rng.uniform(low, high, n_rooms).sum()), 3)
    outer, inner = wall_y[[0, 3]].round(3), wall_y[[1, 2]].round(3)
    beside, apart = parameters.beside_door_m, parameters.door_m + PIER_M
    rows = []
    for side in (SOUTH, NORTH):
        # widths: the least width and a random share of the remaining length
        least_m = parameters.room_width_m[0]
        spare = (length_m - n_rooms * least_m) * rng.dirichlet(np.full(n_rooms, 2.0))
        edges = west_m + np.concatenate([[0.0], np.cumsum(least_m + spare)])
        # centres of each room's doors, with room beside and between them
        doors = []
        for west, east in itertools.pairwise(edges.tolist()):
            spare_m = east - west - 2 * beside - (n_doors - 1) * apart
            drawn = np.sort(rng.uniform(0, spare_m, n_doors))
            doors.append(west + beside + drawn + apart * np.arange(n_doors))
        low, high = sorted([float(outer[side]), float(inner[side])])
        rows.append(
            Row(
                edges.round(3),
                np.concatenate(doors).round(3),
                float(inner[side]),
                float(outer[side]),
                round(float(rng.uniform(low + beside, high - beside)), 3),
            )
        )
    return Wing((rows[SOUTH], rows[NORTH]), round(float(inner.mean()), 3))


def _with_doors(start: list[float], end: list[float], doors_m: Float, door_m: float) -> list[Float]:
    """Return a wall along x or y with gaps around the positions `doors_m` on that axis."""
    axis = 0 if start[1] == end[1] else 1
    cuts = np.sort(np.concatenate([doors_m - door_m / 2, doors_m + door_m / 2]))
    places = np.concatenate([[start[axis]], cuts, [end[axis]]]).round(3).reshape(-1, 2)
    pieces = []
    for low, high in places:
        piece = np.array([start, end], dtype=np.float64)
        piece[:, axis] = low, high
        pieces.append(piece)
    return pieces


GROUND_HALF_WIDTH_M = 0.5  # half width of the visited ground: about that of the robot
CELL_M = 0.1  # grid cell of visited ground
# Least distance between two starts: the distance to give way (1.6 m) and the start jitter.
START_GAP_M = 1.9
MOST_PLANS = 20  # most plans drawn for a requested overlap
NEAR_ENOUGH = 0.03  # error of the overlap at which drawing stops
TOLERANCE = 0.13  # largest accepted error of the overlap (half the gap below 1)
MOST_CHOICES = 3000  # sets of loops compared in one plan
MOST_LISTED = 200_000  # sets of loops that are enumerated; more sets are sampled

_LoopLength = Annotated[float, Range(0.1, 1000, "m")]


@dataclass(frozen=True)
class RouteParameters:
    """Requirements on the robots' routes.

    Attributes:
        robots: number of robots, each with a loop of its own.
        overlap: intersection over union of the ground visited by two robots, mean over pairs.
        loop_m: shortest and longest loop.
    """

    robots: Annotated[int, Range(1, 20, "robots")] = 2
    overlap: Annotated[float, Range(0, 1, "1")] = 0.5
    loop_m: tuple[_LoopLength, _LoopLength] = (12.0, 22.0)

    def __post_init__(self) -> None:
        require_in_range(self)
        if not self.loop_m[0] <= self.loop_m[1]:
            shortest_m, longest_m = self.loop_m
            said = f"is {shortest_m:g} to {longest_m:g}, the shortest is above the longest"
            raise OutOfRangeError("loop_m", said)


@dataclass(frozen=True)
class PlannedRoute:
    """Loop of one robot.

    Attributes:
        T_world_start: start pose on the loop, looking along it, shape (3,).
        waypoints_m: waypoints in order, shape (K, 2); the last leg returns to the start.
    """

    T_world_start: Float
    waypoints_m: Float


@dataclass(frozen=True)
class GeneratedWorld:
    """Plan with routes.

    Attributes:
        plan: rooms, doors and walls.
        routes: one route per robot.
        overlap: achieved overlap, see `ground_overlaps`; mean over the pairs of robots.
    """

    plan: GeneratedPlan
    routes: tuple[PlannedRoute, ...]
    overlap: float


def generate_world(
    plan_parameters: PlanParameters, parameters: RouteParameters, rng: np.random.Generator
) -> GeneratedWorld:
    """Draw plans and choose loops in them until the overlap is as requested.

    For an overlap of 0 every robot has a wing of its own, so the robots share no wall either.

    Raises:
        InputError: there are no loops of that length, or none with an overlap near the request.
    """
    best: GeneratedWorld | None = None
    n_wings = parameters.robots if parameters.overlap == 0 else 1
    for child in rng.spawn(MOST_PLANS):
        plan = generate_plan(plan_parameters, n_wings, child)
        found = _best_routes(plan, parameters, child)
        if found is None:
            continue
        if best is None or _overlap_error(found, parameters) < _overlap_error(best, parameters):
            best = found
        if _overlap_error(best, parameters) <= NEAR_ENOUGH:
            break
    if best is None:
        raise InputError(
            f"loop_m: no loop of {parameters.loop_m[0]:g} to {parameters.loop_m[1]:g} m in "
            f"{MOST_PLANS} plans; change loop_m, rooms_a_side or the sizes of the rooms"
        )
    if _overlap_error(best, parameters) > TOLERANCE:
        raise InputError(
            f"overlap: {parameters.overlap:g} cannot be had with loops of {parameters.loop_m[0]:g} "
            f"to {parameters.loop_m[1]:g} m in such rooms, the nearest is {best.overlap:.2f}; "
            "change loop_m or rooms_a_side"
        )
    return best


def _overlap_error(world: GeneratedWorld, parameters: RouteParameters) -> float:
    return abs(world.overlap - parameters.overlap)


def _best_routes(
    plan: GeneratedPlan, parameters: RouteParameters, rng: np.random.Generator
) -> GeneratedWorld | None:
    """Return the loops with the overlap nearest to the request; None without loops.

    Equal sets of loops are in random order.
    """
    westward = bool(rng.integers(2))
    per_wing = [_loops(wing, parameters, westward) for wing in plan.wings]
    if not all(per_wing):
        return None
    offered = per_wing if len(per_wing) > 1 else per_wing * parameters.robots
    # loop indices of each robot, shape (C, R), with at most MOST_CHOICES rows
    n_offered = [len(loops) for loops in offered]
    if math.prod(n_offered) > MOST_LISTED:
        shape = MOST_CHOICES, len(n_offered)
        drawn = rng.integers(n_offered, size=shape)
        # robots share some of the drawn loops, so the sets cover the range of overlaps
        n_taken = rng.integers(1, len(n_offered), size=MOST_CHOICES, endpoint=True)
        taken = rng.integers(n_taken[:, None], size=shape)
        choices = np.take_along_axis(drawn, taken, axis=1) % n_offered
    else:
        choices = np.array(list(itertools.product(*map(range, n_offered))))
        choices = choices[rng.permutation(len(choices))[:MOST_CHOICES]]
    shared = ground_overlaps(
        [np.concatenate([loop, loop[:1]]) for loops in per_wing for loop in loops]
    )
    first = (
        np.cumsum([0, *map(len, per_wing)]) if len(per_wing) > 1 else np.zeros(len(offered), int)
    )
    best, best_miss = None, np.inf
    # overlap of each choice: the mean over its pairs of robots, 1 for a single robot
    rows = choices + first[: len(offered)]
    pairs = [
        shared[rows[:, a], rows[:, b]] for a, b in itertools.combinations(range(rows.shape[1]), 2)
    ]
    overlaps = np.mean(pairs, axis=0) if pairs else np.ones(len(rows))
    for choice, overlap in zip(choices.tolist(), overlaps.tolist(), strict=True):
        if abs(overlap - parameters.overlap) < best_miss:
            chosen = [loops[i] for loops, i in zip(offered, choice, strict=True)]
            routes = _draw_starts(chosen, rng)
            if routes is not None:
                best_miss = abs(overlap - parameters.overlap)
                best = GeneratedWorld(plan, routes, overlap)
    return best


def _loops(wing: Wing, parameters: RouteParameters, westward: bool) -> list[Float]:
    """Return all loops (4, 2) of allowed length through a row of a wing and its corridor."""
    loops = []
    for row in wing.rows:
        for west, east in itertools.combinations(row.doors_m.tolist(), 2):
            leave, enter = (west, east) if westward else (east, west)
            loop = np.array(
                [
                    [enter, wing.corridor_m],
                    [leave, wing.corridor_m],
                    [leave, row.enfilade_m],
                    [enter, row.enfilade_m],
                ]
            )
            if parameters.loop_m[0] <= length_m(loop) <= parameters.loop_m[1]:
                loops.append(loop)
    return loops


def length_m(loop: Float) -> float:
    """Return the length of a closed polyline (K, 2)."""
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def _draw_starts(
    loops: Sequence[Float], rng: np.random.Generator
) -> tuple[PlannedRoute, ...] | None:
    """Draw starts in the middle of legs; return None if some would be too near to each other."""
    taken: list[Float] = []
    routes = []
    for loop in loops:
        ends = np.roll(loop, -1, axis=0)
        middles = (loop + ends) / 2
        legs = rng.permutation(len(loop))
        gaps = [
            min((float(np.hypot(*(middles[i] - o))) for o in taken), default=np.inf) for i in legs
        ]
        free = [int(i) for i, gap in zip(legs, gaps, strict=True) if gap >= START_GAP_M]
        if not free:
            return None
        leg = free[0]
        x, y = ends[leg] - loop[leg]
        taken.append(middles[leg])
        start = np.array([*middles[leg], np.arctan2(y, x)]).round(3)
        routes.append(PlannedRoute(start, np.roll(loop, -leg - 1, axis=0)))
    return tuple(routes)


def ground_overlaps(paths: Sequence[Float]) -> Float:
    """Return intersection over union of the ground along pairs of paths (N, 2), shape (P, P)."""
    # imported here, because most commands draw no routes
    from scipy.sparse import csr_array

    points = np.concatenate(paths)
    low, high = points.min(axis=0) - GROUND_HALF_WIDTH_M, points.max(axis=0) + GROUND_HALF_WIDTH_M
    x, y = (np.arange(low[i] + CELL_M / 2, high[i], CELL_M) for i in (0, 1))
    # cells whose centres lie near a path, ascending
    visited, reach_m = list[np.ndarray](), GROUND_HALF_WIDTH_M + CELL_M
    for path in paths:
        near_legs = []
        for start, end in itertools.pairwise(path):
            first, last = np.minimum(start, end) - reach_m, np.maximum(start, end) + reach_m
            columns = np.arange(*np.searchsorted(x, [first[0], last[0]]))
            rows = np.arange(*np.searchsorted(y, [first[1], last[1]]))
            column, row = (index.ravel() for index in np.meshgrid(columns, rows))
            centres = np.stack([x[column], y[row]], -1)
            near = segment_distance_m(centres, start, end) <= GROUND_HALF_WIDTH_M
            near_legs.append((row * len(x) + column)[near])
        visited.append(np.unique(np.concatenate(near_legs)))
    size = np.array([len(cells) for cells in visited])
    starts = np.concatenate([[0], np.cumsum(size)])
    # sparse, because a path visits a small part of a large building
    table = csr_array(
        (np.ones(starts[-1]), np.concatenate(visited), starts), shape=(len(paths), len(x) * len(y))
    )
    both = (table @ table.T).toarray()
    return both / (size[:, None] + size - both)
