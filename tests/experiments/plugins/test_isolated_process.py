"""Tests of `experiments.plugins.isolated_process`."""

import importlib
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from experiments.plugins import isolated_process
from experiments.plugins.discovery import callable_aligner, make_method, require_usable
from experiments.plugins.isolated_process import (
    InvalidAnswerError,
    checked_alignment,
    end_children,
    process_for,
)
from mapfusion.align.aligners import as_aligner
from mapfusion.align.alignment import Alignment, Status
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import generator
from mapfusion.verification.registration import Registration
from tests.helpers.answered_here import answered_here
from tests.helpers.made_up_maps import landmark_map, paired
from tests.helpers.made_up_plugin import install, look_again
from tests.helpers.waiting import PATIENCE_S, has_ended, wait_until

LIMIT_S = 60.0


@pytest.fixture(scope="module", autouse=True)
def _plug_in(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("site")
    install(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(isolated_process, "_END_LIMIT_S", PATIENCE_S)
        importlib.invalidate_caches()
        look_again()
        yield
    look_again()
    end_children()


POINTS = np.random.default_rng(0).uniform(0, 10, (12, 3))
MAPS = (landmark_map(POINTS, "R1"), landmark_map(POINTS + 1.0, "R2"))
PAIRS = paired([0, 1, 2, 3, 4], [0, 1, 2, 3, 4])


def answer(what: str, limit_s: float = LIMIT_S, seed: int = 0) -> Alignment:
    aligner = callable_aligner("made_up", {"what": what}, limit_s)
    return aligner.align(*MAPS, PAIRS, generator(seed, "test"))


def test_an_answer_comes_through_as_it_was_given() -> None:
    end_children()
    found = answer("good", seed=5)
    expected = np.array([2.0, 2.0, 0.5]) + generator(5, "test").normal(0, 1e-3, 3)
    np.testing.assert_array_equal(found.T_a_b, expected)
    np.testing.assert_array_equal(found.covariance, np.diag([1.0, 4.0, 0.01]))
    np.testing.assert_array_equal(found.inlier, np.ones(5, bool))
    assert found.status is Status.ACCEPTED
    assert found.reason == ""
    assert found.drift_sigma_m == 0.1
    assert found.elapsed_s > 0  # measured where it ran
    assert found.elapsed_s != 99.0  # as it claims
    assert callable_aligner("made_up", {}, LIMIT_S).randomised


def test_degenerate_is_an_answer_too() -> None:
    found = answer("degenerate")
    assert (found.status, found.reason) == (Status.DEGENERATE, "nothing to see")
    assert np.isnan(found.T_a_b).all()


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("raises", r"^raised KeyError: 'no such\\nlandmark' \(made_up_module.py:\d+\)$"),
        ("exits", r"^raised SystemExit: 3 "),
        ("exits at once", "^ended its process with exit code 3$"),
        ("segfaults", "^ended its process with SIGSEGV$"),
        ("kills itself", "^ended its process with SIGKILL$"),
        ("NaN", "^T_a_b is not finite, but accepted$"),
    ],
)
def test_misbehaviour_is_a_status_with_a_reason(what: str, reason: str) -> None:
    found = answer(what)
    assert found.status is Status.FAILED
    assert re.search(reason, found.reason), found.reason
    assert np.isnan(found.T_a_b).all()
    assert found.inlier.shape == (5,)
    assert not found.inlier.any()
    assert math.isnan(found.elapsed_s)
    # and it stays what it is in the steps that follow, and does not spoil the next call
    aligner = callable_aligner("made_up", {"what": what}, LIMIT_S)
    done = Registration(aligner).register(*MAPS, PAIRS, generator(0, "test"))
    assert done.estimated.status is Status.FAILED
    assert done.refined is done.applied is done.estimated
    assert (done.verdict.accepted, done.verdict.reason) == (False, done.estimated.reason)
    assert answer("good").status is Status.ACCEPTED


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("wrong type", "^returned tuple, expected Alignment$"),
        ("none", "^returned NoneType, expected Alignment$"),
        ("list", r"^T_a_b is list, expected an array \(3,\) of float$"),
        ("4 numbers", r"^T_a_b is an array \(4,\) of float64, expected an array \(3,\) of float$"),
        ("theta out of range", "^theta is 4 rad, expected -pi to pi$"),
        ("inlier of another length", r"^inlier is an array \(6,\) of bool, expected an array "),
        ("inlier of numbers", r"^inlier is an array \(5,\) of float64, expected .* of bool$"),
        ("infinite covariance", "^covariance is not finite$"),
        ("asymmetric covariance", "^covariance is not symmetric$"),
        ("negative variance", "^covariance has a negative variance$"),
        ("covariance of the plane", r"^covariance is an array \(2, 2\)"),
        ("claims to have failed", "^status is .*failed.*, expected accepted or refused"),
        ("refuses without a reason", "^refused without a reason$"),
        ("reason is no text", "^reason is int, expected str$"),
        ("drift is no number", "^drift_sigma_m is NoneType, expected float or floating$"),
        ("degenerate with a motion", "^T_a_b is not NaN, but degenerate$"),
    ],
)
def test_nonsense_is_a_status_with_a_reason(what: str, reason: str) -> None:
    found = answered_here("made_up", {"what": what}, (*MAPS, PAIRS), generator(0, "test"))
    assert found.status is Status.FAILED
    assert re.search(reason, found.reason), found.reason
    assert np.isnan(found.T_a_b).all()


@pytest.mark.parametrize(
    "what",
    ["hangs", "hangs with the lock held", "closes everything", "writes a byte now and then"],
)
def test_a_hanging_plug_in_is_ended(what: str) -> None:
    process = process_for("made_up", f'{{"what": "{what}"}}')
    found = answer(what, limit_s=0.3)
    assert (found.status, found.reason) == (Status.FAILED, "gave no answer within 0.3 s")
    assert not process.alive
    assert answer("good").status is Status.ACCEPTED


def test_a_plug_in_that_cuts_the_connection_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_process, "_END_LIMIT_S", 0.2)
    found = answer("shuts its side of the connection")
    assert (found.status, found.reason) == (
        Status.FAILED,
        "closed the connection to its process",
    )


def test_an_answer_is_never_unpickled(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer("writes a pickle")
    assert found.status is Status.FAILED
    assert found.reason.startswith("sent an invalid answer: ")
    assert "unpickled" not in capsys.readouterr().out


def test_an_answer_to_another_request_is_a_failure() -> None:
    found = answer("answers another request")
    assert (found.status, found.reason) == (
        Status.FAILED,
        "sent an invalid answer: it does not belong to the request",
    )


def test_a_process_that_cannot_start_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    end_children()
    monkeypatch.setattr(sys, "executable", "/no/such/interpreter")
    found = answer("good")
    assert (found.status, found.reason) == (
        Status.FAILED,
        "cannot start a process: No such file or directory",
    )


def test_numerical_libraries_use_one_thread() -> None:
    assert answer("counts its threads").T_a_b.tolist() == [1.0, 1.0, 0.0]


def test_it_is_not_called_for_ever_after_it_hung() -> None:
    aligner = callable_aligner("made_up", {"what": "hangs"}, 0.2)
    others = (landmark_map(POINTS), landmark_map(POINTS))
    reasons = [aligner.align(*MAPS, PAIRS, generator(0)).reason for _ in range(3)]
    reasons += [aligner.align(*others, PAIRS, generator(0)).reason]
    late = "gave no answer within 0.2 s"
    assert reasons == [late, late, f"not called again: {late}", f"not called again: {late}"]


def test_after_it_died_twice_on_some_maps_it_gets_the_next_ones() -> None:
    aligner = callable_aligner("made_up", {"what": "exits at once"}, LIMIT_S)
    others = (landmark_map(POINTS), landmark_map(POINTS))
    reasons = [aligner.align(*MAPS, PAIRS, generator(0)).reason for _ in range(3)]
    reasons += [aligner.align(*others, PAIRS, generator(0)).reason]
    died = "ended its process with exit code 3"
    assert reasons == [died, died, f"not called again: {died}", died]


def test_maps_are_passed_whole_and_cannot_be_spoilt() -> None:
    total = MAPS[0].position_m.sum() + MAPS[1].position_m.sum()
    assert answer("sums").T_a_b.tolist() == [pytest.approx(total, rel=1e-15), 5.0, 0.0]
    aligner = callable_aligner("made_up", {"what": "spoils its maps"}, LIMIT_S)
    same = (MAPS[0], MAPS[0])  # what it spoils is what it sums
    first, second = (aligner.align(*same, PAIRS, generator(0)).T_a_b for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(MAPS[0].position_m, POINTS)


def test_one_process_serves_all_calls_of_one_method_with_its_parameters() -> None:
    end_children()
    first, second = answer("good"), answer("good")
    assert second.T_a_b[0] - first.T_a_b[0] == pytest.approx(1)  # it counts its calls
    other = callable_aligner("made_up", {"what": "good", "seconds": 0.01}, LIMIT_S)
    assert other.align(*MAPS, PAIRS, generator(0, "test")).T_a_b[0] == pytest.approx(first.T_a_b[0])


def test_no_more_than_a_few_processes_live() -> None:
    pids = [process_for("made_up", f'{{"seconds": {k}}}')._process.pid for k in range(6)]
    assert [has_ended(pid) for pid in pids] == [True, True, False, False, False, False]
    end_children()
    assert all(map(has_ended, pids))


def test_a_process_that_keeps_its_memory_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_process, "_MAX_GROWTH_BYTES", 2**25)
    calls = [answer("grows").T_a_b[0] for _ in range(40)]
    assert all(answer_ > 1 for answer_ in calls)
    starts = np.flatnonzero(np.diff(calls) < -1)  # it counts its calls from the start again
    assert 1 <= len(starts) <= 4


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"what": "unknown"}, "plug-in made_up: what: is unknown"),
        ({"wat": 1}, "plug-in made_up: parameters: made_up: .*unexpected keyword argument 'wat'"),
        ({"what": "cannot be made"}, "plug-in made_up: raised RuntimeError: no licence"),
        ({"what": "dies when made"}, "plug-in made_up: ended its process with exit code 4"),
        ({"what": "randomised is no bool"}, "randomised is str, expected bool"),
        ({"what": {1, 2}}, "parameters: made_up: .*not JSON serializable"),
    ],
)
def test_parameters_are_tried_before_a_run(parameters: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        require_usable("made_up", parameters)


PARENT = """
from tests.helpers.made_up_maps import landmark_map, paired
import numpy as np, sys
from experiments.plugins.discovery import callable_aligner
from experiments.plugins.isolated_process import process_for
points = np.random.default_rng(0).uniform(0, 10, (12, 3))
maps = landmark_map(points), landmark_map(points)
what = sys.argv[1]
print(process_for("made_up", '{"what": "%s"}' % what)._process.pid, flush=True)
callable_aligner("made_up", {"what": what}, 500.0).align(
    *maps, paired([0, 1, 2], [0, 1, 2]), np.random.default_rng(0))
"""


def test_its_process_ends_with_a_killed_parent(tmp_path: Path) -> None:
    """It also starts in a folder whose files have the names of standard modules."""
    (tmp_path / "work").mkdir()
    for name in ("json", "socket", "numpy"):
        (tmp_path / "work" / f"{name}.py").write_text("1 / 0", encoding="utf-8")
    script = tmp_path / "parent.py"
    script.write_text(PARENT, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, str(script), "hangs"],
        env=environment,
        cwd=tmp_path / "work",
        stdout=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdout is not None
        child = int(run.stdout.readline())
        run.kill()
    assert wait_until(lambda: has_ended(child))


HERE = Path(__file__).parent
NOW = HERE.parents[1] / "plugin_example" / "mapfusion_best_share.py"
BEFORE = HERE / "best_share_before.py"
FINDER = """
import numpy as np
from mapfusion.align.alignment import Fit, Needs, Undetermined

T = np.array([1.0, 2.0, 0.5])


class Finder:
    randomised = False

    def __init__(self, what="good"):
        self.what = what
        if what == "needs a number":
            self.needs = 3
        if what == "needs many":
            self.needs = Needs(pairs=100)

    def find(self, pairs, rng):
        n = len(pairs)
        every = np.ones(n, bool)
        if self.what == "raises":
            raise KeyError("no such landmark")
        return {
            "good": Fit(T, every),
            "undetermined": Undetermined("nothing to see"),
            "no reason": Undetermined(""),
            "none": None,
            "only a motion": T,
            "NaN": Fit(T * np.nan, every),
            "list": Fit([1.0, 2.0, 0.5], every),
            "rows for a mask": Fit(T, np.arange(n)),
            "inlier of another length": Fit(T, np.ones(n + 1, bool)),
            "weights of another length": Fit(T, every, weight=np.ones(n + 1)),
            "gain of another shape": Fit(T, every, gain=np.ones((n, 3))),
            "infinite weights": Fit(T, every, weight=np.full(n, np.inf)),
            "fitted to what": Fit(T, every, fitted=[1]),
            "refusal is no text": Fit(T, every, refusal=7),
            "theta out of range": Fit(np.array([0.0, 0.0, 4.0]), every),
        }[self.what]


class Neither:
    randomised = False
"""

ANSWERS_POINTS = np.random.default_rng(0).uniform(0, 10, (20, 3))
T_A_B = np.array([1.0, -2.0, 0.3])
ANSWERS_MAPS = (
    landmark_map(ANSWERS_POINTS, "R1"),
    landmark_map(se2.transform_points(se2.inverse(T_A_B), ANSWERS_POINTS), "R2"),
)
ANSWERS_PAIRS = paired(list(range(20)), list(range(20)))


@pytest.fixture(scope="module", autouse=True)
def _plug_ins(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("site")
    for name, target, code in (
        ("now", "share_now:BestShare", NOW.read_text(encoding="utf-8")),
        ("before", "share_before:BestShare", BEFORE.read_text(encoding="utf-8")),
        ("finder", "finder_module:Finder", FINDER),
        ("neither", "neither_module:Neither", FINDER),
    ):
        install(folder, name, f"package-{name}", target=target, code=code)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        importlib.invalidate_caches()
        look_again()
        yield
    look_again()
    end_children()


def answers_answer(name: str, n_pairs: int = 20, **parameters: object) -> Alignment:
    aligner = callable_aligner(name, parameters, 60.0)
    return aligner.align(*ANSWERS_MAPS, ANSWERS_PAIRS[np.arange(n_pairs)], np.random.default_rng(0))


def assert_same(first: Alignment, second: Alignment) -> None:
    for name in ("T_a_b", "covariance", "inlier", "drift_sigma_m"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.status, first.reason) == (second.status, second.reason)


@pytest.mark.parametrize("n_pairs", [20, 8, 3, 2, 0])
def test_the_example_answers_the_same_by_either_interface(n_pairs: int) -> None:
    now, before = (
        answers_answer("now", n_pairs, share=0.4),
        answers_answer("before", n_pairs, share=0.4),
    )
    assert_same(now, before)
    assert now.ok == (n_pairs >= 3)
    if now.ok:
        np.testing.assert_allclose(now.T_a_b, T_A_B, atol=1e-9)
        assert now.inlier.sum() == max(3, round(0.4 * n_pairs))


@pytest.mark.parametrize("name", ["now", "before"])
def test_either_is_called_in_place_as_in_a_process_of_its_own(name: str) -> None:
    in_place = as_aligner(make_method(name, share=0.4))
    assert_same(
        answers_answer(name, share=0.4),
        in_place.align(*ANSWERS_MAPS, ANSWERS_PAIRS, np.random.default_rng(0)),
    )
    done = Registration(in_place).register(*ANSWERS_MAPS, ANSWERS_PAIRS, np.random.default_rng(0))
    assert done.refined.ok


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("raises", r"^raised KeyError: 'no such landmark' \(finder_module.py:\d+\)$"),
        ("no reason", "^Undetermined without a reason$"),
        ("none", "^returned NoneType, expected Fit or Undetermined$"),
        ("only a motion", "^returned ndarray, expected Fit or Undetermined$"),
        ("NaN", "^T_a_b is not finite, expected Undetermined where there is no motion$"),
        ("list", r"^T_a_b is list, expected an array \(3,\) of float$"),
        ("rows for a mask", r"^inlier is an array \(20,\) of int64, expected .* of bool$"),
        ("inlier of another length", r"^inlier is an array \(21,\) of bool, expected an array "),
        ("weights of another length", r"^weight is an array \(21,\) of float64, expected an array"),
        ("gain of another shape", r"^gain is an array \(20, 3\) of float64, expected an array"),
        ("infinite weights", "^covariance is not finite$"),
        ("fitted to what", "^fitted is list, expected Pairs or None$"),
        ("refusal is no text", "^refusal is int, expected str$"),
        ("theta out of range", "^theta is 4 rad, expected -pi to pi$"),
    ],
)
def test_nonsense_from_find_is_a_status_with_a_reason(what: str, reason: str) -> None:
    rng = np.random.default_rng(0)
    found = answered_here("finder", {"what": what}, (*ANSWERS_MAPS, ANSWERS_PAIRS), rng)
    assert found.status is Status.FAILED
    assert re.search(reason, found.reason), found.reason
    assert np.isnan(found.T_a_b).all()


def test_undetermined_and_what_it_needs_are_answers_too() -> None:
    found = answers_answer("finder", what="undetermined")
    assert (found.status, found.reason) == (Status.DEGENERATE, "nothing to see")
    found = answers_answer("finder", what="needs many")
    assert found.status is Status.DEGENERATE
    assert found.reason == "20 correspondences, at least 100 are needed"


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("finder", {"what": "needs a number"}, "plug-in finder: needs is int, expected Needs"),
        ("neither", {}, r"plug-in neither: has no method `find\(self, pairs, rng\)`, which"),
    ],
)
def test_what_is_no_method_is_told_before_a_run(name: str, parameters: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        require_usable(name, parameters)


def _checked(covariance: np.ndarray) -> Alignment:
    inlier, text = np.ones(4, dtype=bool), ""
    given = Alignment(T_A_B, covariance, inlier, 0.0, Status.ACCEPTED, text, 0.05)
    return checked_alignment(given, 4, 0.0)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_a_covariance_is_judged_by_its_own_size(scale: float) -> None:
    """The checks are relative: they hold for tiny covariances of exact maps and for large ones."""
    good = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.2], [0.1, -0.2, 0.3]])
    rounded, singular = good.copy(), np.outer([1.0, 2.0, -1.0], [1.0, 2.0, -1.0])
    rounded[0, 1] *= 1 + 1e-12
    singular -= 1e-12 * np.eye(3)
    for each in (good, rounded, singular):
        np.testing.assert_array_equal(_checked(scale * each).covariance, scale * each)
    skewed, negative = good.copy(), good - 1.0 * np.eye(3)
    skewed[0, 1] *= 1.001
    with pytest.raises(InvalidAnswerError, match="covariance is not symmetric"):
        _checked(scale * skewed)
    with pytest.raises(InvalidAnswerError, match="covariance has a negative variance"):
        _checked(scale * negative)
