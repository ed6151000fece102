"""One small painted room for all tests of the simulator."""

from pathlib import Path

import numpy as np
import pytest

from sim.floorplan import FloorPlan, Wall
from sim.world import write_faces


@pytest.fixture(scope="session")
def texture_seed() -> int:
    """Seed of the room's textures."""
    return 11


@pytest.fixture(scope="session")
def room() -> FloorPlan:
    """5 x 4 m with a stub of a wall that reaches into it at x = 3."""
    return FloorPlan(
        (
            Wall(np.array([[0, 0], [5, 0], [5, 4], [0, 4], [0, 0]])),
            Wall(np.array([[3, 0], [3, 1.5]])),
        )
    )


@pytest.fixture(scope="session")
def faces(room: FloorPlan, texture_seed: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room's meshes and textures."""
    folder = tmp_path_factory.mktemp("faces")
    write_faces(folder, room, np.random.default_rng(texture_seed))
    return folder
