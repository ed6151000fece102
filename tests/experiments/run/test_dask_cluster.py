"""A cluster on this machine starts although one of its workers is killed before it answers."""

import pytest

from experiments.pipeline import cluster
from mapfusion.errors import InputError


class Killed:
    """In place of a cluster: the first so many fail to start, as Dask says it."""

    def __init__(self, failures: int) -> None:
        self.failures, self.started = failures, 0

    def __call__(self, **asked: object) -> str:
        assert asked["n_workers"] == 2
        self.started += 1
        if self.started <= self.failures:
            raise RuntimeError("Nanny failed to start.")
        return "a cluster"


@pytest.mark.parametrize("failures", [0, 1, 2])
def test_it_is_started_again(monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
    killed = Killed(failures)
    monkeypatch.setattr(cluster, "LocalCluster", killed)
    assert cluster._started(2) == "a cluster"
    assert killed.started == failures + 1


def test_three_times_in_a_row_is_no_accident(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LocalCluster", Killed(99))
    with pytest.raises(InputError, match="--jobs 2: 2 workers could not be started, 3 times"):
        cluster._started(2)
