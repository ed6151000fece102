"""Stage: the world's walls, painted once for all robots and processes."""

from dataclasses import dataclass

from experiments.pipeline.stage import Job
from experiments.pipeline.stages.walls import Look, Walls
from experiments.scenario.seeds import generator
from sim.textures import Texture
from sim.world import write_faces

LABEL = "paint the walls"
WRITES = ()


@dataclass(frozen=True)
class FacesSettings:
    """All that the painted walls depend on."""

    seed: int
    walls: Walls
    looks: tuple[Look, ...]
    texture: Texture


def run(settings: FacesSettings, job: Job) -> None:
    """Write meshes and pictures."""
    rng = generator(settings.seed, "textures")
    plan = settings.walls.floor_plan(settings.looks)
    write_faces(job.output, plan, rng, settings.texture)
