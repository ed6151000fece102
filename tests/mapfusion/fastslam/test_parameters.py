"""The gate's bounds, against values from a table of the chi-square distribution."""

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam, FastSlamParameters
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import EXACT_MOTION, parameters, unit

# Quantiles by probability: 2 and 3 degrees of freedom.
TABLE = {0.95: (5.991, 7.815), 0.99: (9.210, 11.345), 0.9999: (18.421, 21.108)}


@pytest.mark.parametrize("probability", TABLE)
@pytest.mark.parametrize("planar", [True, False, None])
def test_gate_is_the_quantile_of_the_table(probability: float, planar: bool | None) -> None:
    found = FastSlamParameters(gate_probability=probability, planar=planar).gate
    assert found == pytest.approx(TABLE[probability][0 if planar else 1], abs=1e-3)


@pytest.mark.parametrize("planar", [True, False])
def test_the_filter_keeps_to_it(planar: bool) -> None:
    """A landmark and an observation of 0.1 m each differ by 0.14 m, times the bound's root."""
    sigma_m, bound = 0.1, TABLE[0.99][0 if planar else 1]
    settings = parameters(n_particles=2, motion=EXACT_MOTION, gate_probability=0.99, planar=planar)
    descriptor = unit(np.ones((1, 64))).astype(np.float32)
    for share, n_expected in ((0.999, 1), (1.001, 2)):
        slam = FastSlam(settings, np.random.default_rng(0))
        for apart_m in (0.0, share * np.sqrt(2 * bound) * sigma_m):
            point = np.array([[5.0, 2.0 + apart_m, 0.0]])
            slam.step(np.zeros(3), Observations(point, sigma_m**2 * np.eye(3)[None], descriptor))
        assert len(slam.best_map(min_count=1)) == n_expected
