from pathlib import Path

import pytest
from synthetic_result import write_result


@pytest.fixture(scope="session")
def made_up_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small result folder; tests must not change it."""
    return write_result(tmp_path_factory.mktemp("result"))
