"""Loops through a generated plan, and the ground they have in common.

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

from mapfusion.arguments import Range, require_in_range
from mapfusion.errors import InputError, OutOfRangeError
from mapfusion.se2 import Float
from sim.floorplan import segment_distance_m
from sim.plan_generator import GeneratedPlan, PlanParameters, Wing, generate_plan

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
