"""Generated worlds: a scenario's `generate` section becomes `world` and `robots` at load time."""

from dataclasses import field
from typing import Annotated, Any

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from experiments.scenario.randomness import generator
from mapfusion.arguments import Range
from sim.plan_generator import PlanParameters
from sim.route_planner import RouteParameters, generate_world


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Generate(RouteParameters, PlanParameters):
    """A floor plan and routes drawn from a seed.

    Attributes:
        plan_seed: draws the plan; None: the scenario's seed does.
        world: whatever of the world is not drawn (heights, textures).
    """

    plan_seed: Annotated[int, Range(0, 2**32 - 1, "1")] | None = None
    world: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        PlanParameters.__post_init__(self)
        RouteParameters.__post_init__(self)
        if "walls" in self.world:
            raise ValueError("world.walls: are drawn; give world and robots instead of generate")


def expanded(settings: Generate, seed: int) -> dict[str, Any]:
    """The scenario keys that a `generate` section stands for; raises InputError."""
    plan_seed = seed if settings.plan_seed is None else settings.plan_seed
    made = generate_world(settings, settings, generator(plan_seed, "plan"))
    robots = [
        {"name": f"R{i}", "start": own.T_world_start.tolist(), "route": own.waypoints_m.tolist()}
        for i, own in enumerate(made.routes, start=1)
    ]
    return {
        "world": {**settings.world, "walls": [{"points": w.tolist()} for w in made.plan.walls_m]},
        "robots": robots,
        "generated": {
            "plan_seed": plan_seed,
            "overlap_asked": settings.overlap,
            "overlap": round(made.overlap, 4),
        },
    }
