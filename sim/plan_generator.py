"""Generated floor plans, and routes through them that share ground.

A wing is cut from the west end of the corridor to its east end into rooms, north and south. Every
room has one or two doors to the corridor and one to each neighbour in its row; the doors between
neighbours stand in line (an enfilade), so a row can be driven through straight. Wings have no door
to each other and are closed all around: from one, nothing of another is ever seen.

A loop leaves the corridor by one room's door, runs through the doors between the rooms of that row
and comes back by another's: a rectangle whose legs cross every door in its middle. All robots drive
the corridor in the same direction, as a camera that looks ahead sees a wall from one side only.
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
# A robot is up to the arrival tolerance (0.2 m) beside its leg, and turns on the spot: its outer
# circle, that tolerance, and a hand's breadth to spare.
CLEARANCE_M = OUTER_RADIUS_M + 0.2 + 0.1
PIER_M = 0.3  # least wall between two doors, or between a door and a corner
NARROWEST_DOOR_M = 1.2  # 0.25 m for half the body, 0.2 m beside the leg, 0.15 m to spare: twice

_ROOM_TO_TURN_M = round(2.5 * CLEARANCE_M, 2)
_RoomSide = Annotated[float, Range(0.1, 50, "m")]


@dataclass(frozen=True)
class PlanParameters:
    """Sizes that rooms are drawn from.

    Attributes:
        rooms_a_side: rooms on each side of a wing's corridor.
        doors_a_room: doors from each room to the corridor, 1 or 2; more doors, more ways to go.
        room_width_m: along the corridor, smallest and largest.
        room_depth_m: across it, smallest and largest.
        corridor_m: its width; the robot turns in it.
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
    """The rooms on one side of a corridor.

    Attributes:
        edges_m: (n + 1,) x of the walls between the rooms, from west to east.
        doors_m: (n * doors a room,) x of the middles of the doors to the corridor, west to east.
        corridor_wall_m: y of the wall on the corridor.
        outer_wall_m: y of the wall opposite.
        enfilade_m: y of the middle of the doors from room to room.
    """

    edges_m: Float
    doors_m: Float
    corridor_wall_m: float
    outer_wall_m: float
    enfilade_m: float


@dataclass(frozen=True)
class Wing:
    """Two rows on one corridor.

    Attributes:
        rows: the southern and the northern.
        corridor_m: y of the corridor's middle.
    """

    rows: tuple[Row, Row]
    corridor_m: float


@dataclass(frozen=True)
class GeneratedPlan:
    """Wings side by side, and all walls as polylines (K, 2).

    Attributes:
        wings: from west to east.
        walls_m: what `sim.floorplan.Wall` takes.
        door_m: width of every door.
    """

    wings: tuple[Wing, ...]
    walls_m: tuple[Float, ...]
    door_m: float


def generate_plan(
    parameters: PlanParameters, n_wings: int, rng: np.random.Generator
) -> GeneratedPlan:
    """Draw a plan of wings that have no door to each other; the south-west corner is (0, 0)."""
    depths = [float(rng.uniform(*parameters.room_depth_m)) for _ in (SOUTH, NORTH)]
    levels = np.cumsum([0.0, depths[SOUTH], parameters.corridor_m, depths[NORTH]])
    wings: list[Wing] = []
    west_m = 0.0
    for _ in range(n_wings):
        wing = _wing(parameters, west_m, levels, rng)
        wings.append(wing)
        west_m = float(wing.rows[SOUTH].edges_m[-1])
    rounded = np.round(levels, 3)
    walls = [_closed(0.0, 0.0, west_m, float(rounded[-1]))]
    for i, wing in enumerate(wings):
        walls += _wing_walls(wing, parameters.door_m, closes_east=i + 1 < n_wings)
    return GeneratedPlan(tuple(wings), tuple(walls), parameters.door_m)


def _wing(
    parameters: PlanParameters, west_m: float, levels: Float, rng: np.random.Generator
) -> Wing:
    low, high = parameters.room_width_m
    length_m = round(float(rng.uniform(low, high, parameters.rooms_a_side).sum()), 3)
    outer, inner = levels[[0, 3]].round(3), levels[[1, 2]].round(3)
    rows = []
    for side in (SOUTH, NORTH):
        edges = west_m + _split(length_m, parameters, rng)
        doors = [_doors(a, b, parameters, rng) for a, b in itertools.pairwise(edges.tolist())]
        low, high = sorted([float(outer[side]), float(inner[side])])
        beside = parameters.beside_door_m
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


def _doors(
    west_m: float, east_m: float, parameters: PlanParameters, rng: np.random.Generator
) -> Float:
    """Middles of one room's doors to the corridor, from west to east."""
    n, beside = parameters.doors_a_room, parameters.beside_door_m
    apart = parameters.door_m + PIER_M
    spare_m = east_m - west_m - 2 * beside - (n - 1) * apart
    return west_m + beside + np.sort(rng.uniform(0, spare_m, n)) + apart * np.arange(n)


def _split(length_m: float, parameters: PlanParameters, rng: np.random.Generator) -> Float:
    """Edges (n + 1,) that cut a row of that length into rooms no narrower than allowed."""
    n, least_m = parameters.rooms_a_side, parameters.room_width_m[0]
    spare = (length_m - n * least_m) * rng.dirichlet(np.full(n, 2.0))
    return np.concatenate([[0.0], np.cumsum(least_m + spare)])


def _wing_walls(wing: Wing, door_m: float, closes_east: bool) -> list[Float]:
    walls = []
    for row in wing.rows:
        west, east = float(row.edges_m[0]), float(row.edges_m[-1])
        walls += _with_doors(
            [west, row.corridor_wall_m], [east, row.corridor_wall_m], row.doors_m, door_m
        )
        for x in row.edges_m[1:-1].tolist():
            low, high = sorted([row.corridor_wall_m, row.outer_wall_m])
            walls += _with_doors([x, low], [x, high], np.array([row.enfilade_m]), door_m)
    if closes_east:
        x = float(wing.rows[SOUTH].edges_m[-1])
        ends = [[x, wing.rows[side].outer_wall_m] for side in (SOUTH, NORTH)]
        walls.append(np.array(ends))
    return walls


def _with_doors(start: list[float], end: list[float], doors_m: Float, door_m: float) -> list[Float]:
    """A wall along x or y with gaps around the places `doors_m` on that axis."""
    axis = 0 if start[1] == end[1] else 1
    cuts = np.sort(np.concatenate([doors_m - door_m / 2, doors_m + door_m / 2]))
    places = np.concatenate([[start[axis]], cuts, [end[axis]]]).round(3).reshape(-1, 2)
    pieces = []
    for low, high in places:
        piece = np.array([start, end], dtype=np.float64)
        piece[:, axis] = low, high
        pieces.append(piece)
    return pieces


def _closed(x0: float, y0: float, x1: float, y1: float) -> Float:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])


GROUND_HALF_WIDTH_M = 0.5  # ground this far beside a path counts as visited: about the robot's body
CELL_M = 0.1  # the ground is counted in squares of this side
# Between two starts: farther than a robot gives way (1.6 m), with what the start jitter may take.
START_GAP_M = 1.9
MOST_PLANS = 20  # drawn until one offers the overlap asked for
NEAR_ENOUGH = 0.03  # of the overlap asked for: drawing stops
TOLERANCE = 0.13  # of the overlap asked for: farther off is refused (half the gap below 1)
MOST_CHOICES = 3000  # sets of loops compared in one plan
MOST_LISTED = 200_000  # sets of loops that are listed to draw from; of more, any are drawn

_LoopLength = Annotated[float, Range(0.1, 1000, "m")]


@dataclass(frozen=True)
class RouteParameters:
    """What the robots' routes are to be.

    Attributes:
        robots: how many, each with a loop of its own.
        overlap: share of the ground visited by two robots that both visit (mean over pairs).
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
    """One robot's loop.

    Attributes:
        T_world_start: (3,) on the loop, looking along it.
        waypoints_m: (K, 2) visited in order, over and over; the last leg leads to the start's.
    """

    T_world_start: Float
    waypoints_m: Float


@dataclass(frozen=True)
class GeneratedWorld:
    """A plan with routes.

    Attributes:
        plan: rooms, doors and walls.
        routes: one a robot.
        overlap: achieved, see `ground_overlap`; mean over the pairs of robots.
    """

    plan: GeneratedPlan
    routes: tuple[PlannedRoute, ...]
    overlap: float


def generate_world(
    plan_parameters: PlanParameters, parameters: RouteParameters, rng: np.random.Generator
) -> GeneratedWorld:
    """Draw plans and choose loops in them until the overlap is the one asked for.

    Without overlap every robot has a wing of its own, so that no wall is common either.

    Raises:
        InputError: no loops of that length, or none with an overlap near what was asked.
    """
    best: GeneratedWorld | None = None
    apart = parameters.overlap == 0
    for child in rng.spawn(MOST_PLANS):
        plan = generate_plan(plan_parameters, parameters.robots if apart else 1, child)
        found = _best_routes(plan, parameters, child)
        if found is None:
            continue
        if best is None or _miss(found, parameters) < _miss(best, parameters):
            best = found
        if _miss(best, parameters) <= NEAR_ENOUGH:
            break
    if best is None:
        raise InputError(
            f"loop_m: no loop of {parameters.loop_m[0]:g} to {parameters.loop_m[1]:g} m in "
            f"{MOST_PLANS} plans; change loop_m, rooms_a_side or the sizes of the rooms"
        )
    if _miss(best, parameters) > TOLERANCE:
        raise InputError(
            f"overlap: {parameters.overlap:g} cannot be had with loops of {parameters.loop_m[0]:g} "
            f"to {parameters.loop_m[1]:g} m in such rooms, the nearest is {best.overlap:.2f}; "
            "change loop_m or rooms_a_side"
        )
    return best


def _miss(world: GeneratedWorld, parameters: RouteParameters) -> float:
    return abs(world.overlap - parameters.overlap)


def _best_routes(
    plan: GeneratedPlan, parameters: RouteParameters, rng: np.random.Generator
) -> GeneratedWorld | None:
    """The loops whose overlap comes nearest, in a random order among equals."""
    westward = bool(rng.integers(2))
    per_wing = [_loops(wing, parameters, westward) for wing in plan.wings]
    if not all(per_wing):
        return None
    offered = per_wing if len(per_wing) > 1 else per_wing * parameters.robots
    choices = _choices([len(loops) for loops in offered], rng)
    shared = _pairwise([np.concatenate([loop, loop[:1]]) for loops in per_wing for loop in loops])
    first = (
        np.cumsum([0, *map(len, per_wing)]) if len(per_wing) > 1 else np.zeros(len(offered), int)
    )
    best, best_miss = None, np.inf
    overlaps = _mean_pair(shared, choices + first[: len(offered)])
    for choice, overlap in zip(choices.tolist(), overlaps.tolist(), strict=True):
        if abs(overlap - parameters.overlap) < best_miss:
            starts = _starts([loops[i] for loops, i in zip(offered, choice, strict=True)], rng)
            if starts is not None:
                best_miss = abs(overlap - parameters.overlap)
                best = GeneratedWorld(plan, starts, overlap)
    return best


def _choices(n_offered: list[int], rng: np.random.Generator) -> np.ndarray:
    """Which loop each robot takes: sets (C, R), MOST_CHOICES of all there are at most."""
    if math.prod(n_offered) > MOST_LISTED:
        shape = MOST_CHOICES, len(n_offered)
        drawn = rng.integers(n_offered, size=shape)
        # robots share some of the loops drawn, or all have one: any overlap is among such sets
        n_taken = rng.integers(1, len(n_offered), size=MOST_CHOICES, endpoint=True)
        taken = rng.integers(n_taken[:, None], size=shape)
        return np.take_along_axis(drawn, taken, axis=1) % n_offered
    choices = np.array(list(itertools.product(*map(range, n_offered))))
    return choices[rng.permutation(len(choices))[:MOST_CHOICES]]


def _mean_pair(shared: Float, rows: np.ndarray) -> Float:
    """Overlap (C,) of sets of paths (C, R): the mean over the pairs in a set, 1 without any."""
    pairs = [
        shared[rows[:, a], rows[:, b]] for a, b in itertools.combinations(range(rows.shape[1]), 2)
    ]
    return np.mean(pairs, axis=0) if pairs else np.ones(len(rows))


def _loops(wing: Wing, parameters: RouteParameters, westward: bool) -> list[Float]:
    """All loops (4, 2) of allowed length, from the corridor to the corridor."""
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
    """Length of a closed polyline (K, 2)."""
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def _starts(loops: Sequence[Float], rng: np.random.Generator) -> tuple[PlannedRoute, ...] | None:
    """Starts at random in the middle of legs; None where they cannot be apart from each other."""
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


def ground_overlap(path_a_m: Float, path_b_m: Float) -> float:
    """Ground that two paths (N, 2), (M, 2) both cover over the ground that either covers."""
    return float(_pairwise([path_a_m, path_b_m])[0, 1])


def _pairwise(paths: Sequence[Float]) -> Float:
    """`ground_overlap` of all pairs (P, P)."""
    # Here, so that a command that draws no routes does not pay for it.
    from scipy.sparse import csr_array

    points = np.concatenate(paths)
    low, high = points.min(axis=0) - GROUND_HALF_WIDTH_M, points.max(axis=0) + GROUND_HALF_WIDTH_M
    x, y = (np.arange(low[i] + CELL_M / 2, high[i], CELL_M) for i in (0, 1))
    visited = [_visited(x, y, path) for path in paths]
    size = np.array([len(cells) for cells in visited])
    starts = np.concatenate([[0], np.cumsum(size)])
    # a path visits some thousandths of a large building, so the table is kept sparse
    table = csr_array(
        (np.ones(starts[-1]), np.concatenate(visited), starts), shape=(len(paths), len(x) * len(y))
    )
    both = (table @ table.T).toarray()
    return both / (size[:, None] + size - both)


def _visited(x: Float, y: Float, path_m: Float) -> np.ndarray:
    """Cells of a grid, ascending, whose middles lie near a path (N, 2)."""
    visited = []
    reach_m = GROUND_HALF_WIDTH_M + CELL_M
    for start, end in itertools.pairwise(path_m):
        low, high = np.minimum(start, end) - reach_m, np.maximum(start, end) + reach_m
        across = np.arange(*np.searchsorted(x, [low[0], high[0]]))
        along = np.arange(*np.searchsorted(y, [low[1], high[1]]))
        column, row = (index.ravel() for index in np.meshgrid(across, along))
        cells = np.stack([x[column], y[row]], -1)
        near = segment_distance_m(cells, start, end) <= GROUND_HALF_WIDTH_M
        visited.append((row * len(x) + column)[near])
    return np.unique(np.concatenate(visited))
