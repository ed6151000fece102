"""Methods whose package is not installed are shown as absent; many methods stay tellable."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments import tables
from experiments.figures import fig04_translation_error, fig05_rotation_error, fig06_aligner_time
from experiments.figures.result_tables import ResultTables
from experiments.figures.style import aligner_styles

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
def without_svd(made_up_result: Path, tmp_path: Path) -> ResultTables:
    result = tmp_path / "result"
    shutil.copytree(made_up_result, result)
    for name, columns in MEASURED.items():
        path = tables.table_path(result, name)
        rows = tables.read(path, name)
        own = rows["aligner"] == "svd"
        assert own.any()
        rows.loc[own, columns] = np.nan
        if name == "errors":
            rows.loc[own, ["status", "refined_status"]] = "absent"
        tables.write(path, name, rows)
    return ResultTables(result)


@pytest.mark.parametrize(
    "module", [fig04_translation_error, fig05_rotation_error, fig06_aligner_time]
)
def test_legends_say_absent(module, made_up_result: Path, without_svd: ResultTables) -> None:
    def labels(data: ResultTables) -> list[str]:
        return [text.get_text() for text in module.draw(data).legends[0].get_texts()]

    before, after = labels(ResultTables(made_up_result)), labels(without_svd)
    assert "svd" in before
    assert after == ["svd (absent)" if label == "svd" else label for label in before]


def test_twelve_methods_have_twelve_looks() -> None:
    names = [f"m{k}" for k in range(12)]
    styles = aligner_styles([*names, "oracle"])
    looks = {tuple(sorted((key, str(value)) for key, value in styles[n].items())) for n in names}
    assert len(looks) == 12
    dashes = {
        (style["color"], str(style["linestyle"])) for n, style in styles.items() if n in names
    }
    assert len(dashes) == 12
