import numpy as np

from mapfusion.fastslam.particles import ParticleMaps
from mapfusion.fastslam.sensor import sightings
from mapfusion.fastslam.slots import NEVER
from mapfusion.fastslam.update import DROPPED, NEW
from mapfusion.robot_log import Observations


def test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot():
    rng = np.random.default_rng(0)
    n, sigma_m, gate = 400, 0.1, 9.0  # more than there is room for at first
    observations = Observations(
        rng.uniform(-20, 20, (n, 3)), np.tile(sigma_m**2 * np.eye(3), (n, 1, 1))
    )
    seen = sightings(
        np.zeros((2, 3)), observations.position_m, observations.covariance_m2, planar=False
    )
    chosen = np.full((n, 2), NEW)
    chosen[2::3, 0] = DROPPED  # the second particle alone has these, the sixth landmark among them
    maps = ParticleMaps(2, gate)
    slots, rows = maps.create(chosen, seen, observations, 0)
    assert rows.tolist() == list(range(n))

    def assert_found(held: np.ndarray) -> None:
        reach_m = sigma_m * np.sqrt(gate)
        low, high = (observations.position_m[:, :2] + side * reach_m for side in (-1, 1))
        for _ in range(50):
            corner = rng.uniform(-25, 25, 2)
            box = np.concatenate([corner, corner + 10.0 ** rng.uniform(-3, 1.5, 2)])
            touches = np.all((low <= box[2:]) & (high >= box[:2]), axis=1)
            assert maps.near(box).tolist() == sorted(slots[touches & held].tolist())

    assert_found(np.ones(n, dtype=bool))
    maps.resampled(np.array([0, 0], dtype=np.int32))
    maps.bring_up_to_date(slots[maps.slots.generation[slots] != NEVER])  # some were visited
    left = np.arange(n) % 3 != 2
    assert maps.n_slots == left.sum()
    assert_found(left)


def test_without_landmarks_nothing_is_near():
    assert len(ParticleMaps(2, 9.0).near(np.array([-1.0, -1, 1, 1]))) == 0
