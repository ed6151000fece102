from collections.abc import Iterator
from pathlib import Path

import pytest

from experiments.judge.judged_run import JudgedRun
from experiments.judge.result import run_scenario
from experiments.methods.one_thread import single_threaded
from experiments.run.store import Store
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from tests.helpers.synthetic_result import write_result
from tests.helpers.tiny_scenario import TINY


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
def tiny(tiny_path: Path) -> Simulation:
    """The tiny scenario."""
    scenario = load_scenario(tiny_path)
    assert isinstance(scenario, Simulation)
    return scenario


@pytest.fixture(scope="session")
def tiny_results(tiny: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of one uninterrupted run in one process; tests must not change it."""
    results = tmp_path_factory.mktemp("results")
    single_threaded()
    run_scenario(tiny, results, 1, lambda stage, done, total: None)
    return results


@pytest.fixture(scope="session")
def tiny_result(tiny_results: Path) -> Path:
    """The result folder of that run."""
    return tiny_results / "tiny-3"


@pytest.fixture(scope="session")
def tiny_log(tiny: Simulation, tiny_results: Path) -> Path:
    """The log of R1 in the store of that run."""
    run = JudgedRun.of(tiny, Store.of(tiny_results))
    return run.store.path(run.pipeline.robots[0].log)


@pytest.fixture(scope="session")
def made_up_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small result folder; tests must not change it."""
    return write_result(tmp_path_factory.mktemp("result"))
