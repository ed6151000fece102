import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from experiments.judge.pipeline import plan
from experiments.judge.result import run_scenario
from experiments.methods.one_thread import single_threaded
from experiments.run.store import Store
from experiments.scenario.settings import Scenario, load_scenario
from tests.helpers.tiny_scenario import TINY, TRIO


@pytest.fixture(scope="session", autouse=True)
def _kernels_beside_the_source() -> Iterator[None]:
    # Set but empty: commands, and processes they start, share the kernels that tests compiled.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_CACHE_DIR", "")
        yield


@pytest.fixture(scope="session")
def tiny_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scenario's file."""
    path = tmp_path_factory.mktemp("scenario") / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def tiny(tiny_path: Path) -> Scenario:
    """The tiny scenario."""
    return load_scenario(tiny_path)


def finished(scenario: Scenario, results: Path) -> Path:
    """The result folder of one uninterrupted run in one process."""
    single_threaded()
    return run_scenario(scenario, results, 1, lambda stage, done, total: None)


@pytest.fixture(scope="session")
def tiny_result(tiny: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its result folder; tests must not change it."""
    return finished(tiny, tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="session")
def tiny_results(tiny_result: Path) -> Path:
    """The folder that result and the store lie in; tests must not change it."""
    return tiny_result.parent


@pytest.fixture(scope="session")
def tiny_log(tiny: Scenario, tiny_results: Path) -> Path:
    """The log of R1 in the store of that run."""
    return plan(tiny, Store(tiny_results / "store")).robots[0].log.path


@pytest.fixture(scope="session")
def trio_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of three robots; tests must not change it, see `trio_copy`."""
    folder = tmp_path_factory.mktemp("trio")
    (folder / "trio.yaml").write_text(TRIO, encoding="utf-8")
    return finished(load_scenario(folder / "trio.yaml"), folder)


@pytest.fixture
def trio_copy(trio_result: Path, tmp_path: Path) -> Path:
    """A copy of it, for a test to change."""
    return Path(shutil.copytree(trio_result, tmp_path / "result"))
