"""Shared fixtures for tests with the KITTI extract."""

import pytest

from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.stereo_import import Imported, StereoImport
from mapfusion.datasets.stereo_recording import StereoRecording
from tests.mapfusion.datasets.extracts import WHOLE, laid_out_as_kitti


@pytest.fixture(scope="session")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> StereoRecording:
    return read_recording("kitti", laid_out_as_kitti(tmp_path_factory.mktemp("kitti")))


@pytest.fixture(scope="session")
def work(kitti: StereoRecording) -> StereoImport:
    return StereoImport(kitti)


@pytest.fixture(scope="session")
def imported(work: StereoImport) -> Imported:
    return work.log_of(WHOLE)
