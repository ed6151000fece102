"""Runs with every descriptor, and maps of other kinds through the commands."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapfusion.landmark_map import read_map
from mapfusion.robot_log import read_log, write_log
from tests.helpers.tiny_scenario import TINY, command
from tests.mapfusion.described_worlds import KINDS, log_of

MINE = '''
import numpy as np


class Window:
    """Brightness at 8x8 points of the window, without its mean."""

    metric = "cosine"

    def describe(self, image, uv_px, scale_px):
        offset = np.linspace(-10, 10, 8)
        grid = np.stack(np.meshgrid(offset, offset), axis=-1)
        at = np.rint(uv_px[:, None, None] + scale_px[:, None, None, None] * grid).astype(int)
        u, v = (np.clip(at[..., k], 0, image.shape[1 - k] - 1) for k in (0, 1))
        found = image[v, u].reshape(len(uv_px), 64).astype(np.float32)
        return found - found.mean(axis=1, keepdims=True) + 1e-3
'''


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("sift", "euclidean, 128 numbers (sift)"),
        ("orb", "hamming, 256 bits (orb)"),
        ("mine.py:Window", "cosine, 64 numbers (Window)"),
    ],
)
def test_a_run_maps_aligns_and_reports_with_every_descriptor(
    name: str,
    kind: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(TINY, encoding="utf-8")
    Path("mine.py").write_text(MINE, encoding="utf-8")
    settings = ("--set", "render.renderer=raycast", "--set", f"vision.descriptor={name}")
    words = ("--aligner", "ransac", "--no-figures", "--jobs", "1")
    reply = command(capsys, "run", "tiny.yaml", *settings, *words, "-o", "out", "--results", ".")
    assert reply.code == 0
    for robot in ("R1", "R2"):
        landmarks = read_map(Path("out") / "maps" / f"{robot}.parquet")
        assert str(landmarks.descriptor_kind) == kind
        assert len(landmarks) > 20
    errors = pd.read_parquet("out/tables/errors.parquet")
    last = errors[errors["iteration"] == errors["iteration"].max()]
    assert len(last) > 0
    if name in ("sift", "orb"):  # the plug-in's few corners of one small room may stay ambiguous
        assert reply.complaints == []
        assert last["accepted"].any()
    assert last["refined_translation_error_m"].max() < 0.1
    assert command(capsys, "report", "out").code == 0
    assert Path("out/report.html").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["orb", "float768"])
def test_logs_of_other_programs_become_a_fused_map(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few, paths = ("--set", "slam.filter.n_particles=30"), []
    for robot, start in {"R1": [0.5, -1.5, 0.0], "R2": [-0.5, 1.5, 3.0]}.items():
        write_log(tmp_path / robot, log_of(KINDS[name], robot, start))
        paths.append(tmp_path / f"{robot}.parquet")
        reply = command(capsys, "slam", tmp_path / robot, *few, "-o", paths[-1])
        assert reply.code == 0
    report, picture, fused = (tmp_path / f"f.{kind}" for kind in ("html", "png", "csv"))
    words = ("--aligner", "ransac", "--report", report, "--plot", picture)
    assert command(capsys, "align", *paths, *words, "--require-accepted").code == 0
    assert command(capsys, "merge", *paths, "-o", fused, *words).code == 0
    assert min(path.stat().st_size for path in (report, picture)) > 10_000
    written = read_map(fused)
    assert written.descriptor_kind is not None
    seen = read_log(tmp_path / "R1").observations.descriptor_kind
    assert seen is not None
    assert not written.descriptor_kind.differs_from(seen)
    assert np.isfinite(written.descriptor).all()  # type: ignore[arg-type]
