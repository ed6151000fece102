"""Simulated scenarios that run in seconds, and the command run in this process."""

import sys
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pytest

from experiments.cli import main as cli
from experiments.evaluation import tables
from mapfusion.files import read_json, write_json

TINY = """
schema_version: 1
name: tiny
seed: 3
world:
  walls:
    - points: [[0, 0], [6, 0], [6, 4], [0, 4], [0, 0]]
robots:
  - {name: R1, start: [1.2, 1.2, 0.6], route: [[4.8, 1.2], [4.8, 2.8]]}
  - {name: R2, start: [1.2, 2.8, -0.2], route: [[3.2, 2.8], [3.2, 1.6]]}
drive: {frames: 44}
camera: {width_px: 160, height_px: 120, focal_px: 144.25}
slam: {filter: {n_particles: 30, proposal: motion}}
align:
  evidence: {least_ratio: 1}  # what both see is less than a room
  repetitions: 2
  aligners:
    - {name: ransac, method: ransac}
    - {name: svd, method: svd}
    - {name: icp, method: icp}
evaluate: {every: 10, timing_points: 2, timing_repeats: 1}
fuse: {every: 40}
keep: {images_at: 30, images: 2}
expect:
  path_rmse_m: {max: 1}
"""
# All that figures and reports can show: three pairs of maps, and methods that scatter.
TRIO = (
    TINY.replace("name: tiny", "name: trio")
    .replace("drive:", "  - {name: R3, start: [0.9, 2.0, 0.1], route: [[2.5, 2.0]]}\ndrive:")
    .replace("{least_ratio: 1}", "{place_m: 0, least_ratio: 1}")
    .replace("repetitions: 2", "repetitions: 3")
    .replace("evaluate:", "    - {name: impicp, method: impicp}\nevaluate:")
    + "team: {link: {every: 8}}\n"
)
# Seconds less, where it does not matter what is in the maps.
SHORT = TINY.replace("name: tiny", "name: short").replace("frames: 44", "frames: 12")
TIMED = ("timings", "aligner_timings")  # the only tables that may differ between two runs


class Reply(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def complaints(self) -> list[str]:
        """Lines of stderr that are no progress bars."""
        return [line for line in self.err.splitlines() if line.startswith("mapfusion: ")]


def command(capsys: pytest.CaptureFixture[str], *arguments: object) -> Reply:
    """Run `mapfusion ARGUMENTS` in this process; anything but an exit code passes through."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["mapfusion", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    out, err = capsys.readouterr()
    assert isinstance(ended.value.code, int)
    return Reply(ended.value.code, out, err)


def assert_refused(reply: Reply, *words: str) -> None:
    """The command ended with one line that holds these words."""
    assert reply.code == 2
    assert "Traceback" not in reply.err
    assert len(reply.err.strip().splitlines()) == 1, reply.err
    for word in words:
        assert word in reply.err


def estimated_tables(result: Path) -> dict[str, pd.DataFrame]:
    """All tables that must be the same in every run."""
    return {
        name: tables.read(tables.table_path(result, name), name)
        for name in tables.ALL
        if name not in TIMED
    }


def assert_same_tables(result: Path, other: Path) -> None:
    """Bit for bit, NaN equal to NaN."""
    first, second = estimated_tables(result), estimated_tables(other)
    for name, table in first.items():
        pd.testing.assert_frame_equal(table, second[name], check_exact=True, obj=name)


def without_tables(result: Path, *names: str) -> None:
    """Make a result one of an earlier version that had no such tables."""
    provenance = read_json(result / "provenance.json", "provenance")
    provenance["tables"] = [name for name in provenance["tables"] if name not in names]
    write_json(result / "provenance.json", provenance)
    for name in names:
        tables.table_path(result, name).unlink()
