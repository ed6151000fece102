"""Two traverses of LunarLoc, where MAPFUSION_LUNARLOC names the folder that holds them."""

import numpy as np
import pytest

from tests.benchmarks.lunarloc import VARIABLE, clustered, is_right, moved, registered, traverses
from tests.mapfusion.align.made_fields import mirrored

pytestmark = pytest.mark.skipif(len(traverses()) < 3, reason=f"{VARIABLE} has no traverses")


def test_traverses_are_aligned_and_their_mirror_images_are_not():
    first, *others = [clustered(path) for path in traverses()[:3]]
    rng = np.random.default_rng(0)
    for other in others:
        own, T = moved(other, rng)
        done = registered(first, own)
        assert done.verdict.accepted
        assert is_right(done.refined.T_a_b, T)
        assert not registered(first, mirrored(own)).verdict.accepted
