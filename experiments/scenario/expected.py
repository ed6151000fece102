"""Names of the metrics that a scenario's `expect` block may bound.

`experiments/judge/metrics.py` computes them; here they are known before anything is computed.
"""

from collections.abc import Sequence

from mapfusion.errors import did_you_mean

# Of a whole run.
RUN_METRICS = ("path_rmse_m", "odometry_rmse_m", "path_over_odometry")
RUN_METRICS += tuple(
    f"smoother.{name}"
    for name in (
        *("path_rmse_m", "filter_over_smoother", "landmark_rmse_m", "gross_share"),
        *("nees_per_dof", "coverage_95"),
    )
)
RUN_METRICS += ("oracle_translation_m", "oracle_rotation_rad", "true_pairs_at_end")
RUN_METRICS += (
    "fused_over_parents",
    "fused_nees_with_drift",
    "fused_nees_without_drift",
    "landmark_rmse_median_m",
    "landmark_rmse_worst_m",
    "fused_landmark_rmse_m",
    "team.merged_robots",
    "team.ate_rmse_m",
    "team.translation_m",
    "team.rotation_rad",
    "team.edge_precision",
    "team.edge_recall",
)
# Of each fuser that runs, under its name: columns of the table `fusers`.
FUSER_METRICS = ("landmark_rmse_m", "gross_share", "fitted_rmse_m", "fitted_median_m")
FUSER_METRICS += ("over_better_parent", "over_better_filter", "nees_per_dof", "frame_nees_per_dof")
FUSER_METRICS += ("coverage_95", "frame_coverage_95", "alignment_nees_per_dof", "duplicate_share")
FUSER_METRICS += ("alignment_error_m", "alignment_error_rad")
FUSER_METRICS += ("alignment_sigma_m", "alignment_sigma_rad")
# Of each aligner, under its name.
ALIGNER_METRICS = (
    "refined_oracle_distance_m",
    "refined_over_oracle",
    "estimated_over_oracle",
    "estimated_translation_m",
    "lead_over_others",
    "scatter_m",
    "false_merges",
    "missed_merges",
)


def known_metrics(aligners: Sequence[str], fusers: Sequence[str]) -> list[str]:
    """Return every metric name that a scenario with these aligners and fusers may use."""
    of_fusers = [f"{fuser}.{name}" for fuser in fusers for name in FUSER_METRICS]
    of_aligners = [f"{aligner}.{name}" for aligner in aligners for name in ALIGNER_METRICS]
    return [*RUN_METRICS, *of_fusers, *of_aligners]


def why_unknown(name: str, aligners: Sequence[str], fusers: Sequence[str]) -> str:
    """Return the reason why a scenario may not expect a metric of this name; empty if it may."""
    known = known_metrics(aligners, fusers)
    if name in known:
        return ""
    method, _, of_method = name.rpartition(".")
    if method and of_method in ALIGNER_METRICS:
        return f"unknown aligner {method}; align.aligners has {', '.join(aligners)}"
    if method and of_method in FUSER_METRICS:
        return f"unknown fuser {method}; fuse.fusers has {', '.join(fusers)}"
    forms = ", ".join((*RUN_METRICS, "ALIGNER.NAME", "FUSER.NAME"))
    return f"unknown{did_you_mean(name, known) or f'; known: {forms}'}"
