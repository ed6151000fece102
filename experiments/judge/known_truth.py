"""Whether the truth of a scenario's robots is known."""

from pathlib import Path

from experiments.scenario.settings import AnyScenario, Recording
from mapfusion.open_tables import table_path
from mapfusion.robot_log import TRUTH_TABLES


def why_no_truth(scenario: AnyScenario) -> str:
    """Which log of a scenario has no truth beside it; empty where all have.

    Errors are told of all robots or of none: a map is judged against another's, too.
    """
    logs = map(Path, scenario.logs) if isinstance(scenario, Recording) else ()
    for log in logs:
        lacking = [name for name in TRUTH_TABLES if not table_path(log, name).is_file()]
        if lacking and log.is_dir():
            return f"no truth is known: {log} has no {lacking[0]}.parquet or .csv"
    return ""
