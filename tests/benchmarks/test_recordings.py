"""Time of a frame of the KITTI extract; with `pytest --benchmark-only`, as `test_vision.py`.

Bars: the front end 150 ms, links in space 2 ms, on one core. MAPFUSION_RECORDINGS names the folder.
"""

import time
from pathlib import Path

import cv2
import pytest

from mapfusion.datasets.formats import read_recording
from mapfusion.datasets.stereo_import import StereoImport
from mapfusion.vision import tracking
from mapfusion.vision.front_end import FrontEnd, Observer
from tests.mapfusion.datasets.extracts import laid_out_as_kitti, needs_recordings

# of the processor: others may be at work on the machine
pytestmark = [needs_recordings, pytest.mark.benchmark(timer=time.process_time)]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> StereoImport:
    cv2.setNumThreads(1)
    root: Path = tmp_path_factory.mktemp("kitti")
    return StereoImport(read_recording("kitti", laid_out_as_kitti(root)))


def test_front_end(benchmark, work: StereoImport) -> None:
    front_end, pair = FrontEnd(work.camera, work.vision), work.rectified(10)
    found = benchmark.pedantic(front_end.extract, pair, rounds=10, warmup_rounds=1)
    benchmark.extra_info["features"] = len(found)


def test_links_in_space(benchmark, work: StereoImport, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    links = tracking.estimate_rigid_motion
    monkeypatch.setattr(
        tracking, "estimate_rigid_motion", lambda *own: given.append(own) or links(*own)
    )
    front_end, observer = FrontEnd(work.camera, work.vision), Observer.of(work.camera, work.vision)
    for k in (10, 11):
        observer.observe(front_end.extract(*work.rectified(k)))
    benchmark.pedantic(links, given[-1], rounds=50, warmup_rounds=1)
    benchmark.extra_info["links"] = len(given[-1][0])
