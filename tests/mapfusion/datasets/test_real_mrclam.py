"""MRCLAM 7 cut to its first minutes, where MAPFUSION_RECORDINGS names the folder that holds it.

Two maps are right in one frame when the landmarks that they share are: T_a_b is held against the
motion between the places where each map's shared landmarks fit the surveyed ones best. The robots'
starts are no measure of that: before the first landmarks are seen twice, a map's own start is off
by up to half a metre and half a radian against all of its landmarks, and nobody merges starts.
"""

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapfusion.align.aligners import make_aligner
from mapfusion.align.correspondences import match
from mapfusion.align.rigid_motion import fit_rigid
from mapfusion.datasets.mrclam import MrclamSettings, import_mrclam
from mapfusion.fastslam.association import Association
from mapfusion.fastslam.filter import FastSlamParameters
from mapfusion.fastslam.mapping import run_log
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import first_frames, read_log, read_truth
from mapfusion.verification.registration import Registration

DATASET = Path(os.environ.get("MAPFUSION_RECORDINGS", "none")) / "MRCLAM_Dataset7"
pytestmark = pytest.mark.skipif(
    not DATASET.is_dir(), reason="MAPFUSION_RECORDINGS has no MRCLAM_Dataset7"
)
# As in scenarios/mrclam7.yaml, but for fewer particles, and the odometry as it was recorded.
FILTER = FastSlamParameters(
    n_particles=100,
    association=Association.LABEL,
    gate_probability=0.9999,
    noise_floor_m=0.2,
    motion=MotionNoise(
        translation_m_per_sqrt_m=0.0856,
        rotation_rad_per_sqrt_m=0.0264,
        rotation_rad_per_sqrt_rad=0.107,
        scale_error=0,
        track_error=0,
        lateral_m_per_sqrt_m=0.0856,
        lateral_slip_m_per_rad=0,
    ),
)
Mapped = tuple[LandmarkMap, Float]  # with the surveyed places (N, 2) of its landmarks


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return import_mrclam(DATASET, tmp_path_factory.mktemp("mrclam"), MrclamSettings())


def mapped(path: Path, cut_s: float) -> Mapped:
    log, truth = read_log(path), read_truth(path)
    part = first_frames(log, int(np.searchsorted(log.time_s - log.time_s[0], cut_s)))
    frames = run_log(part, FILTER, np.random.default_rng(0), [len(part) - 1])
    landmarks = [frame.landmarks for frame in frames][-1]
    assert landmarks is not None
    of_label = (log.observations.label == label for label in names(landmarks))
    return landmarks, np.array([np.nanmedian(truth.point_world_m[o, :2], axis=0) for o in of_label])


def names(landmarks: LandmarkMap) -> np.ndarray:
    assert landmarks.label is not None
    return landmarks.label


def pairs_of(maps: list[Mapped]) -> Iterator[tuple[LandmarkMap, LandmarkMap, Float]]:
    """Two maps with three common landmarks or more, and the motion that is right between them."""
    for (a, world_a), (b, world_b) in itertools.combinations(maps, 2):
        shared, of_a, of_b = np.intersect1d(names(a), names(b), return_indices=True)
        if len(shared) >= 3:
            every = np.arange(len(shared))
            T_world = [
                np.array(fit_rigid(np.ascontiguousarray(world[rows]), p, every))
                for world, p, rows in (
                    (world_a, np.ascontiguousarray(a.position_m[of_a, :2]), of_a),
                    (world_b, np.ascontiguousarray(b.position_m[of_b, :2]), of_b),
                )
            ]
            yield a, b, se2.between(*T_world)


@pytest.mark.parametrize("cut_s", [120.0, 240.0])
def test_every_two_maps_are_accepted_and_right(logs: list[Path], cut_s: float) -> None:
    n = 0
    for a, b, T_true in pairs_of([mapped(path, cut_s) for path in logs]):
        n += 1
        for method in ("ransac", "clique", "gnc"):
            registration = Registration(make_aligner(method))
            done = registration.register(a, b, match(a, b), np.random.default_rng(0))
            assert done.verdict.accepted, (a.name, b.name, method, done.verdict.reason)
            T, p_b = done.refined.T_a_b, b.position_m[np.isin(names(b), names(a)), :2]
            apart = se2.transform_points(T, p_b) - se2.transform_points(T_true, p_b)
            assert np.sqrt(np.mean(np.sum(apart**2, axis=1))) < 0.5, (a.name, b.name, method)
            assert abs(se2.wrap(T[2] - T_true[2])) < 0.1, (a.name, b.name, method)
    assert n == 10


def test_of_landmarks_whose_names_are_mixed_up_none_is_accepted(logs: list[Path]) -> None:
    maps, rng = [mapped(path, 120.0) for path in logs[:3]], np.random.default_rng(1)
    for (a, _), (b, _) in itertools.combinations(maps, 2):
        for _ in range(20):
            position = rng.permutation(b.position_m)
            mixed = LandmarkMap(**{**vars(b), "position_m": position})
            done = Registration(make_aligner("ransac")).register(a, mixed, match(a, mixed), rng)
            assert not done.verdict.accepted
