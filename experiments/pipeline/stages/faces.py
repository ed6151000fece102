"""Stage: meshes and painted textures of the world's walls, once for all robots and processes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.pipeline.stage import Job
from experiments.scenario.seeds import generator
from sim.floorplan import FloorPlan, Wall
from sim.textures import Texture
from sim.world import write_faces

Look = tuple[str, bool]  # look of a wall, and True if the wall is mirrored


@dataclass(frozen=True)
class Walls:
    """Walls as polylines in world metres, all of the same height and thickness."""

    polylines_m: tuple[tuple[tuple[float, float], ...], ...]
    height_m: float
    thickness_m: float

    def floor_plan(self, looks: Sequence[Look] | None = None) -> FloorPlan:
        """Return the simulator's floor plan, with looks if the walls are rendered."""
        lines = [np.array(line) for line in self.polylines_m]
        looks = [("", False)] * len(lines) if looks is None else looks
        size = self.height_m, self.thickness_m
        each = zip(lines, looks, strict=True)
        return FloorPlan(tuple(Wall(line, *size, *look) for line, look in each))


LABEL = "paint the walls"
WRITES = ()


@dataclass(frozen=True)
class FacesSettings:
    """Settings of the painted faces."""

    seed: int
    walls: Walls
    looks: tuple[Look, ...]
    texture: Texture


def run(settings: FacesSettings, job: Job) -> None:
    """Write meshes and textures."""
    rng = generator(settings.seed, "textures")
    plan = settings.walls.floor_plan(settings.looks)
    write_faces(job.output, plan, rng, settings.texture)
