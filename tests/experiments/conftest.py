import io
import shutil
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from experiments.evaluation.evaluated_run import EvaluatedRun
from experiments.evaluation.result import run_scenario
from experiments.pipeline.store import Store
from experiments.pipeline.workers import single_threaded
from experiments.reports.figures import drawing
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Scenario, Simulation
from tests.helpers.shared_folder import shared_folder
from tests.helpers.tiny_scenario import TINY, TRIO


@pytest.fixture(scope="session")
def tiny_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scenario's file."""
    path = tmp_path_factory.mktemp("scenario") / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def tiny(tiny_path: Path) -> Simulation:
    """The tiny scenario."""
    scenario = load_scenario(tiny_path)
    assert isinstance(scenario, Simulation)
    return scenario


def finished(scenario: Scenario, results: Path) -> Path:
    """The result folder of one uninterrupted run in one process."""
    single_threaded()
    return run_scenario(scenario, results, 1, lambda stage, done, total: None)


@pytest.fixture(scope="session")
def tiny_result(tiny: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its result folder; tests must not change it."""
    folder = shared_folder(tmp_path_factory, "tiny", lambda folder: finished(tiny, folder))
    return folder / "tiny-3"


@pytest.fixture(scope="session")
def tiny_results(tiny_result: Path) -> Path:
    """The folder that result and the store lie in; tests must not change it."""
    return tiny_result.parent


@pytest.fixture
def tiny_results_copy(tiny_results: Path, tmp_path: Path) -> Path:
    """A copy of that folder, for commands that write a result again."""
    return Path(shutil.copytree(tiny_results, tmp_path / "tiny_results"))


@pytest.fixture(scope="session")
def tiny_log(tiny: Simulation, tiny_results: Path) -> Path:
    """The log of R1 in the store of that run."""
    run = EvaluatedRun.of(tiny, Store.of(tiny_results))
    return run.store.path(run.pipeline.robots[0].log)


@pytest.fixture(scope="session")
def trio_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of three robots; tests must not change it, see `trio_copy`."""

    def make(folder: Path) -> None:
        (folder / "trio.yaml").write_text(TRIO, encoding="utf-8")
        finished(load_scenario(folder / "trio.yaml"), folder)

    return shared_folder(tmp_path_factory, "trio", make) / "trio-3"


@pytest.fixture
def trio_copy(trio_result: Path, tmp_path: Path) -> Path:
    """A copy of it, for a test to change."""
    return Path(shutil.copytree(trio_result, tmp_path / "result"))


@pytest.fixture
def quick_save(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lay figures out, which finds what cannot be drawn, but do not write the pixels."""

    def picture(figure: Figure, kind: str) -> bytes:
        if kind != "png":
            return b"picture"
        figure.draw_without_rendering()
        one_pixel = io.BytesIO()  # the report reads its size
        Image.new("L", (1, 1)).save(one_pixel, "png")
        return one_pixel.getvalue()

    monkeypatch.setattr(drawing, "_rendered", picture)
