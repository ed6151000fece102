"""Tests of `mapfusion.team.map_message`."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.geometry.numerics import Float
from mapfusion.team.adoption import TimedMap, drift_of_map
from mapfusion.team.map_message import CompactMap, MapMessage
from tests.mapfusion.team.teams_of_points import described_map

LANDMARK_BYTES, POSE_BYTES, SECTORS = 46, 12, 16
NAMES = ["spatial", "planar"]


def ordered(timed: TimedMap) -> TimedMap:
    """Return a map with its landmarks in ascending order of their sources."""
    order = np.argsort(timed.landmarks.source_observation)
    return TimedMap(timed.landmarks[order], timed.last_frame[order], timed.n_frames)


def sent(timed: TimedMap) -> TimedMap:
    return CompactMap.of(timed).timed()


@pytest.mark.parametrize("planar", [False, True], ids=NAMES)
def test_landmarks_arrive_as_they_are(planar: bool) -> None:
    known, found = ordered(described_map(90, planar)), sent(described_map(90, planar))
    was, now = known.landmarks, found.landmarks
    np.testing.assert_array_equal(now.position_m, was.position_m.astype(np.float32))
    for name in ("source_observation", "label", "count"):
        np.testing.assert_array_equal(getattr(now, name), getattr(was, name))
    np.testing.assert_array_equal(found.last_frame, known.last_frame)
    assert found.n_frames == 90
    for name in ("name", "planar", "calibration", "descriptor_kind"):
        assert getattr(now, name) == getattr(was, name)
    assert (np.abs(now.covariance_m2[:, 2]).max() == 0) == planar


def test_descriptors_arrive_within_half_a_step() -> None:
    was, now = ordered(described_map(90)).landmarks.descriptor, sent(described_map(90)).landmarks
    assert was is not None
    assert now.descriptor is not None
    step = np.abs(was).max(axis=1, keepdims=True) / 127
    assert np.all(np.abs(now.descriptor - was) <= 0.501 * step)


def test_a_map_arrives_without_what_it_lacks() -> None:
    """No descriptors, labels or viewing evidence; more observations than 16 bits hold."""
    timed = ordered(described_map(60))
    count = timed.landmarks.count.copy()
    count[0] = 70_000
    bare = {"descriptor": None, "descriptor_kind": None, "label": None, "viewing": None}
    found = sent(replace(timed, landmarks=replace(timed.landmarks, count=count, **bare))).landmarks
    assert all(getattr(found, name) is None for name in bare)
    assert found.count[0] == 65_535
    np.testing.assert_array_equal(found.count[1:], count[1:])


def test_viewing_evidence_arrives() -> None:
    was, now = ordered(described_map(90)).landmarks.viewing, sent(described_map(90)).landmarks
    assert was is not None
    found = now.viewing
    assert found is not None
    np.testing.assert_array_equal(found.pose, was.pose.astype(np.float32))
    np.testing.assert_array_equal(found.n_views, was.n_views)
    np.testing.assert_allclose(found.direction_rad, was.direction_rad, atol=1e-3)
    np.testing.assert_allclose(found.distance_m, was.distance_m, rtol=1e-6)
    np.testing.assert_allclose(found.reach_m, was.reach_m, rtol=5e-4)
    np.testing.assert_array_equal(found.field.height_m, was.field.height_m)


@pytest.mark.parametrize("planar", [False, True], ids=NAMES)
def test_shared_errors_arrive_as_drift(planar: bool) -> None:
    """Covariances are those of drift and remainder of the leading errors, to 16 bits."""
    timed = ordered(described_map(90, planar))
    known = timed.landmarks
    assert known.joint is not None
    leading = known.joint.leading
    drift = drift_of_map(leading, known.position_m, timed.last_frame, [(0, 89)])
    own_m2 = leading.own_m2 + drift.remainder_m2
    moved_m = leading.common_m - drift.remainder_m
    expected = np.einsum("nri,mrj->nimj", moved_m, moved_m)
    each, n = np.arange(len(known)), 2 if planar else 3
    expected[each, :, each, :] += own_m2
    joint = sent(timed).landmarks.joint
    assert joint is not None
    found = joint.dense_m2().reshape(expected.shape)
    sigma_m = np.sqrt(np.einsum("nini->ni", expected))[:, :n]
    bound_m2 = sigma_m[:, :, None, None] * sigma_m
    assert np.all(np.abs(found - expected)[:, :n, :, :n] <= 3e-3 * bound_m2)


def differences_m2(joint_m2: Float, n: int) -> Float:
    """Return the mean square (N, N) of the distance of each pair's errors."""
    products = np.einsum("nimi->nm", joint_m2.reshape(n, 3, n, 3))
    return np.diag(products)[:, None] + np.diag(products) - 2 * products


@pytest.mark.parametrize("planar", [False, True], ids=NAMES)
def test_covariances_stay_about_those_of_the_map(planar: bool) -> None:
    """The drift is close to the shared errors: 2 % on average, of landmarks and of differences."""
    known, found = ordered(described_map(90, planar)).landmarks, sent(described_map(90, planar))
    joint, n = found.landmarks.joint, len(known)
    assert joint is not None
    assert known.joint is not None
    stated, true = (np.trace(each.marginal_m2, axis1=1, axis2=2) for each in (joint, known.joint))
    assert np.mean(stated / true) == pytest.approx(1.0, abs=0.02)
    assert np.min(stated / true) > 0.8
    assert np.max(stated / true) < 1.6
    np.testing.assert_array_equal(found.landmarks.covariance_m2, joint.marginal_m2)
    off = ~np.eye(n, dtype=bool)
    share = (
        differences_m2(joint.dense_m2(), n)[off] / differences_m2(known.joint.dense_m2(), n)[off]
    )
    assert np.median(share) == pytest.approx(1.0, abs=0.02)
    assert share.min() > 0.8
    assert share.max() < 1.6


def sigma_m(compact: CompactMap) -> Float:
    return np.linalg.norm(compact.landmarks["factor_m"].astype(float), axis=1)


def part_of(compact: CompactMap, rows: slice | np.ndarray) -> CompactMap:
    """Return some of the landmarks, with all frames."""
    header, landmarks, descriptor, scale, frames = compact
    return CompactMap(header, landmarks[rows], descriptor[rows], scale[rows], frames)


def assert_same(found: CompactMap, expected: CompactMap) -> None:
    for name in ("landmarks", "descriptor", "scale", "frames"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.header is expected.header


def test_the_first_message_holds_the_whole_map() -> None:
    new = CompactMap.of(described_map(60))
    message = MapMessage.between(None, new, (0, 1))
    assert (message.base, message.version) == (0, 1)
    assert message.is_new.all()
    assert_same(message.applied_to(None), new)


@pytest.mark.parametrize("planar", [False, True], ids=NAMES)
def test_a_message_turns_an_old_map_into_a_new_one(planar: bool) -> None:
    """Some landmarks vanish, some are new; the others stay within half a sigma."""
    old, whole = (CompactMap.of(described_map(n, planar)) for n in (60, 90))
    keeps = np.arange(len(whole.landmarks)) % 9 != 4
    new = part_of(whole, keeps)
    vanished = np.setdiff1d(old.landmarks["source"], new.landmarks["source"])
    arrived = np.setdiff1d(new.landmarks["source"], old.landmarks["source"])
    assert len(vanished) > 2
    assert len(arrived) > 2
    message = MapMessage.between(old, new, (3, 4))
    assert np.count_nonzero(message.is_new) == len(arrived)
    assert 0 < np.count_nonzero(~message.is_new) < len(old.landmarks)
    found = message.applied_to(old)
    np.testing.assert_array_equal(found.landmarks["source"], new.landmarks["source"])
    for name in ("descriptor", "scale"):  # of a landmark they never change
        np.testing.assert_array_equal(getattr(found, name), getattr(new, name))
    for name in ("last_frame", "label"):
        np.testing.assert_array_equal(found.landmarks[name], new.landmarks[name])
    off_m = np.linalg.norm(found.landmarks["position_m"] - new.landmarks["position_m"], axis=1)
    assert np.all(off_m <= 0.5 * sigma_m(new))
    assert np.all(np.abs(sigma_m(found) - sigma_m(new)) <= 0.5 * sigma_m(found))
    assert len(found.frames) == 90
    off = np.abs(found.frames["pose"] - new.frames["pose"])
    assert np.all(off <= [0.02, 0.02, 0.005])
    np.testing.assert_array_equal(found.frames[60:], new.frames[60:])
    assert found.header is new.header


def test_what_moved_is_sent_again() -> None:
    """Half a sigma for landmarks, 2 cm and 0.005 rad for poses."""
    old = CompactMap.of(described_map(60))
    landmarks, frames = old.landmarks.copy(), old.frames.copy()
    by = np.zeros(len(landmarks))
    by[:4] = 0.4, 0.6, 0.4, 0.6
    landmarks["position_m"][:, 0] += by * sigma_m(old)
    landmarks["factor_m"][4] *= 1.4
    landmarks["factor_m"][5] *= 1.6
    frames["pose"][7, 1] += 0.021
    frames["pose"][8, 2] += 0.006
    frames["pose"][9] += 0.004
    message = MapMessage.between(old, old._replace(landmarks=landmarks, frames=frames), (1, 2))
    np.testing.assert_array_equal(message.landmarks, landmarks[[1, 3, 5]])
    assert not message.is_new.any()
    np.testing.assert_array_equal(message.frame, [7, 8])
    found = message.applied_to(old)
    np.testing.assert_array_equal(found.landmarks[[1, 3, 5]], landmarks[[1, 3, 5]])
    rest = np.setdiff1d(np.arange(len(landmarks)), [1, 3, 5])
    np.testing.assert_array_equal(found.landmarks[rest], old.landmarks[rest])


def test_a_message_does_not_change_the_map_that_it_is_applied_to() -> None:
    old, new = CompactMap.of(described_map(60)), CompactMap.of(described_map(90))
    copy = CompactMap(old.header, *(each.copy() for each in old[1:]))
    MapMessage.between(old, new, (1, 2)).applied_to(old)
    assert_same(old, copy)


def test_nothing_new_takes_few_bytes() -> None:
    new = CompactMap.of(described_map(60))
    message = MapMessage.between(new, new, (1, 2))
    assert len(message.landmarks) == len(message.removed) == len(message.frames) == 0
    assert message.n_bytes == new.header.n_bytes + 8
    assert message.n_bytes < 0.1 * MapMessage.between(None, new, (0, 1)).n_bytes
    assert_same(message.applied_to(new), new)


def test_bytes_are_those_of_the_numbers() -> None:
    old, new = CompactMap.of(described_map(60)), CompactMap.of(described_map(90))
    some = part_of(new, slice(3, None))
    message = MapMessage.between(old, some, (1, 2)).with_receipts({"R2": 4, "R3": 5})
    assert new.header.field is not None
    n_knots, _, rank = new.header.by_shared.shape
    header = 4 * (4 + 2 * 8) + 4 * (n_knots - 1) + 2 * 3 * n_knots * rank
    landmarks = LANDMARK_BYTES * len(message.landmarks) + (64 + 4) * message.is_new.sum()
    frames = (4 + POSE_BYTES + 2 * SECTORS) * len(message.frame)
    receipts_and_versions = 4 * (2 + 2)
    assert len(message.removed) == 2  # the third one is new
    assert len(message.frame) >= 30
    expected = header + landmarks + frames + 4 * len(message.removed) + receipts_and_versions
    assert message.n_bytes == expected
