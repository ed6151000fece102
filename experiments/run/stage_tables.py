"""Schemas of the tables that stages write and results carry; none of them knows the truth."""

import pyarrow as pa

from experiments.run.frames import BOOL, FLOAT, INT, TEXT, fields
from mapfusion.storage import schema

MOTION = ("tx_m", "ty_m", "theta_rad")
COVARIANCE = ("cov_xx", "cov_xy", "cov_xt", "cov_yy", "cov_yt", "cov_tt")  # m2, m rad, rad2
_MAPS = {"robot_a": TEXT, "robot_b": TEXT, "iteration": INT}
_ANSWER = {"status": TEXT, "reason": TEXT} | dict.fromkeys(MOTION, FLOAT)

# What the aligners said, without any truth: the align stage writes it.
ESTIMATES = schema(
    "result.estimates",
    2,
    fields(
        **_MAPS,
        aligner=TEXT,
        repetition=INT,
        n_correspondences=INT,
        **_ANSWER,
        **{f"refined_{name}": kind for name, kind in _ANSWER.items()},
        # of the refined alignment, against chance; NaN where there was none to judge
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        acceptance_reason=TEXT,
        drift_sigma_m=FLOAT,
        # upper triangle of the refined alignment's covariance
        **dict.fromkeys(COVARIANCE, FLOAT),
        # one bit a correspondence, most significant first (numpy.packbits)
        inliers=pa.binary(),
        refined_inliers=pa.binary(),
    ),
)

# The pairs offered to the aligners; rows of the two maps at that iteration.
_OFFERED = fields(**_MAPS, index_a=INT, index_b=INT, descriptor_distance=FLOAT)
CORRESPONDENCES = schema("result.correspondences", 1, _OFFERED)

# Harris points of a few consecutive frames, for figure 1.
_POINT = fields(robot=TEXT, iteration=INT, track=pa.int64(), length=INT, u_px=FLOAT, v_px=FLOAT)
TRACKS = schema("result.tracks", 1, _POINT)
