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
    3,
    fields(
        **_MAPS,
        aligner=TEXT,
        repetition=INT,
        n_correspondences=INT,
        **_ANSWER,
        **{f"refined_{name}": kind for name, kind in _ANSWER.items()},
        # of the refined alignment; NaN where there was none to judge, or no evidence to be sought
        verdict=TEXT,
        accepted=BOOL,
        log10_false_alarms=FLOAT,
        log10_evidence=FLOAT,
        n_confirmed=INT,
        n_contradicted=INT,
        probability=FLOAT,
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

# What was found once for each two maps: the best distinct motions between them (of: "a b"), and of
# each map onto itself ("a", "b"). log10_evidence: of the first, as of estimates; own_share,
# copied_share: of what a wrong motion lays on its like, where no other motion does and where one
# does; region_m: side of a region; copied_a, copied_b: the landmarks that it lays on their like, a
# bit each.
RIVALS = schema(
    "result.rivals",
    3,
    fields(
        **_MAPS,
        of=TEXT,
        **dict.fromkeys(MOTION, FLOAT),
        log10_false_alarms=FLOAT,
        n_support=INT,
        n_confirmed=INT,
        n_contradicted=INT,
        n_regions=INT,
        log10_evidence=FLOAT,
        own_share=FLOAT,
        copied_share=FLOAT,
        region_m=FLOAT,
        copied_a=pa.binary(),
        copied_b=pa.binary(),
    ),
)

# Harris points of a few consecutive frames, for figure 1.
_POINT = fields(robot=TEXT, iteration=INT, track=pa.int64(), length=INT, u_px=FLOAT, v_px=FLOAT)
TRACKS = schema("result.tracks", 1, _POINT)
