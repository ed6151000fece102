"""Rows of a log, ordered by landmark and track."""

from dataclasses import replace

import numpy as np

from mapfusion.smoother.normal_equations import known_dimensions
from mapfusion.smoother.problem import Sightings, sightings_of
from tests.mapfusion.smoother.white_noise_logs import white_noise_log, with_tracks


def tracked_sightings(*, stray: bool = True) -> tuple[Sightings, np.ndarray, np.ndarray]:
    """Those of a log whose every second track is of two landmarks; label and track by row."""
    rng = np.random.default_rng(2)
    log = with_tracks(white_noise_log(rng, 40, 30), rng, 0.0).log
    seen = log.observations
    assert seen.label is not None
    assert seen.track is not None
    seen = replace(seen, track=np.where(seen.track < 0, -1, seen.track // 2).astype(np.int32))
    assert seen.label is not None
    assert seen.track is not None
    made = sightings_of(replace(log, observations=seen), seen.label, 2, stray=stray)
    return made, seen.label[made.row], seen.track[made.row]


def test_every_track_of_a_landmark_is_a_run_of_rows() -> None:
    seen, label, track = tracked_sightings()
    pairs = np.stack([label, track], 1)
    begins = np.any(np.diff(pairs, axis=0, prepend=-9) != 0, axis=1)
    np.testing.assert_array_equal(seen.track_starts, np.append(np.flatnonzero(begins), len(label)))
    assert len(np.unique(pairs, axis=0)) == len(seen.strays)
    np.testing.assert_array_equal(seen.strays[seen.track], track >= 0)
    assert 0 < np.sum(~seen.strays) < len(seen.strays)
    np.testing.assert_array_equal(seen.landmark_of_track[seen.track], seen.landmark)
    ones = seen.sum_tracks(np.diff(seen.track_starts).astype(float))
    np.testing.assert_array_equal(ones, np.diff(seen.starts))


def test_without_strays_a_landmark_has_one_track() -> None:
    seen, _, _ = tracked_sightings(stray=False)
    np.testing.assert_array_equal(seen.track_starts, seen.starts)
    assert not seen.strays.any()


def test_an_offset_is_known_where_its_covariance_has_shrunk() -> None:
    seen, _, _ = tracked_sightings()
    n = len(seen.strays)
    information = np.full(n, 4.0)
    for share, known in ((1.0, 0.0), (0.5, 1.5), (0.0, 3.0)):
        covariance = np.broadcast_to(share / 4 * np.eye(3), (n, 3, 3))
        np.testing.assert_allclose(known_dimensions(seen, covariance, information), known)
