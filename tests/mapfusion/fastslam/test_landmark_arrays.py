"""A landmark is less certain than the point of a track, from the frame in which the track ends."""

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam
from mapfusion.fastslam.landmark_arrays import FREE, ActiveTracks
from mapfusion.fastslam.measurement import DROPPED, NEW, observations_in_map
from mapfusion.fastslam.particles import ParticleMaps
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import EXACT_MOTION, nothing, parameters

NOISE_M2 = 1e-4
STRAY_M = 0.02


def frame(tracks: list[int] | None, labels: tuple[int, ...] = (0, 1)) -> Observations:
    """Return observations of two landmarks with these tracks."""
    at = np.array([[2.0, 0.5, 0.1], [3.0, -0.5, 0.2]])[list(labels)]
    return Observations(
        at,
        np.tile(NOISE_M2 * np.eye(3), (len(at), 1, 1)),
        label=np.array(labels, dtype=np.int32),
        track=None if tracks is None else np.array(tracks, dtype=np.int32),
    )


def variances(frames: list[Observations], particles: int = 1) -> np.ndarray:
    """Return the variances (2,) of the two landmarks, equal for all axes, after these frames."""
    settings = parameters(
        n_particles=particles, motion=EXACT_MOTION, association="label", stray_m=STRAY_M
    )
    slam = FastSlam(settings, np.random.default_rng(0))
    for each in frames:
        slam.step(np.zeros(3), each)
    landmarks = slam.best_map(min_count=1)
    diagonal = np.diagonal(landmarks.covariance_m2, axis1=1, axis2=2)
    np.testing.assert_allclose(diagonal, diagonal[:, :1] * np.ones(3), rtol=1e-9)
    return diagonal[np.argsort(landmarks.label), 0]


def after(*counts: int) -> float:
    """Return the variance of a Kalman filter after tracks of these lengths."""
    information = 0.0
    for k, count in enumerate(counts):
        if k:
            information = 1 / (1 / information + 2 * STRAY_M**2)
        information += count / NOISE_M2
    return 1 / information


@pytest.mark.parametrize("particles", [1, 30])
def test_each_track_s_end_widens_its_landmark_once(particles: int) -> None:
    once = [frame([3, 4]), nothing()]
    np.testing.assert_allclose(variances(once, particles), after(1) + 2 * STRAY_M**2)
    frames = [frame([5, 6])] * 4
    np.testing.assert_allclose(variances(frames, particles), after(4))
    frames += [frame([7], (0,))] * 3  # 5 and 6 have ended; the second landmark is out of view
    widened = after(4) + 2 * STRAY_M**2
    np.testing.assert_allclose(variances(frames, particles), [after(4, 3), widened])
    frames += [frame([7, 9])] * 2
    np.testing.assert_allclose(variances(frames, particles), [after(4, 5), after(4, 2)])
    frames += [nothing()] * 2
    ended = np.array([after(4, 5), after(4, 2)]) + 2 * STRAY_M**2
    np.testing.assert_allclose(variances(frames, particles), ended)


def test_observations_without_tracks_are_each_news_of_the_landmark() -> None:
    np.testing.assert_allclose(variances([frame(None)] * 4 + [nothing()]), after(4))


@pytest.mark.parametrize("sigma_m", [1e-4, 0.01, 1.0])
@pytest.mark.parametrize("tracks", [(3, 4), None])
def test_the_density_has_no_step_at_the_gate(
    sigma_m: float, tracks: tuple[int, int] | None
) -> None:
    """A match inside the gate is at least as likely as a new landmark, for any noise."""
    settings = parameters(
        n_particles=1, motion=EXACT_MOTION, association="gate", stray_m=STRAY_M, planar=False
    )

    def seen(x_m: float, k: int) -> Observations:
        at = np.array([[2.0 + x_m, 0.5, 0.1]])
        covariance = sigma_m**2 * np.eye(3)[None]
        track = None if tracks is None else np.array([tracks[k]], dtype=np.int32)
        return Observations(at, covariance, track=track)

    def log_evidence(distance: float) -> float:
        """Return the log evidence of a second observation at this distance in sigmas."""
        stray_m = 0.0 if tracks is None else STRAY_M
        slam = FastSlam(settings, np.random.default_rng(0))
        slam.step(np.zeros(3), seen(0.0, 0))
        slam.step(np.zeros(3), nothing())
        x_m = distance * np.sqrt(2 * sigma_m**2 + 2 * stray_m**2)
        return slam.step(np.zeros(3), seen(x_m, 1)).log_evidence

    inside, outside = 0.999 * np.sqrt(settings.gate), 1.001 * np.sqrt(settings.gate)
    assert log_evidence(inside) == pytest.approx(log_evidence(outside), abs=0.002 * settings.gate)
    assert log_evidence(0.0) == pytest.approx(log_evidence(outside) + settings.gate / 2)


def test_the_end_of_a_track_leaves_alone_what_no_particle_has_any_more() -> None:
    """The row of a freed landmark may belong to another landmark by then."""
    seen = frame([3, 4])
    maps, tracked = ParticleMaps(2, 9.0), ActiveTracks()
    places = observations_in_map(
        np.zeros((2, 3)), seen.position_m, seen.covariance_m2, planar=False
    )
    chosen = np.array([[NEW, NEW], [DROPPED, NEW]])  # the second particle alone has the second
    slots, rows = maps.create(chosen, places, seen, 0)
    tracked.update(seen.track, chosen, np.stack([rows, slots], axis=1), maps.slots)
    maps.resample(np.zeros(2, dtype=np.int32))
    maps.bring_up_to_date(slots[maps.slots.generation[slots] != FREE])
    assert maps.slots.generation[slots[1]] == FREE
    assert tracked.slots_of_ended_tracks(None, maps.slots).tolist() == [slots[0]]
