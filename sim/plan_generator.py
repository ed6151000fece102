"""Floor plans from a seed: wings of rooms on both sides of a corridor, joined by doors.

A wing is cut from the west end of the corridor to its east end into rooms, north and south. Every
room has one or two doors to the corridor and one to each neighbour in its row; the doors between
neighbours stand in line (an enfilade), so a row can be driven through straight. Wings have no door
to each other and are closed all around: from one, nothing of another is ever seen.
"""

import itertools
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.arguments import Range, require_in_range
from mapfusion.errors import InputError
from mapfusion.se2 import Float
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
