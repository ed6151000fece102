"""All kernels, called in this process on small arrays."""

import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from mapfusion.align.aligners import ALIGNERS, make_aligner
from mapfusion.align.clique import full_set, larger_clique
from mapfusion.align.correspondences import match
from mapfusion.camera import StereoCamera
from mapfusion.geometry.se3 import in_space
from mapfusion.smoother.smooth import condensed_points
from mapfusion.verification.registration import Registration
from mapfusion.vision.disparity_tests import window_statistics
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters
from mapfusion.vision.harris import HarrisParameters
from mapfusion.vision.stereo_noise import estimate_noise
from mapfusion.vision.tracking import Tracker, TrackParameters
from sim.floorplan import FloorPlan, Wall
from sim.rendering.ray_caster import RayCaster
from sim.stereo_head import RadiometricNoise, depth_at, expose
from sim.world import write_faces
from tests.experiments.studies.test_refusal_trial import (
    test_calibration_counts_every_motion_of_two_pairs,
)
from tests.mapfusion.align.made_fields import made_field
from tests.mapfusion.align.map_pairs import given_pairs
from tests.mapfusion.align.test_clique import on_bits, random_graph
from tests.mapfusion.align.test_correspondences import two_maps
from tests.mapfusion.align.test_nearest_neighbours import (
    test_each_box_holds_its_points_and_halves_those_of_the_one_above,
    test_finds_what_looking_at_all_finds,
)
from tests.mapfusion.fastslam.test_filter_twin import test_equals_the_filter_that_copies
from tests.mapfusion.fastslam.test_landmark_arrays import (
    test_each_track_s_end_widens_its_landmark_once,
)
from tests.mapfusion.fastslam.test_loop_closing import (
    test_evidence_is_the_slope_of_the_likelihood_at_the_pose_in_view,
    test_landmarks_of_all_particles_move_and_are_found_where_they_are_now,
)
from tests.mapfusion.fastslam.test_particles import (
    test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot,
    test_without_landmarks_nothing_is_near,
)
from tests.mapfusion.geometry.test_joint_covariance import (
    test_all_directions_kept_are_the_dense_covariance,
)
from tests.mapfusion.smoother.test_odometry_calibration import (
    test_the_posterior_equals_dense_algebra,
)
from tests.mapfusion.smoother.test_smooth import smoothed
from tests.mapfusion.smoother.white_noise_logs import white_noise_log, with_tracks
from tests.mapfusion.verification.test_verdict import (
    test_a_picture_that_hangs_twice_leaves_two_places,
    test_what_was_found_before_gives_the_same_verdict,
)
from tests.mapfusion.vision.rendered_scene import render, wall


def filter_steps() -> None:
    """Particles that have less than a handful of landmarks, and so of slots for them."""
    for ways in product(["gate", "descriptor", "label"], [True, False], ["informed", "motion"]):
        association, planar, proposal = ways
        test_equals_the_filter_that_copies(association, planar, 0.5, proposal)
    for flag in (True, False):
        test_evidence_is_the_slope_of_the_likelihood_at_the_pose_in_view(planar=flag)
        test_landmarks_of_all_particles_move_and_are_found_where_they_are_now(settled=flag)
    test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot()
    test_without_landmarks_nothing_is_near()
    test_each_track_s_end_widens_its_landmark_once(particles=3)


def smoothers() -> None:
    """More landmarks than poses and fewer, with tracks."""
    for n_frames, n_landmarks, planar in ((12, 30, False), (40, 5, True)):
        rng = np.random.default_rng(3)
        known = with_tracks(white_noise_log(rng, n_frames, n_landmarks, planar), rng, 0.05)
        condensed_points(smoothed(known.log), rank=5)
    for n_frames, n_landmarks in ((30, 12), (15, 60)):
        test_the_posterior_equals_dense_algebra(n_frames, n_landmarks)
    test_all_directions_kept_are_the_dense_covariance()


def alignments() -> None:
    """Every method of ours, its refinement and its judgement, on a few pairs."""
    for name, planar in product(ALIGNERS, [False, True]):
        pair = given_pairs(np.random.default_rng(0), 30, 0.6, 0.02, planar=planar)
        map_a, map_b = (
            replace(landmarks, covariance_m2=landmarks.covariance_m2 + 1e-4 * np.eye(3))
            for landmarks in (pair.map_a, pair.map_b)
        )
        of = Registration(make_aligner(name)).on(map_a, map_b, pair.correspondences)
        of.register(np.random.default_rng(1))
    first, second, _ = two_maps(np.random.default_rng(0), 40)
    match(first, second)
    field = made_field(np.random.default_rng(1), 12, 8, sizes=True)
    match(field.map_a, field.map_b)
    test_each_box_holds_its_points_and_halves_those_of_the_one_above("spread")
    test_finds_what_looking_at_all_finds("spread", "with others", 75)
    test_what_was_found_before_gives_the_same_verdict()
    test_a_picture_that_hangs_twice_leaves_two_places()
    larger_clique(on_bits(random_graph(0, 130, 0.3)), full_set(130), 0, 1000)
    test_calibration_counts_every_motion_of_two_pairs()


def pictures(folder: Path) -> None:
    """A wall that ends in the picture, a robot before it, and one that reaches the lens."""
    corner = Wall(np.array([[2, -1], [2, 0.5], [3, 0.5]]))
    write_faces(folder, FloorPlan((corner,)), np.random.default_rng(0))
    others = np.array([[1.4, 0.0, 0.5], [0.4, 0.3, 1.0]])
    camera = StereoCamera(160, 120, 144.0)
    depth_m = RayCaster(folder, camera).depth_m(np.zeros(3), 0.0, others)
    depth_at(depth_m, np.array([[-1.0, -1.0], [200.0, 200.0], [80.5, 60.5]]))
    RayCaster(folder, camera).depth_m(in_space(np.zeros(3), [0.1, -0.1]), 0.0, others)
    for sampling in ("footprint", "middle"):
        picture = RayCaster(folder, camera, sampling).grey(np.zeros(3), 0.0, others)
        expose(picture, RadiometricNoise(), np.random.default_rng(0))


def front_end() -> None:
    """Corners all over a small picture, followed into the next one, and the picture's own."""
    camera, rng = StereoCamera(80, 60, 72.0), np.random.default_rng(0)
    room = [wall(rng, (1.6, 2.0), (1.4, -2.0))]
    few = replace(FrontEndParameters(), harris=HarrisParameters(max_corners=20))
    off_rows = replace(few, stereo=replace(few.stereo, row_sigma_px=0.5))
    tracker = Tracker(TrackParameters(), camera, 0.1)
    for t in range(3):
        left, right, _ = render(room, camera, (0.02 * t, 0.0, 0.0), 1.0, rng)
        tracker.update(FrontEnd(camera, off_rows).extract(left, right))
        estimate_noise([(left, right)], camera, few.harris, few.stereo)
        ends = np.array([[0, 0], [79, 0], [0, 59], [79, 59]])
        window_statistics(left, right, ends, np.tile([2.5, 0.1, -0.1], (4, 1)), 8, 6)


def call_all() -> None:
    """All of the above."""
    filter_steps()
    smoothers()
    alignments()
    front_end()
    with tempfile.TemporaryDirectory() as folder:
        pictures(Path(folder))
