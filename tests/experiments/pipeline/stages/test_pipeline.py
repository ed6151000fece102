"""Tests of `experiments.pipeline.stages.pipeline`."""

from pathlib import Path

import numpy as np
import pytest

from experiments.pipeline.stages.pipeline import build_pipeline, memory_bytes, needs, require_memory
from experiments.scenario.loading import load_scenario
from experiments.scenario.settings import Simulation
from mapfusion.errors import InputError
from mapfusion.fastslam.landmark_arrays import allocate
from mapfusion.robot_log import Observations, RobotLog, write_log
from tests.helpers.tiny_scenario import assert_refused, command


def test_two_robots_are_aligned_in_the_order_of_their_names(tiny: Simulation) -> None:
    """R10 comes after R2, whichever is listed first: T_a_b and its random numbers are the same."""
    first, second = tiny.robots
    renamed = [first.model_copy(update={"name": "R10"}), second]
    for robots in (renamed, renamed[::-1]):
        pipeline = build_pipeline(tiny.model_copy(update={"robots": robots}))
        (pair,) = pipeline.pairs
        assert (pair.a.name, pair.b.name) == ("R2", "R10")
        assert [robot.name for robot in pipeline.robots] == [robot.name for robot in robots]


def test_no_robot_waits_for_another_with_what_is_made_in_one_piece(tiny: Simulation) -> None:
    """The robots' tasks of a stage are neighbours: two processes are both busy with it."""
    names = [stage.name for stage in build_pipeline(tiny).stages()]
    assert names[:2] == ["drive", "faces"]
    for name in ("features", "slam", "smooth"):
        first = names.index(name)
        assert names[first : first + 2] == [name, name]
    assert names.index("slam") > max(k for k, name in enumerate(names) if name == "observed")


GB = 1e9


def need(path: Path, *overrides: str) -> dict[str, float]:
    asked = needs(build_pipeline(load_scenario(path, overrides)))
    return {each.setting: each.n_bytes for each in asked}


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["slam.filter.n_particles=10000", "drive.frames=20000"], "slam.filter.n_particles"),
        (["drive.frames=100000", "evaluate.every=10"], "evaluate.every"),
        (["camera.width_px=4096", "camera.height_px=4096"], "camera.width_px"),
        (["world.walls.0.points=[[0, 0], [500, 0], [500, 400], [0, 400]]"], "world.walls"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_setting(
    tiny_path: Path, overrides: list[str], named: str
) -> None:
    pipeline = build_pipeline(load_scenario(tiny_path, overrides))
    with pytest.raises(InputError, match=f"^{named}: .* GB, this machine has 1.0 GB"):
        require_memory(pipeline, 1, GB)
    require_memory(pipeline, 1, 1e15)


def test_each_process_needs_its_own(tiny_path: Path) -> None:
    pipeline = build_pipeline(load_scenario(tiny_path))
    require_memory(pipeline, 1, GB)
    with pytest.raises(InputError, match="in each of 8 processes"):
        require_memory(pipeline, 8, GB)


def test_the_filter_needs_what_its_rows_take(tiny_path: Path) -> None:
    """Each hundred particles take as much again; a landmark no less than its row holds."""
    name = "slam.filter.n_particles"
    one, two, three = (need(tiny_path, f"{name}={n}")[name] for n in (100, 200, 300))
    assert three - two == pytest.approx(two - one)
    own = allocate(64, 256, 100).by_particle
    per_landmark = sum(part.nbytes for part in own) / 256
    n_observations = 44 * 110
    assert two - one > 0.02 * n_observations * per_landmark


def test_observations_need_what_their_descriptors_take(tiny_path: Path) -> None:
    """A log of 256 bits has as many floats in memory; U-SURF has 64."""
    few, name = "slam.filter.n_particles=1", "drive.frames"
    size = ("drive.frames=1000", "vision.harris.max_corners=200", few)
    needed = {
        each: need(tiny_path, f"vision.descriptor={each}", *size)[name]
        for each in ("usurf", "sift", "orb")
    }
    n_observations = 1000 * 200
    for each, length in (("sift", 128), ("orb", 256)):
        more = needed[each] - needed["usurf"]
        assert more == pytest.approx(n_observations * (length - 64) * 4, rel=0.05)


@pytest.mark.parametrize("length", [0, 64, 768])
def test_recorded_observations_need_what_their_descriptors_take(
    length: int, tmp_path: Path
) -> None:
    rng, n = np.random.default_rng(0), 3000
    looks = rng.normal(size=(n, length)).astype(np.float32) if length else None
    position, covariance = rng.normal(size=(n, 3)), np.tile(np.eye(3), (n, 1, 1))
    seen = Observations(position, covariance, looks, label=np.arange(n, dtype=np.int32))
    logs = [tmp_path / name for name in ("R1", "R2")]
    for folder in logs:
        frames = np.repeat(np.arange(30), n // 30)
        write_log(
            folder, RobotLog(folder.name, False, np.arange(30.0), np.zeros((30, 3)), frames, seen)
        )
    path = tmp_path / "recorded.yaml"
    path.write_text(f"schema_version: 1\nname: recorded\nlogs: [{logs[0]}, {logs[1]}]\n")
    own = seen.position_m.nbytes + seen.covariance_m2.nbytes + n * 4 * length
    needed = need(path, "slam.filter.n_particles=1")["logs"]
    assert own < needed < 2 * own


def test_a_long_drive_needs_a_row_for_what_was_seen_lately(tiny_path: Path) -> None:
    """All particles descend from one before; unless they are never resampled."""
    particles = "slam.filter.n_particles=200"
    rarely = ("evaluate.every=10000", "fuse.every=10000")
    long = (particles, "drive.frames=100000", "vision.harris.max_corners=50", *rarely)
    fits, never = (
        build_pipeline(load_scenario(tiny_path, [*long, f"slam.filter.resample_fraction={share}"]))
        for share in (0.5, 0.0)
    )
    require_memory(fits, 1, 8 * GB)
    with pytest.raises(InputError, match=r"^slam\.filter\.n_particles: .* 100000 frames"):
        require_memory(never, 1, 5 * GB)
    with pytest.raises(InputError, match=r"^drive\.frames: .* 100000 frames"):
        require_memory(fits, 1, GB)


def test_shipped_scenarios_fit_into_4_gb() -> None:
    for path in (Path(__file__).parents[3] / "scenarios").glob("*.yaml"):
        if path.stem not in ("mrclam7", "mrclam9"):  # their logs are not there
            require_memory(build_pipeline(load_scenario(path)), 2, 4 * GB)


def test_a_run_is_refused_before_anything_is_computed(
    tiny_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = (
        "slam.filter.n_particles=10000",
        "vision.harris.max_corners=5000",
        "drive.frames=20000",
    )
    overrides = [word for each in asked for word in ("--set", each)]
    reply = command(capsys, "run", tiny_path, *overrides, "--results", tmp_path / "results")
    assert_refused(reply, "n_particles", "20000 frames", "this machine has")
    assert not (tmp_path / "results").exists()


def test_the_machine_is_not_taken_for_a_giant() -> None:
    assert 1e8 < memory_bytes() < 1e14
