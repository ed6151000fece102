"""What a report says of each two maps at the end: the verdict, and where else they fit."""

from collections.abc import Iterator
from typing import Any

import pandas as pd

from experiments.show.figures.result_tables import ResultTables, of_pair

_BETWEEN = "a b"  # of rivals; the others lay a map onto itself
_MOTION = ("tx_m", "ty_m", "theta_rad")


def verdicts_and_places(data: ResultTables) -> Iterator[dict[str, Any]]:
    """For each two robots, of the aligner that maps are fused by: verdict, reason, places.

    Places are the distinct motions that correspondences support, the best first.
    """
    estimates, rivals = data.rows("estimates"), data.rows("rivals")
    used = data.scenario["merge"]["aligner"]
    estimates = estimates[(estimates["aligner"] == used) & (estimates["repetition"] == 0)]
    for robot_a, robot_b in data.pairs:
        pair = (robot_a, robot_b)
        last = _last(of_pair(estimates, pair))
        if last.empty:
            continue
        answer = last.iloc[0]
        yield {
            "robots": f"{robot_a} – {robot_b}",
            "verdict": str(answer["verdict"]).replace("_", " "),
            "probability": answer["probability"],
            "n_confirmed": answer["n_confirmed"],
            "n_contradicted": answer["n_contradicted"],
            "reason": answer["acceptance_reason"] or answer["refined_reason"] or answer["reason"],
            "places": _places(_last(of_pair(rivals, pair))),
        }


def _last(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["iteration"] == rows["iteration"].max()]


def _places(rivals: pd.DataFrame) -> list[dict[str, Any]]:
    between = rivals[rivals["of"] == _BETWEEN].sort_values("log10_false_alarms", kind="stable")
    columns = [*_MOTION, "n_support", "n_confirmed", "n_contradicted"]
    return between[columns].to_dict("records")  # pyright: ignore[reportReturnType]
