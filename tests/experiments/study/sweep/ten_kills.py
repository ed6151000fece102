"""Ten random kills of workers and of the whole sweep lose nothing and change nothing.

Takes minutes, so `make endurance` runs it, not `make test`.
"""

import os
import random
from pathlib import Path

import pytest

from tests.helpers.killing import KilledSweep, Victim, same_files

KILLS = 10
GRID = ("--seeds", "0..3", "--set", "slam.filter.n_particles=10,20")


@pytest.mark.parametrize("seed", [int(os.environ.get("MAPFUSION_KILLS_SEED", "0"))])
def test_ten_random_kills(tiny_path: Path, tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    with KilledSweep((tiny_path, *GRID), tmp_path / "undisturbed") as undisturbed:
        assert undisturbed.finish()[0] == 0
    kinds: list[Victim] = ["worker", "everything"]
    victims = [rng.choice(kinds) for _ in range(KILLS)]
    with KilledSweep((tiny_path, *GRID), tmp_path / "disturbed") as disturbed:
        killed = disturbed.kill_at_random(rng, victims)
        assert disturbed.finish()[0] == 0
    assert len(killed) == KILLS, f"the sweep ended after {len(killed)} kills: {killed}"
    sweeps = (tmp_path / folder / "sweeps" / "tiny" for folder in ("undisturbed", "disturbed"))
    compared = same_files(*sweeps)
    print(f"killed: {', '.join(killed)}; {len(compared)} files are the same")  # noqa: T201
