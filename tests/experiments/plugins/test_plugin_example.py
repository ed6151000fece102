"""The worked example of the documentation: installed offline, then named in scenarios.

Most commands run in this process; workers, and what hides a package, in ones of their own.
"""

import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation import tables
from experiments.plugins.isolated_process import end_children
from experiments.reports.figures import drawing
from mapfusion.geometry import se2
from mapfusion.landmark_map import write_map
from tests.helpers.made_up_maps import landmark_map
from tests.helpers.made_up_plugin import install, look_again
from tests.helpers.tiny_scenario import TINY, Reply, command

EXAMPLE = Path(__file__).parents[2] / "plugin_example"
T_A_B = np.array([1.0, -2.0, 0.3])
PLUGGED = (
    TINY.replace("name: tiny", "name: plugged")
    # all that the two see is less than a room
    .replace("{least_ratio: 1}", "{place_m: 0, least_ratio: 1}")
    .replace(
        "    - {name: icp, method: icp}\n",
        """\
    - {name: best, method: best_share, parameters: {share: 0.4}}
    - {name: opencv, method: opencv}
    - {name: kiss, method: kiss_matcher}
""",
    )
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip installed the example, without network."""
    folder = tmp_path_factory.mktemp("installed")
    source = folder / "source"  # a build leaves files behind
    shutil.copytree(EXAMPLE, source)
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--no-input"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", folder / "site", source],
        check=True,
        capture_output=True,
    )
    return folder / "site"


@pytest.fixture
def installed(site: Path) -> Iterator[None]:
    """The example, for commands in this process."""
    with found_in(site):
        yield


@contextmanager
def found_in(site: Path) -> Iterator[None]:
    """Packages in this folder count as installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        patch.setenv("COLUMNS", "200")
        importlib.invalidate_caches()
        look_again()
        yield
    look_again()
    end_children()


def apart(site: Path, *arguments: object) -> Reply:
    """`mapfusion ARGUMENTS` in a process of its own, with the installed packages of `site`."""
    path = os.pathsep.join([str(site), *filter(None, sys.path)])
    environment = os.environ | {"PYTHONPATH": path, "COLUMNS": "200"}
    ended = subprocess.run(
        [sys.executable, "-m", "experiments.cli.main", *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return Reply(ended.returncode, ended.stdout, ended.stderr)


@pytest.fixture
def maps(tmp_path: Path) -> tuple[Path, Path]:
    """Two maps of the same twenty labelled points."""
    p = np.random.default_rng(0).uniform(0, 10, (20, 3))
    paths = tmp_path / "A.parquet", tmp_path / "B.parquet"
    for path, name, position in zip(
        paths, "AB", (p, se2.transform_points(se2.inverse(T_A_B), p)), strict=True
    ):
        landmarks = landmark_map(position, name)
        object.__setattr__(landmarks, "label", np.arange(20, dtype=np.int32))
        write_map(path, landmarks)
    return paths


def entry(method: str, **parameters: object) -> str:
    text = json.dumps([{"name": "theirs", "method": method, "parameters": parameters}])
    return f"align.aligners={text}"


@pytest.mark.usefixtures("installed")
def test_align_with_the_example(
    maps: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    ended = command(capsys, "align", *maps, "--set", entry("best_share"))
    assert (ended.code, ended.complaints) == (0, [])
    (row,) = (line for line in ended.out.splitlines() if line.strip().startswith("theirs"))
    assert row.split()[1:5] == ["accepted", "1.000", "-2.000", "0.3000"]
    assert "20/20" in ended.out


@pytest.mark.usefixtures("installed")
def test_the_example_is_listed_with_its_package(capsys: pytest.CaptureFixture[str]) -> None:
    listed = command(capsys, "scenarios", "--aligners")
    row = next(line for line in listed.out.splitlines() if "best_share" in line)
    assert row.split() == ["best_share", "plug-in", "mapfusion-best-share", "1.0"]


def test_it_is_not_listed_where_it_is_not_installed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "best_share" not in command(capsys, "scenarios", "--aligners").out


@pytest.mark.usefixtures("installed")
def test_errors_name_it(maps: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    ended = command(capsys, "align", *maps, "--set", entry("best_chare"))
    assert ended.code == 2
    assert ended.err.count("\n") == 1
    assert "unknown aligner 'best_chare', known are ransac, svd, icp, impicp" in ended.err
    assert "best_share" in ended.err
    ended = command(capsys, "align", *maps, "--set", entry("best_share", share=2))
    assert ended.code == 2
    assert "plug-in best_share: share: must lie in (0, 1]" in ended.err
    assert ended.err.count("\n") == 1


def test_a_scenario_with_the_example_and_peers(
    site: Path,
    tiny_results: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(drawing, "FIGURES", ("fig04_translation_error",))
    scenario = tmp_path / "plugged.yaml"
    scenario.write_text(PLUGGED, encoding="utf-8")
    results = tmp_path / "results"
    shutil.copytree(tiny_results / "store", results / "store")
    with found_in(site):
        ended = command(capsys, "run", scenario, "--results", results, "--jobs", 1)
    assert ended.code == 0, ended.err
    table_row = next(line for line in ended.out.splitlines() if line.strip().startswith("best"))
    assert table_row
    result = results / "plugged-3"
    for name in ("estimates", "errors", "aligner_timings"):
        rows = tables.read(tables.table_path(result, name), name)
        assert {"best", "opencv", "kiss"} <= set(rows["aligner"])
    estimates = tables.read(tables.table_path(result, "estimates"), "estimates")
    assert not estimates["status"].isin(["failed", "absent"]).any()
    assert estimates["refined_status"].eq("accepted").any()
    svg = (result / "figures" / "fig04_translation_error.svg").read_text(encoding="utf-8")
    assert "best" in svg
    for theirs in ("best", "opencv", "kiss"):
        assert_judged_as(estimates, theirs, "ransac")

    # two processes give the same tables as one, and a changed plug-in is not taken for the old one
    module = site / "mapfusion_best_share.py"
    text = module.read_text(encoding="utf-8")
    folders = set((results / "store" / "aligner").iterdir())
    module.write_text(text + "\n# changed\n", encoding="utf-8")
    try:
        ended = apart(site, "check", scenario, "--results", results, *("--seeds", 3, "--jobs", 2))
    finally:
        module.write_text(text, encoding="utf-8")
    assert ended.code == 0, ended.err
    # its own alone, on the filter's maps and on smoothed maps
    assert len(set((results / "store" / "aligner").iterdir()) - folders) == 2
    again = tables.read(tables.table_path(result, "estimates"), "estimates")
    assert estimates.equals(again)


def assert_judged_as(estimates: pd.DataFrame, theirs: str, own: str) -> None:
    """Methods that are refined to one motion get one verdict: status, reason, evidence."""
    first = estimates[estimates["repetition"] == 0].set_index("iteration")
    two = [first[first["aligner"] == name] for name in (theirs, own)]
    motion = ["refined_tx_m", "refined_ty_m", "refined_theta_rad"]
    apart = (two[0][motion] - two[1][motion]).abs().max(axis=1)
    same = apart.index[(apart < 1e-6) & two[0]["log10_evidence"].notna()]
    assert len(same), f"{theirs} never agrees with {own}"
    words, numbers = ["verdict", "acceptance_reason"], ["log10_false_alarms", "log10_evidence"]
    assert two[0].loc[same, words].equals(two[1].loc[same, words])
    np.testing.assert_allclose(two[0].loc[same, numbers], two[1].loc[same, numbers], rtol=1e-4)


def test_an_absent_package_is_shown_as_absent(tmp_path: Path, maps: tuple[Path, Path]) -> None:
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "sitecustomize.py").write_text(HIDE, encoding="utf-8")
    listed = apart(hidden, "scenarios", "--aligners")
    assert "kiss_matcher: the package kiss-matcher is not installed; pip install" in listed.out
    ended = apart(hidden, "align", *maps, "--set", entry("kiss_matcher"))
    assert (ended.code, ended.complaints) == (0, [])
    line = (
        "theirs: absent: the package kiss-matcher is not installed; "
        "pip install 'mapfusion-bench[peers]' installs it"
    )
    assert line in ended.out


HIDE = """
import sys

class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "kiss_matcher":
            raise ModuleNotFoundError(name)
        return None

sys.meta_path.insert(0, Hide())
"""


def test_a_clash_of_names_is_one_line(
    tmp_path: Path, maps: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path / "site", name="ransac", package="clasher")
    line = (
        "aligner ransac: mapfusion's own is used, the one that clasher declares under the same "
        "name is not"
    )
    with found_in(tmp_path / "site"):
        ended = command(capsys, "align", *maps, "--set", entry("ransac"))
        assert (ended.code, ended.complaints) == (0, [f"mapfusion: warning: {line}"])
        assert line in command(capsys, "scenarios", "--aligners").out
