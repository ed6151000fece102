"""Stage: stereo images of one robot are rendered and their features extracted, frame by frame.

Frames are independent, so chunks of frames are computed in parallel. Images of a few frames only
are stored (for figure 1).
"""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pyarrow as pa

from experiments.pipeline.stage import Job, StageKind
from mapfusion.camera import StereoCamera
from mapfusion.descriptors import USURF, kind_from, pack_bits, stated_metric, unpack_bits
from mapfusion.files import (
    POSITION_FIELDS,
    column,
    columns,
    float_fields,
    named_columns,
    read_parquet,
    read_table,
    require_kind,
    schema,
    text_attributes,
    write_atomically,
    write_table,
)
from mapfusion.geometry.numerics import Float, generator, with_rows
from mapfusion.vision.front_end import FrontEnd, FrontEndParameters
from mapfusion.vision.tracking import PATCH_SIDE_PX, Features
from sim.renderer import Renderer
from sim.rendering.frame_source import FrameSource, truth_behind
from sim.stereo_head import RadiometricNoise, StereoFrame
from sim.trajectory import TRAJECTORY_FILE, read_trajectory

# Frames per task: about two seconds of work, so an interrupted run loses little.
FRAMES_PER_CHUNK = 20

_PIXEL = ["u_px", "v_px"]
_ONE_EACH = ["disparity_px", "sigma_disparity_px"]
_SLOPE = ["disparity_per_u", "disparity_per_v"]
_NUMBER = np.dtype("<f4")  # number of a descriptor
FEATURES = schema(
    "features",
    4,
    [
        pa.field("iteration", pa.int32()),
        *float_fields([*_PIXEL, "disparity_px", "sigma_disparity_px", *_SLOPE]),
        # as bytes, because lists are written and read number by number
        # (the length is that of U-SURF; other descriptors have another one)
        pa.field("descriptor", pa.binary(_NUMBER.itemsize * USURF.length)),
        pa.field("patch", pa.binary(PATCH_SIDE_PX**2)),
    ],
)
# Row i holds the true world point of row i of the features, and its derivative by the pixel. The
# truth is a separate file, because estimators never read it.
_POINT_SLOPE = [f"{name}_per_{axis}" for name in POSITION_FIELDS for axis in "uv"]
TRUTH = schema("features.truth", 2, float_fields([*POSITION_FIELDS, *_POINT_SLOPE]))

WRITES = ("truth_{part}.parquet", "features_{part}.parquet")


@dataclass(frozen=True)
class FeatureSettings:
    """Settings of a robot's features, in addition to trajectory and walls."""

    seed: int
    robot: str
    camera: StereoCamera
    radiometry: RadiometricNoise
    renderer: Renderer
    drawn_by: str  # name and version of the renderer on this machine
    vision: FrontEndParameters  # corners, stereo and descriptors; the rest has default values
    origin: str  # code of a plug-in that describes the corners; empty for ours
    images_at: int
    images: int


def chunks(n_frames: int) -> tuple[str, ...]:
    """Return the parts of the stage, named after their first frame."""
    return tuple(f"{start:06d}" for start in range(0, n_frames, FRAMES_PER_CHUNK))


def _chunk(part: str, n_frames: int) -> range:
    """Return the frames of a part."""
    return range(int(part), min(int(part) + FRAMES_PER_CHUNK, n_frames))


# The last world that this process rendered; it stays open, because opening takes seconds.
_open: dict[tuple[object, ...], FrameSource] = {}


# Most tasks of the stage read the same trajectory.
_trajectory = lru_cache(maxsize=1)(read_trajectory)


def run(settings: FeatureSettings, job: Job) -> dict[str, float]:
    """Render and extract the frames of one chunk.

    Returns:
        Time of rendering, including the time to open the world.
    """
    trajectory = _trajectory(job.inputs["drive"] / TRAJECTORY_FILE)
    started = time.perf_counter()
    world = (job.inputs["faces"], settings.camera, trajectory.robots, settings.renderer)
    if world not in _open:
        while _open:
            _open.popitem()[1].close()
        _open[world] = FrameSource(*world)
    source = _open[world]
    rendering_s = time.perf_counter() - started
    front_end = FrontEnd(settings.camera, settings.vision)
    robot, features, truth = settings.robot, [], []
    frames = _chunk(job.part, len(trajectory))
    for iteration in frames:
        poses = trajectory.bodies(iteration)
        started = time.perf_counter()
        frame = render_frame(settings, source, poses, iteration)
        rendering_s += time.perf_counter() - started
        found = front_end.extract(frame.left, frame.right)
        own_pose = poses[trajectory.index(robot)]
        features.append(found)
        points, slopes = truth_behind(settings.camera, frame.depth_m, found.uv_px, own_pose)
        truth.append(np.concatenate([points, slopes.reshape(-1, len(_POINT_SLOPE))], axis=1))
        if 0 <= iteration - settings.images_at < settings.images:
            encoded = cv2.imencode(".png", frame.left)[1].tobytes()
            picture = job.output / f"image_{iteration:06d}.png"
            write_atomically(picture, lambda path, encoded=encoded: path.write_bytes(encoded))
    truth_path, features_path = (job.output / name.format(part=job.part) for name in WRITES)
    joined = {
        name: np.concatenate([getattr(found, name) for found in features])
        for name in ("uv_px", "slope", "descriptor", "patch", *_ONE_EACH)
    }
    # bits are packed; other numbers have four bytes each
    kind, looks = features[0].kind, joined["descriptor"]
    if kind.metric == "hamming":
        joined["descriptor"] = pack_bits(looks)
    else:
        joined["descriptor"] = looks.astype(_NUMBER, copy=False).view(np.uint8)
    joined |= named_columns(_PIXEL, joined["uv_px"]) | named_columns(_SLOPE, joined["slope"])
    joined["iteration"] = np.repeat(np.array(frames), [len(found) for found in features])
    write_table(truth_path, named_columns(TRUTH.names, np.concatenate(truth)), TRUTH)
    if kind != USURF:  # the reference is that of each frame
        kind = replace(kind, reference=None)
    written = _schema(joined["descriptor"].shape[1])
    write_table(features_path, joined, written, kind.attributes())
    return {"rendering_s": rendering_s}


def _schema(n_bytes: int) -> pa.Schema:
    """Return the schema of features whose descriptors have `n_bytes` bytes."""
    at = FEATURES.get_field_index("descriptor")
    return FEATURES.set(at, FEATURES.field(at).with_type(pa.binary(n_bytes)))


FEATURES_STAGE = StageKind("features", "render and find features", run, WRITES)


def render_frame(
    settings: FeatureSettings, source: FrameSource, poses: Float, iteration: int
) -> StereoFrame:
    """Render one frame of a robot, without colour, for robots at poses (R, 3) or (R, 4, 4)."""
    rng = generator(settings.seed, "radiometry", settings.robot, iteration)
    return source.render(poses, settings.robot, settings.radiometry, rng, colour=False)


class TruePoints(NamedTuple):
    """True world points (N, 3) of features, and their derivatives (N, 3, 2) by the pixel."""

    point_m: Float
    slope: Float

    def at(self, shift_px: Float) -> Float:
        """Return world points (N, 3) of pixels shifted by (N, 2) on the same surface."""
        return self.point_m + np.einsum("nij,nj->ni", self.slope, shift_px)


def read_features(folder: Path, n_frames: int) -> Iterator[tuple[Features, TruePoints]]:
    """Features and what is truly behind them, frame by frame, in order."""
    for part in chunks(n_frames):
        truth_path, features_path = (folder / name.format(part=part) for name in WRITES)
        table = read_parquet(features_path, "features table")
        attributes = text_attributes(features_path, table)
        looks = column(table, "descriptor")
        require_kind(features_path, table, attributes, _schema(looks.shape[-1]))
        packed = stated_metric(attributes) == "hamming"
        looks = unpack_bits(looks) if packed else looks.view(_NUMBER)
        kind = kind_from(attributes, looks.shape[1])
        found = Features(
            columns(table, _PIXEL),
            **{name: column(table, name) for name in _ONE_EACH},
            descriptor=looks,
            kind=USURF if kind is None else kind,
            slope=columns(table, _SLOPE),
            patch=column(table, "patch").reshape(-1, PATCH_SIDE_PX, PATCH_SIDE_PX),
        )
        true_table, _ = read_table(truth_path, TRUTH)
        point = columns(true_table, POSITION_FIELDS)
        slope = columns(true_table, _POINT_SLOPE).reshape(-1, 3, 2)
        frames = _chunk(part, n_frames)
        ends = np.searchsorted(column(table, "iteration"), [*frames, frames.stop]).tolist()
        for rows in itertools.starmap(slice, itertools.pairwise(ends)):
            yield with_rows(found, rows), TruePoints(point[rows], slope[rows])
