"""Generated worlds: a scenario's `generate` section becomes `world` and `robots` at load time."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from experiments.scenario.randomness import generator
from sim.plan_generator import PlanParameters
from sim.route_planner import GeneratedWorld, RouteParameters, generate_world

Range = tuple[float, float]
_PLAN = PlanParameters()
_ROUTES = RouteParameters()


class Generate(BaseModel):
    """A floor plan and routes drawn from a seed; see `sim.plan_generator`, `sim.route_planner`.

    The scenario's seed also draws the plan, unless `plan_seed` is given. `world` holds whatever of
    the world is not drawn (heights, textures).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    plan_seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    robots: int = _ROUTES.robots
    overlap: float = _ROUTES.overlap
    loop_m: Range = _ROUTES.loop_m
    rooms_a_side: int = _PLAN.rooms_a_side
    doors_a_room: int = _PLAN.doors_a_room
    room_width_m: Range = _PLAN.room_width_m
    room_depth_m: Range = _PLAN.room_depth_m
    corridor_m: float = _PLAN.corridor_m
    door_m: float = _PLAN.door_m
    world: dict[str, Any] = {}

    @model_validator(mode="after")
    def _drawable(self) -> "Generate":
        self.plan_parameters()  # both raise a ValueError that names the field
        self.route_parameters()
        if "walls" in self.world:
            raise ValueError("world.walls: are drawn; give world and robots instead of generate")
        return self

    def plan_parameters(self) -> PlanParameters:
        """Sizes of the rooms."""
        return PlanParameters(
            self.rooms_a_side,
            self.doors_a_room,
            self.room_width_m,
            self.room_depth_m,
            self.corridor_m,
            self.door_m,
        )

    def route_parameters(self) -> RouteParameters:
        """Loops and their overlap."""
        return RouteParameters(self.robots, self.overlap, self.loop_m)


class Generated(BaseModel):
    """Where a generated world came from; written by the program, read by nobody but people.

    `overlap` is the one achieved: ground that two robots both visit over the ground that either
    visits, mean over pairs.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    plan_seed: int
    overlap_asked: float
    overlap: float


def expanded(settings: Generate, seed: int) -> dict[str, Any]:
    """The scenario keys that a `generate` section stands for; raises InputError."""
    plan_seed = seed if settings.plan_seed is None else settings.plan_seed
    made = generate_world(
        settings.plan_parameters(), settings.route_parameters(), generator(plan_seed, "plan")
    )
    return {
        "world": {**settings.world, "walls": [{"points": w.tolist()} for w in made.plan.walls_m]},
        "robots": _robots(made),
        "generated": {
            "plan_seed": plan_seed,
            "overlap_asked": settings.overlap,
            "overlap": round(made.overlap, 4),
        },
    }


def _robots(made: GeneratedWorld) -> list[dict[str, Any]]:
    return [
        {
            "name": f"R{number}",
            "start": route.T_world_start.tolist(),
            "route": route.waypoints_m.tolist(),
        }
        for number, route in enumerate(made.routes, start=1)
    ]
