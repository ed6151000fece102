"""Schemas of the tables that stages write and results carry; none of them knows the truth."""

import pyarrow as pa

from experiments.run.frames import BOOL, FLOAT, INT, TEXT, fields
from mapfusion.storage import schema

# What the aligners said, without any truth: the align stage writes it.
ESTIMATES = schema(
    "result.estimates",
    2,
    fields(
        robot_a=TEXT,
        robot_b=TEXT,
        iteration=INT,
        aligner=TEXT,
        repetition=INT,
        n_correspondences=INT,
        status=TEXT,
        reason=TEXT,
        tx_m=FLOAT,
        ty_m=FLOAT,
        theta_rad=FLOAT,
        refined_status=TEXT,
        refined_reason=TEXT,
        refined_tx_m=FLOAT,
        refined_ty_m=FLOAT,
        refined_theta_rad=FLOAT,
        # of the refined alignment, against chance; NaN where there was none to judge
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        acceptance_reason=TEXT,
        drift_sigma_m=FLOAT,
        # upper triangle of the refined alignment's covariance (m2, m rad, rad2)
        cov_xx=FLOAT,
        cov_xy=FLOAT,
        cov_xt=FLOAT,
        cov_yy=FLOAT,
        cov_yt=FLOAT,
        cov_tt=FLOAT,
        # one bit a correspondence, most significant first (numpy.packbits)
        inliers=pa.binary(),
        refined_inliers=pa.binary(),
    ),
)

# The pairs offered to the aligners; rows of the two maps at that iteration.
CORRESPONDENCES = schema(
    "result.correspondences",
    1,
    fields(
        robot_a=TEXT,
        robot_b=TEXT,
        iteration=INT,
        index_a=INT,
        index_b=INT,
        descriptor_distance=FLOAT,
    ),
)

# Harris points of a few consecutive frames, for figure 1.
TRACKS = schema(
    "result.tracks",
    1,
    fields(robot=TEXT, iteration=INT, track=pa.int64(), length=INT, u_px=FLOAT, v_px=FLOAT),
)
