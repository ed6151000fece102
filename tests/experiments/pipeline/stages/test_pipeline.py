"""Tests of `experiments.pipeline.stages.pipeline`."""

from experiments.pipeline.stages.pipeline import build_pipeline
from experiments.scenario.settings import Simulation


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
