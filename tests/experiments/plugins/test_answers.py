"""Validation of both interfaces of a plug-in: `find`, and `align` of older packages."""

import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from experiments.plugins.answers import InvalidAnswerError, checked_alignment
from experiments.plugins.discovery import callable_aligner, make_method, require_usable
from experiments.plugins.isolated_process import end_children
from mapfusion.align.alignment import Alignment, Status
from mapfusion.geometry import se2
from mapfusion.verification.registration import Registration, as_aligner
from tests.helpers.answered_here import answered_here
from tests.helpers.made_up_maps import landmark_map, paired
from tests.helpers.made_up_plugin import install, look_again

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

POINTS = np.random.default_rng(0).uniform(0, 10, (20, 3))
T_A_B = np.array([1.0, -2.0, 0.3])
MAPS = (
    landmark_map(POINTS, "R1"),
    landmark_map(se2.transform_points(se2.inverse(T_A_B), POINTS), "R2"),
)
PAIRS = paired(list(range(20)), list(range(20)))


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


def answer(name: str, n_pairs: int = 20, **parameters: object) -> Alignment:
    aligner = callable_aligner(name, parameters, 60.0)
    return aligner.align(*MAPS, PAIRS[np.arange(n_pairs)], np.random.default_rng(0))


def assert_same(first: Alignment, second: Alignment) -> None:
    for name in ("T_a_b", "covariance", "inlier", "drift_sigma_m"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.status, first.reason) == (second.status, second.reason)


@pytest.mark.parametrize("n_pairs", [20, 8, 3, 2, 0])
def test_the_example_answers_the_same_by_either_interface(n_pairs: int) -> None:
    now, before = answer("now", n_pairs, share=0.4), answer("before", n_pairs, share=0.4)
    assert_same(now, before)
    assert now.ok == (n_pairs >= 3)
    if now.ok:
        np.testing.assert_allclose(now.T_a_b, T_A_B, atol=1e-9)
        assert now.inlier.sum() == max(3, round(0.4 * n_pairs))


@pytest.mark.parametrize("name", ["now", "before"])
def test_either_is_called_in_place_as_in_a_process_of_its_own(name: str) -> None:
    in_place = as_aligner(make_method(name, share=0.4))
    assert_same(answer(name, share=0.4), in_place.align(*MAPS, PAIRS, np.random.default_rng(0)))
    done = Registration(in_place).register(*MAPS, PAIRS, np.random.default_rng(0))
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
    found = answered_here("finder", {"what": what}, (*MAPS, PAIRS), rng)
    assert found.status is Status.FAILED
    assert re.search(reason, found.reason), found.reason
    assert np.isnan(found.T_a_b).all()


def test_undetermined_and_what_it_needs_are_answers_too() -> None:
    found = answer("finder", what="undetermined")
    assert (found.status, found.reason) == (Status.DEGENERATE, "nothing to see")
    found = answer("finder", what="needs many")
    assert found.status is Status.DEGENERATE
    assert found.reason == "20 correspondences, at least 100 are needed"


@pytest.mark.parametrize(
    ("name", "parameters", "reason"),
    [
        ("finder", {"what": "needs a number"}, "plug-in finder: needs is int, expected Needs"),
        ("neither", {}, "plug-in neither: has neither a method find nor a method align"),
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
