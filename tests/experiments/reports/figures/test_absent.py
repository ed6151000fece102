"""Methods whose package is not installed are shown as absent."""

from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation import tables
from experiments.reports.figures.error_figures import (
    draw_aligner_time,
    draw_rotation_error,
    draw_translation_error,
)
from experiments.reports.figures.result_tables import ResultTables

MEASURED = {
    "errors": [
        "translation_error_m",
        "rotation_error_rad",
        "refined_translation_error_m",
        "refined_rotation_error_rad",
    ],
    "aligner_timings": ["elapsed_s", "elapsed_low_s", "elapsed_high_s"],
}


@pytest.fixture
def without_svd(trio_copy: Path) -> ResultTables:
    for name, columns in MEASURED.items():
        path = tables.table_path(trio_copy, name)
        rows = tables.read(path, name)
        own = rows["aligner"] == "svd"
        assert own.any()
        rows.loc[own, columns] = np.nan
        if name == "errors":
            rows.loc[own, ["status", "refined_status"]] = "absent"
        tables.write(path, name, rows)
    return ResultTables(trio_copy)


@pytest.mark.parametrize("draw", [draw_translation_error, draw_rotation_error, draw_aligner_time])
def test_legends_say_absent(draw, trio_result: Path, without_svd: ResultTables) -> None:
    def labels(data: ResultTables) -> list[str]:
        return [text.get_text() for text in draw(data).legends[0].get_texts()]

    before, after = labels(ResultTables(trio_result)), labels(without_svd)
    assert "svd" in before
    assert after == ["svd (absent)" if label == "svd" else label for label in before]
