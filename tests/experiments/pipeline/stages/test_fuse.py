"""Tests of `experiments.pipeline.stages.fuse`."""

from pathlib import Path

import numpy as np
import pytest

from experiments.pipeline.stages.fuse import fused_map_files, read_fusions, write_fusions
from mapfusion.fusion.fusers import FUSERS, MergeParameters, make_fuser
from mapfusion.fusion.merge import merge
from mapfusion.landmark_map import read_map
from tests.mapfusion.fusion.drawn_maps import DrawnTeam

NAMES = ("R1", "R2", "R3", "R4")
# the first and the third share landmarks, and so do the other two
PARTS = [slice(0, 40), slice(60, 100), slice(20, 60), slice(70, 120)]


def test_a_map_without_landmarks_is_read_again(tmp_path: Path) -> None:
    team = DrawnTeam(PARTS[:2], 0)
    nothing = merge([own[:0] for own in team.maps], []).fused
    something = merge(team.maps, []).fused
    write_fusions(tmp_path, {3: something, 7: nothing}, NAMES[:2])
    found = read_fusions(tmp_path, NAMES[:2])
    assert {k: len(each.landmarks) for k, each in found.items()} == {3: 40, 7: 0}


@pytest.mark.parametrize("fuser", FUSERS)
def test_what_is_written_is_read_again(fuser: str, tmp_path: Path) -> None:
    team = DrawnTeam(PARTS, 0)
    fused = merge(team.maps, team.pairs, MergeParameters(), make_fuser(fuser)).fused
    assert [each.members.tolist() for each in fused] == [[0, 2], [1, 3]]
    alone = merge(team.maps, [], MergeParameters(), make_fuser(fuser)).fused
    write_fusions(tmp_path, {3: alone, 7: fused}, NAMES)
    found = read_fusions(tmp_path, NAMES)
    assert list(found) == [3, 7]
    for read, one in ((found[3], alone[0]), (found[7], fused[0])):
        np.testing.assert_array_equal(read.parents, one.parents)
        np.testing.assert_array_equal(read.members, one.members)
        np.testing.assert_array_equal(read.T_first_map, one.T_first_map)
        np.testing.assert_array_equal(read.drift_sigma_m, one.drift_sigma_m)
        symmetric = (one.motion_covariance + np.swapaxes(one.motion_covariance, 1, 2)) / 2
        np.testing.assert_allclose(read.motion_covariance, symmetric, rtol=1e-9, atol=1e-15)
        assert (read.duplicate_share, read.fallback) == (one.duplicate_share, one.fallback)
        own = one.landmarks
        np.testing.assert_array_equal(read.landmarks.position_m, own.position_m)
        np.testing.assert_array_equal(read.landmarks.count, own.count)
        # only the upper half of a covariance is stored
        np.testing.assert_allclose(read.landmarks.covariance_m2, own.covariance_m2, atol=1e-15)
    assert found[3].landmarks.joint is None  # kept for the last alone
    assert (found[7].landmarks.joint is None) == (fused[0].landmarks.joint is None)
    files = fused_map_files(tmp_path)
    assert [len(read_map(each)) for each in files] == [len(e.landmarks) for e in fused]
