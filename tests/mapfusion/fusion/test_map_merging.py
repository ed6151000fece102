"""Alignment and merge of maps in one call, what the results say, and what is drawn of them."""

import io
import itertools
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from PIL import Image

import mapfusion
from mapfusion.align.alignment import Status
from mapfusion.errors import TellingWarning
from mapfusion.fusion.map_merging import MapAlignment, advice, best_alignment, sigma_text
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap, write_map
from mapfusion.plotting import (
    ELLIPSE_BOUND,
    FUSED_COLOUR,
    GREEN,
    bounds,
    largest_magnification,
    plot_plans,
)
from tests.mapfusion.align.map_pairs import landmarks, unit_vectors

T_A_B = np.array([3.0, -1.0, 0.5])


def two_maps(n_common: int = 40, seed: int = 0) -> tuple[LandmarkMap, LandmarkMap]:
    """Maps with 20 landmarks of their own each, and common ones; b has its own frame."""
    rng = np.random.default_rng(seed)
    n = n_common + 40
    p, look = rng.uniform(0, 20, (n, 3)) * [1, 1, 0], unit_vectors(rng, n)
    rows = np.arange(n_common + 20), np.r_[np.arange(n_common), np.arange(n_common + 20, n)]
    made = []
    for name, own, T in zip(("north", "south"), rows, (np.zeros(3), T_A_B), strict=True):
        seen = se2.transform_points(se2.inverse(T), p[own])
        seen[:, :2] += rng.normal(0, 0.02, (len(own), 2))
        made.append(landmarks(seen, 0.02, look[own], planar=True, name=name))
    return made[0], made[1]


@pytest.fixture(scope="module")
def found() -> MapAlignment:
    return mapfusion.align_maps(*two_maps())


def test_one_call_is_all_steps_one_by_one(found: MapAlignment) -> None:
    a, b = two_maps()
    pairs = mapfusion.match(a, b)
    registration = mapfusion.Registration(mapfusion.make_aligner("ransac"))
    done = registration.register(a, b, pairs, np.random.default_rng(0))
    np.testing.assert_array_equal(found.T_a_b, done.refined.T_a_b)
    np.testing.assert_array_equal(found.covariance, done.refined.covariance)
    assert found.accepted
    np.testing.assert_allclose(found.T_a_b, T_A_B, atol=0.03)
    off = found.to_pandas()
    assert off["inlier"].sum() >= 35
    moved = se2.transform_points(found.T_a_b, b.position_m[off["landmark_b"], :2])
    apart = np.hypot(*(a.position_m[off["landmark_a"], :2] - moved).T)
    np.testing.assert_allclose(off["residual_m"], apart, atol=1e-12)


def test_files_tables_and_maps_give_the_same(tmp_path: Path) -> None:
    a, b = two_maps()
    paths = [tmp_path / "north.parquet", tmp_path / "south.ply"]
    for path, own in zip(paths, (a, b), strict=True):
        write_map(path, own)
    of_maps = mapfusion.merge_maps([a, b]).to_pandas()
    for given in (paths, [str(path) for path in paths], [a.to_pandas(), b.to_pandas()]):
        other = mapfusion.merge_maps(given).to_pandas()
        pd.testing.assert_frame_equal(
            of_maps.drop(columns="descriptor"), other.drop(columns="descriptor")
        )


def test_tables_become_maps_and_maps_tables() -> None:
    a, _ = two_maps()
    again = LandmarkMap.from_pandas(a.to_pandas(), "again")
    np.testing.assert_array_equal(again.position_m, a.position_m)
    np.testing.assert_array_equal(again.descriptor, a.descriptor)  # type: ignore[arg-type]
    assert (again.planar, again.name) == (True, "again")
    with pytest.raises(mapfusion.InputError, match=r"^a: has no column cov_xx_m2"):
        mapfusion.align_maps(a.to_pandas().drop(columns="cov_xx_m2"), a)
    long = a.to_pandas()
    long["descriptor"] = [8 * each for each in long["descriptor"]]
    told = r"^descriptors of map 2 are \d+ times as far apart as those of map north: scale both"
    with pytest.raises(mapfusion.InputError, match=told):
        mapfusion.merge_maps([a, long])


def test_labels_of_several_landmarks_are_told_once_for_each_map(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    a, b = two_maps()
    label = np.arange(60, dtype=np.int32)
    label[[50, 51, 52]] = 7, 7, 9
    paths = [tmp_path / "north.csv", tmp_path / "south.csv", tmp_path / "east.csv"]
    for path, own in zip(paths, (label, np.arange(60, dtype=np.int32), label), strict=True):
        write_map(path, replace(a, descriptor=None, descriptor_kind=None, label=own))
    mapfusion.merge_maps([*paths[:2], b])
    said = [str(each.message) for each in recwarn if each.category is TellingWarning]
    assert len(said) == 1
    assert said[0].startswith(f"{paths[0]}: label 7 is on 3 landmarks, label 9 is on 2 landmarks,")
    assert "of 57 labels: of each only the landmark with the largest count is matched" in said[0]
    recwarn.clear()
    mapfusion.align_maps(paths[0], b)  # b has no labels, so that none are used
    assert not recwarn.list


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("sigma_m", [1e-6, 0.05])
def test_maps_in_degrees_are_told(labels: bool, sigma_m: float) -> None:
    tables = []
    for own, rows in zip(two_maps(), (np.arange(60), np.r_[:40, 60:80]), strict=True):
        degrees = own.position_m[:, :2] / [75.5e3, 111.3e3] + [8.5, 47.3]
        table = pd.DataFrame(degrees, columns=["x_m", "y_m"])
        tables.append(table.assign(label=rows) if labels else table)
    found = mapfusion.align_maps(*tables, sigma_m=sigma_m)
    assert not found.accepted
    assert (
        "x_m and y_m of a look like longitude and latitude in degrees (all within" in found.advice
    )
    assert "map more" not in found.advice
    assert "do they name the same" not in found.advice
    merged = mapfusion.merge_maps(tables, sigma_m=sigma_m)
    assert "project them to metres, such as UTM" in merged.advice


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("sigma_m", [10.0, 500.0])
def test_a_sigma_as_large_as_the_map_is_told(labels: bool, sigma_m: float) -> None:
    tables = []
    for own, rows in zip(two_maps(), (np.arange(60), np.r_[:40, 60:80]), strict=True):
        table = pd.DataFrame(own.position_m[:, :2], columns=["x_m", "y_m"])
        tables.append(table.assign(label=rows) if labels else table)
    found = mapfusion.align_maps(*tables, sigma_m=sigma_m)
    assert not found.accepted
    assert f"landmarks of a have a median sigma of {sigma_m:.3g} m in a map" in found.advice
    assert found.advice.endswith("too large or in another unit?")


def test_results_are_described_in_a_line(found: MapAlignment) -> None:
    merged = mapfusion.merge_maps(two_maps())
    for result in (found, merged, found.map_a):
        assert len(repr(result)) < 160
        assert "\n" not in repr(result)
    assert "60 landmarks in the plane, with descriptors" in repr(found.map_a)
    assert "<MapAlignment of north and south by ransac: accepted, T_a_b = (" in repr(found)
    assert "landmarks of 2 of 2 maps, ransac>" in repr(merged)
    for result in (found, merged):
        page = result._repr_html_()
        assert page.startswith("<p>")
        assert page.count("<table") == 1
    hostile = replace(found, map_a=replace(found.map_a, name="<b>&"), aligner="<i>")
    assert "<i>" not in hostile._repr_html_()
    assert "&lt;i&gt;" in hostile._repr_html_()


@pytest.mark.parametrize(
    ("sigma", "said"),
    [(0.25, "sigma 0.250 m, 0.2500 rad"), (3.2e-5, "sigma ≥ 3.2e-05 m, ≥ 3.2e-05 rad")],
)
def test_small_sigmas_are_not_rounded_to_zero(sigma: float, said: str) -> None:
    covariance = np.diag([0.5, 0.5, 1.0]) * sigma**2
    assert sigma_text(covariance, lower_bound=sigma < 0.1) == said


def test_the_advice_says_what_to_use_and_how_sure_it_is(found: MapAlignment) -> None:
    x, y, theta = found.T_a_b
    overlap = found.registered.refined.overlap
    assert overlap is not None
    sigma_m, sigma_rad = se2.motion_sigma(overlap.covariance)
    said = found.advice
    assert f"Use T_a_b = ({x:.3f} m, {y:.3f} m, {theta:.4f} rad) of ransac" in said
    assert f"sigma ≥ {sigma_m:.2g} m, ≥ {sigma_rad:.2g} rad" in said
    assert f"{found.inlier.sum()} of {len(found.inlier)} correspondences" in said
    again = replace(found, aligner="other")
    assert "all 2 methods agree" in advice([found, again])
    away = replace(found.registered.refined, T_a_b=found.T_a_b + np.array([2.0, 0.0, 0.0]))
    other = replace(again, registered=found.registered._replace(refined=away))
    said = advice([found, other])
    assert said.startswith("Use no T_a_b without a check: accepted motions contradict each other")
    assert "of other" in said


def test_the_advice_on_maps_far_from_their_origin_says_how_they_move_where_they_are() -> None:
    far = np.array([465e3, 5250e3, 0.0])
    a, b = two_maps()
    assert not mapfusion.align_maps(a, b).far_away
    own = se2.transform_points(T_A_B, b.position_m)  # of the same frame as a, but for 0.1 m
    moved = [
        replace(a, position_m=a.position_m + far),
        replace(b, position_m=own + far - [0.1, 0, 0]),
    ]
    found = mapfusion.align_maps(*moved)
    said = found.advice
    assert "The overlap lies 5270.6 km from the origin of south, where T_a_b has a sigma" in said
    told = re.search(r"at the overlap it moves south by \((.*) m, (.*) m\)", said)
    assert told is not None
    assert float(told[1]) == pytest.approx(0.1, abs=0.02)
    assert float(told[2]) == pytest.approx(0.0, abs=0.02)


def test_maps_with_descriptors_and_labels_are_told_what_they_lack() -> None:
    a, b = two_maps()
    labelled = replace(
        b, descriptor=None, descriptor_kind=None, label=np.arange(60, dtype=np.int32)
    )
    found = mapfusion.align_maps(a, labelled)
    assert found.refusal.endswith("they are matched by geometry.")
    assert found.reason.startswith("0 correspondences: map north has descriptors, map south only")


def with_status(found: MapAlignment, status: Status, reason: str) -> MapAlignment:
    verdict = replace(found.registered.verdict, status=status, reason=reason)
    return replace(found, registered=found.registered._replace(verdict=verdict))


def test_the_advice_says_why_not_and_what_to_do(found: MapAlignment) -> None:
    for status, remedy in (
        (Status.REFUSED, "cannot be aligned"),
        (Status.AMBIGUOUS, "third map"),
        (Status.TOO_UNCERTAIN, "farther apart"),
        (Status.DEGENERATE, "cannot be aligned"),
    ):
        one = with_status(found, status, "it is so")
        assert one.advice.startswith("Use no T_a_b. ransac: ")
        assert "it is so. " in one.advice
        assert remedy in one.advice
        assert one.advice.count("it is so") == 1
        assert advice([one, one]).startswith("Use no T_a_b. None of 2 methods")
        assert best_alignment([one, found]) is found
        assert "1 of 2 methods agree" in advice([one, found])
        asked = with_status(found, status, "larger: is it in millimetres?")
        assert asked.advice.endswith("is it in millimetres?")  # the cause is named already
    rng = np.random.default_rng(0)
    p, look = rng.uniform(-6, 6, (60, 3)) * [1, 1, 0.1], unit_vectors(rng, 60)
    image = se2.transform_points(T_A_B, p) * [1, -1, 1]
    pair = (landmarks(p, 0.02, look, name="north"), landmarks(image, 0.02, look, name="south"))
    told = mapfusion.align_maps(*pair).advice
    assert "north and south look like mirror images of each other" in told
    assert told.count("mirror") == 1


def labelled_maps(n: int = 40) -> tuple[LandmarkMap, LandmarkMap]:
    rng = np.random.default_rng(0)
    p, label = rng.uniform(-6, 6, (n, 3)) * [1, 1, 0], np.arange(n, dtype=np.int32)
    in_b = se2.transform_points(se2.inverse(T_A_B), p)
    made = []
    for name, own in (("north", p), ("south", in_b)):
        own = own + rng.normal(0, 0.02, (n, 3)) * [1, 1, 0]
        made.append(replace(landmarks(own, 0.02, None, planar=True, name=name), label=label))
    return made[0], made[1]


@pytest.mark.parametrize("changed", [[1, -1, 1], "axes"])
def test_a_labelled_mirror_image_is_named(changed) -> None:
    north, south = labelled_maps()
    p = south.position_m[:, [1, 0, 2]] if changed == "axes" else south.position_m * changed
    told = mapfusion.align_maps(north, replace(south, position_m=p)).advice
    assert "north and south look like mirror images of each other" in told
    assert "one point" not in told
    assert "labels" not in told


def test_labels_of_other_landmarks_are_asked_for() -> None:
    north, south = labelled_maps()
    assert south.label is not None
    told = mapfusion.align_maps(north, replace(south, label=np.roll(south.label, 7))).advice
    assert told.endswith("40 labels are in both maps: do they name the same landmarks?")


def test_sizes_in_another_unit_are_named() -> None:
    north, south = (replace(each, label=None) for each in labelled_maps())
    size_m = np.random.default_rng(0).uniform(0.1, 0.5, len(north))
    north, cm = replace(north, size_m=size_m), replace(south, size_m=100 * size_m)
    told = mapfusion.align_maps(north, cm).advice
    assert "median sizes: map north 0." in told
    assert "are both in metres?" in told
    assert "sizes" not in mapfusion.align_maps(north, replace(south, size_m=size_m)).advice


@pytest.mark.parametrize("given", [np.zeros((3, 2)), [1, 2], None])
def test_maps_of_an_unknown_type_are_refused(given) -> None:
    north, south = labelled_maps()
    with pytest.raises(TypeError, match=r"a: is .*expected a LandmarkMap, the path of a file or"):
        mapfusion.align_maps(given, south)
    assert mapfusion.merge_maps(each for each in (north, south)).any_merged
    for single in ("north.csv", north, {"north": north}):
        with pytest.raises(TypeError, match="expected a list of maps"):
            mapfusion.merge_maps(single)
    with pytest.raises(mapfusion.InputError, match="sigma_m: is -1, expected a positive number"):
        mapfusion.align_maps(north, south, sigma_m=-1.0)


def test_one_map_in_millimetres_is_named_without_descriptors() -> None:
    north, south = (replace(each, label=None) for each in labelled_maps())
    large = replace(south, position_m=1000 * south.position_m)
    for pair in ((north, large), (large, north)):
        told = mapfusion.align_maps(*pair).advice
        assert told.endswith("south fits north if it is in millimetres: write it in metres.")


def test_standard_deviations_in_place_of_variances_are_noted() -> None:
    maps = labelled_maps()
    assert "residuals" not in mapfusion.align_maps(*maps).advice
    wide = (replace(each, covariance_m2=each.covariance_m2 / 0.02) for each in maps)
    told = mapfusion.align_maps(*wide).advice
    assert "times as large as the maps' covariances state" in told
    assert "standard deviations in place of variances" in told


def test_a_merge_of_nothing_has_no_landmarks(tmp_path: Path) -> None:
    a, _ = two_maps()
    _, other = two_maps(seed=1)
    merged = mapfusion.merge_maps([a, other])
    assert not merged.any_merged
    assert merged.advice.startswith("No two maps were merged. north and south: ransac: refused: ")
    with pytest.raises(mapfusion.InputError, match="No two maps were merged"):
        _ = merged.landmarks
    with pytest.raises(mapfusion.InputError, match="No two maps were merged"):
        merged.write(tmp_path / "f.csv")
    assert list(tmp_path.iterdir()) == []
    assert merged.plot().get_suptitle().replace("\n", " ") == merged.advice


def test_maps_that_are_left_out_are_named(tmp_path: Path) -> None:
    (a, b), (_, other) = two_maps(), two_maps(seed=1)
    merged = mapfusion.merge_maps([a, b, replace(other, name="west")])
    assert merged.advice.startswith("Merged 2 of 3 maps (north, south): ")
    assert "west is left out: " in merged.advice
    table = merged.to_pandas()
    assert (table["row_in_map_3"] == -1).all()
    n_common = ((table["row_in_map_1"] >= 0) & (table["row_in_map_2"] >= 0)).sum()
    assert (
        f"{len(table)} landmarks in the frame of north, {n_common} of several maps" in merged.advice
    )
    for name in ("f.csv", "f.ply", "f.parquet"):
        (path,) = merged.write(str(tmp_path / name))
        np.testing.assert_array_equal(
            mapfusion.read_map(path).position_m, merged.landmarks.position_m
        )


def ambiguous_maps() -> tuple[LandmarkMap, LandmarkMap]:
    """A map of one place, and a map in which this place occurs twice, 9 m apart."""
    rng = np.random.default_rng(0)
    p, look = rng.uniform(0, 3, (40, 3)) * [1, 1, 0], unit_vectors(rng, 40)

    def noisy(values: np.ndarray) -> np.ndarray:
        moved = values + rng.normal(0, 0.01, values.shape)
        return (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)

    both = np.concatenate([p, p + np.array([9, 2, 0])])
    twice = landmarks(both, 0.02, noisy(np.tile(look, (2, 1))), planar=True, name="twice")
    return twice, landmarks(p, 0.02, noisy(look), planar=True, name="once")


def test_rivals_are_the_motions_that_were_made() -> None:
    found = mapfusion.align_maps(*ambiguous_maps())
    assert found.status is Status.AMBIGUOUS
    motions = [found.T_a_b, *(each.T_a_b for each in found.other_motions)]
    assert len(motions) == 2
    by_x = sorted(motions, key=lambda T: T[0])
    np.testing.assert_allclose(by_x, [[0, 0, 0], [9, 2, 0]], atol=0.05)
    n_pairs = sum(each.inlier.sum() for each in found.other_motions) + found.inlier.sum()
    assert n_pairs <= len(found.inlier)  # a correspondence supports one of them
    plans = found.plans()
    assert len(plans) == 2
    assert "another motion:\n(" in plans[1].title


def test_a_plan_shows_each_landmark_and_correspondence_once(found: MapAlignment) -> None:
    (plan, *_) = found.plans()
    a, b = plan.parts
    np.testing.assert_array_equal(a.position_m, found.map_a.position_m[:, :2])
    moved = se2.transform_points(found.T_a_b, found.map_b.position_m[:, :2])
    np.testing.assert_allclose(b.position_m, moved)
    np.testing.assert_allclose(b.covariance_m2, found.map_b.covariance_m2[:, :2, :2], atol=1e-12)
    assert len(plan.accepted) == found.inlier.sum()
    assert len(plan.accepted) + len(plan.rejected) == len(found.inlier)
    apart = np.hypot(*np.diff(plan.accepted, axis=1)[:, 0].T)
    np.testing.assert_allclose(apart, found.to_pandas().query("inlier")["residual_m"])
    low, high = bounds(plan)
    inside = ((a.position_m >= low) & (a.position_m <= high)).all(axis=1)
    assert inside.mean() > 0.95


def test_the_plan_of_a_fused_map_counts_as_its_table() -> None:
    merged = mapfusion.merge_maps(two_maps())
    first, *pairs = merged.plans()
    table = merged.to_pandas()
    several = (table["row_in_map_1"] >= 0) & (table["row_in_map_2"] >= 0)
    assert [len(part.position_m) for part in first.parts] == [
        (~several & (table["row_in_map_1"] >= 0)).sum(),
        (~several & (table["row_in_map_2"] >= 0)).sum(),
        several.sum(),
    ]
    assert len(pairs) == 1


def test_maps_without_a_motion_are_drawn_side_by_side(found: MapAlignment) -> None:
    nothing = found.registered.refined
    nothing = replace(nothing, T_a_b=np.full(3, np.nan), inlier=np.zeros(len(found.inlier), bool))
    apart = replace(found, registered=found.registered._replace(refined=nothing))
    a, b = apart.plans()[0].parts
    assert a.position_m[:, 0].max() < b.position_m[:, 0].min()


def test_pictures_are_the_same_each_time(found: MapAlignment) -> None:
    pictures = []
    for _ in range(2):
        file = io.BytesIO()
        found.plot().savefig(file, format="png", dpi=60)
        pictures.append(file.getvalue())
    assert pictures[0] == pictures[1]
    image = np.asarray(Image.open(io.BytesIO(pictures[0])).convert("RGB")).reshape(-1, 3)
    for colour in ((0, 114, 178), (213, 94, 0), (0, 158, 115)):  # both maps, accepted
        assert (np.abs(image - np.array(colour)).max(axis=1) < 40).sum() > 15


def test_the_legend_tells_the_enlargement_of_the_ellipses(found: MapAlignment) -> None:
    figure = found.plot()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    (label,) = [text for text in texts if "ellipses" in text]
    factor = int(label.split(", ")[1].split()[0])
    (collection, *_) = [c for c in figure.axes[0].collections if isinstance(c, EllipseCollection)]
    own = 2 * np.sqrt(ELLIPSE_BOUND) * 0.02  # full axis of an isotropic covariance
    np.testing.assert_allclose(np.asarray(collection.get_widths(), float), factor * own, rtol=1e-9)
    assert largest_magnification(1.0, 12.0) == 10
    assert largest_magnification(5.0, 1.0) == 1


def test_a_merge_shows_ellipses_of_fused_landmarks_and_a_wide_plan_of_two_maps() -> None:
    figure = mapfusion.merge_maps(two_maps()).plot()
    fused, pair = figure.axes
    assert pair.bbox.width == pytest.approx(fused.bbox.width, rel=0.01)
    *_, (markers, ellipses) = zip(
        fused.lines, [c for c in fused.collections if isinstance(c, EllipseCollection)], strict=True
    )
    assert markers.get_color() == FUSED_COLOUR
    pixels_a_metre = fused.bbox.width / np.ptp(fused.get_xlim())
    across = pixels_a_metre * np.asarray(ellipses.get_widths(), float)  # type: ignore[attr-defined]
    assert np.median(across) > 3 * markers.get_markersize() * figure.dpi / 72


def legend_of(figure: Figure) -> dict[str, Any]:
    """Return the entries of the legend, by their texts."""
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    return dict(zip(texts, legend.legend_handles, strict=True))


def test_the_legend_of_a_merge_explains_the_looks_of_all_plans() -> None:
    merged = mapfusion.merge_maps(two_maps())
    figure = merged.plot()
    entries = legend_of(figure)
    (ring,) = [
        entry for text, entry in entries.items() if text == "middle of a supporting correspondence"
    ]
    drawn = [line for axes in figure.axes[1:] for line in axes.lines if line.get_color() == GREEN]
    assert len(drawn) == 1  # the rings of the only pair of maps
    assert np.size(drawn[0].get_xdata()) == merged.alignments[0, 1].inlier.sum()
    for look in ("get_marker", "get_color", "get_markerfacecolor"):
        assert getattr(ring, look)() == getattr(drawn[0], look)()
    assert not [line for line in figure.axes[0].lines if line.get_color() == GREEN]
    # the fused map has no landmark of one map alone: its legend would lack both maps
    a, _ = two_maps()
    same = mapfusion.merge_maps([a, replace(a, name="again")]).plot()
    assert {"north: 60 landmarks", "again: 60 landmarks"} <= set(legend_of(same))


@pytest.mark.parametrize("n_others", [0, 1, 5])
def test_long_texts_overlap_nothing(found: MapAlignment, n_others: int) -> None:
    first, name = found.plans()[0], "the_map_of_a_robot_with_a_long_name_" * 4
    parts = tuple(part._replace(name=f"{name}: 60 landmarks") for part in first.parts)
    long = first._replace(title=f"refused: {name} in the frame of {name}:\nby ransac", parts=parts)
    figure = plot_plans([long] * (n_others + 1), "a reason that takes very many words; " * 40)
    figure.draw_without_rendering()
    renderer = FigureCanvasAgg(figure).get_renderer()
    (heading,) = figure.texts
    shown = [each.get_tightbbox(renderer) for each in (heading, *figure.legends, *figure.axes)]
    boxes = [box for box in shown if box is not None]
    assert len(boxes) == n_others + 3
    for box, other in itertools.combinations(boxes, 2):
        assert not box.overlaps(other)
    for box in boxes:
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.width
        assert box.y1 <= figure.bbox.height


def test_a_plan_fills_its_axes_and_shows_its_view(found: MapAlignment) -> None:
    first = found.plans()[0]
    figure = plot_plans([first] * 2, "")
    low, high = bounds(first)
    for axes in figure.axes:
        (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
        wide, tall = axes.bbox.width, axes.bbox.height
        assert (x1 - x0) / wide == pytest.approx((y1 - y0) / tall)  # equal scales
        assert x0 <= low[0] + 1e-9
        assert x1 >= high[0] - 1e-9
        assert y0 <= low[1] + 1e-9
        assert y1 >= high[1] - 1e-9


def test_matplotlib_and_pandas_are_imported_only_to_draw_and_convert() -> None:
    code = (
        "import sys, mapfusion; mapfusion.align_maps, mapfusion.merge_maps\n"
        "print([m for m in ('matplotlib', 'pandas', 'plotly') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
