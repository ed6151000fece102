"""Rows of a log, ordered by landmark and track."""

from dataclasses import replace

import numpy as np

from mapfusion.smoother.normal_equations import determined_dimensions
from mapfusion.smoother.problem import OrderedObservations, order_observations
from tests.mapfusion.smoother.white_noise_logs import white_noise_log, with_tracks


def tracked_sightings(
    *, with_offsets: bool = True
) -> tuple[OrderedObservations, np.ndarray, np.ndarray]:
    """Return observations, labels and tracks of a log; every second track has two landmarks."""
    rng = np.random.default_rng(2)
    log = with_tracks(white_noise_log(rng, 40, 30), rng, 0.0).log
    obs = log.observations
    assert obs.label is not None
    assert obs.track is not None
    obs = replace(obs, track=np.where(obs.track < 0, -1, obs.track // 2).astype(np.int32))
    assert obs.label is not None
    assert obs.track is not None
    made = order_observations(
        replace(log, observations=obs), obs.label, 2, with_offsets=with_offsets
    )
    return made, obs.label[made.row], obs.track[made.row]


def test_every_track_of_a_landmark_is_a_run_of_rows() -> None:
    obs, label, track = tracked_sightings()
    pairs = np.stack([label, track], 1)
    begins = np.any(np.diff(pairs, axis=0, prepend=-9) != 0, axis=1)
    np.testing.assert_array_equal(obs.track_starts, np.append(np.flatnonzero(begins), len(label)))
    assert len(np.unique(pairs, axis=0)) == len(obs.has_offset)
    np.testing.assert_array_equal(obs.has_offset[obs.track], track >= 0)
    assert 0 < np.sum(~obs.has_offset) < len(obs.has_offset)
    np.testing.assert_array_equal(obs.landmark_of_track[obs.track], obs.landmark)
    ones = obs.sum_tracks(np.diff(obs.track_starts).astype(float))
    np.testing.assert_array_equal(ones, np.diff(obs.starts))


def test_without_strays_a_landmark_has_one_track() -> None:
    obs, _, _ = tracked_sightings(with_offsets=False)
    np.testing.assert_array_equal(obs.track_starts, obs.starts)
    assert not obs.has_offset.any()


def test_an_offset_is_known_where_its_covariance_has_shrunk() -> None:
    obs, _, _ = tracked_sightings()
    n = len(obs.has_offset)
    information = np.full(n, 4.0)
    for share, known in ((1.0, 0.0), (0.5, 1.5), (0.0, 3.0)):
        covariance = np.broadcast_to(share / 4 * np.eye(3), (n, 3, 3))
        np.testing.assert_allclose(determined_dimensions(obs, covariance, information), known)
