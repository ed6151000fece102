"""Descriptors by name: SIFT and ORB of OpenCV at given corners, and plug-ins."""

from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapfusion.camera import StereoCamera
from mapfusion.descriptors import USURF, median_distance
from mapfusion.errors import InputError
from mapfusion.vision import descriptors, surf
from mapfusion.vision.descriptors import DESCRIBERS, NamedDescriber, descriptor_bytes, target_of
from mapfusion.vision.front_end import (
    FrontEnd,
    FrontEndParameters,
    Observer,
    concatenate_observations,
)
from tests.mapfusion.vision.rendered_scene import render, wall

OPENCV = ("sift", "orb")


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 255, (240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return cv2.normalize(smooth, smooth, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def corners(rng: np.random.Generator, n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Corners everywhere in the image, also at its border, and their scales."""
    uv = rng.uniform(0, [319, 239], (n, 2))
    uv[:4] = [[0, 0], [319, 0], [0, 239], [319, 239]]
    return uv, rng.uniform(1, 6, n)


def test_usurf_is_unchanged(image: np.ndarray, rng: np.random.Generator) -> None:
    uv, scale = corners(rng)
    found, kind = NamedDescriber("usurf").describe(image, uv, scale)
    np.testing.assert_array_equal(found, surf.describe(image, uv, scale))
    assert kind is USURF


@pytest.mark.parametrize("name", OPENCV)
def test_every_corner_has_a_descriptor_in_its_place(
    name: str, image: np.ndarray, rng: np.random.Generator
) -> None:
    describer, (uv, scale) = NamedDescriber(name), corners(rng)
    found, kind = describer.describe(image, uv, scale)
    assert found.shape == (60, kind.length)
    assert kind.length == DESCRIBERS[name].length
    assert descriptor_bytes(name) == found.nbytes / 60
    order = rng.permutation(60)
    again, _ = describer.describe(image, uv[order], scale[order])
    np.testing.assert_array_equal(again, found[order])
    alone = np.concatenate(
        [describer.describe(image, uv[k : k + 1], scale[k : k + 1])[0] for k in range(60)]
    )
    np.testing.assert_array_equal(alone, found)
    none, same = describer.describe(image, uv[:0], scale[:0])
    assert none.shape == (0, kind.length)
    assert same.name == name


@pytest.mark.parametrize("name", OPENCV)
def test_a_window_of_the_same_area_looks_the_same(
    name: str, image: np.ndarray, rng: np.random.Generator
) -> None:
    """Twice the image with twice the scales: distances far below those of other corners."""
    describer = NamedDescriber(name)
    uv, scale = rng.uniform(60, [259, 179], (40, 2)), rng.uniform(1.5, 3, 40)
    large = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    found, _ = describer.describe(image, uv, scale)
    again, _ = describer.describe(large, 2 * uv + 0.5, 2 * scale)
    apart = np.linalg.norm(found[:, None] - again, axis=2) / median_distance(found)
    assert np.median(np.diag(apart)) < 0.45
    assert np.mean(apart.argmin(axis=1) == np.arange(40)) > 0.95
    wrong, _ = describer.describe(large, 2 * uv + 0.5, scale)
    assert np.median(np.linalg.norm(found - wrong, axis=1)) > 0.7 * median_distance(found)


@pytest.mark.parametrize("name", OPENCV)
def test_windows_are_upright(name: str, image: np.ndarray, rng: np.random.Generator) -> None:
    describer = NamedDescriber(name)
    uv, scale = rng.uniform(80, [239, 159], (30, 2)), np.full(30, 2.0)
    found, _ = describer.describe(image, uv, scale)
    turned, _ = describer.describe(image[::-1, ::-1].copy(), [319, 239] - uv, scale)
    assert np.median(np.linalg.norm(found - turned, axis=1)) > 0.7 * median_distance(found)


@pytest.mark.parametrize("name", DESCRIBERS)
def test_the_front_end_tracks_and_observes_with_every_descriptor(name: str) -> None:
    camera, rng = StereoCamera(), np.random.default_rng(4)
    room = [wall(rng, (5, 4), (5, -4), 8.0, -3.0)]
    parameters = FrontEndParameters(descriptor=name)
    front_end, observer = FrontEnd(camera, parameters), Observer.of(camera, parameters)
    seen = []
    for x in (0.0, 0.1, 0.2, 0.3):
        left, right, _ = render(room, camera, (x, 0.0, 0.02), 2.0, rng)
        seen.append(observer.observe(front_end.extract(left, right)))
    assert len(seen[-1].rows) > 50
    linked = np.isin(seen[-1].tracks.track_id, seen[-2].tracks.track_id)
    assert linked.mean() > 0.6
    _, together = concatenate_observations([frame.observations for frame in seen])
    assert together.descriptor_kind is not None
    assert together.descriptor_kind.name == name
    on_all = replace(together.descriptor_kind, reference=None).on(together.descriptor)  # type: ignore[arg-type]
    assert together.descriptor_kind == (USURF if name == "usurf" else on_all)


PLUGIN = '''
import numpy as np


class Brightness:
    """Brightness on a grid of 4x4 points, as signs of differences or as it is."""

    metric = "{metric}"

    def describe(self, image, uv_px, scale_px):
        step = np.arange(4) - 1.5
        at = uv_px[:, None, None] + scale_px[:, None, None, None] * 5 * np.stack(
            np.meshgrid(step, step), axis=-1
        )
        u, v = (np.clip(np.rint(at[..., k]), 0, image.shape[1 - k] - 1).astype(int) for k in (0, 1))
        values = image[v, u].reshape(len(uv_px), 16).astype(np.float32)
        return {answer}
'''


def plug_in(folder: Path, metric: str = "euclidean", answer: str = "values") -> str:
    (folder / "bright.py").write_text(PLUGIN.format(metric=metric, answer=answer))
    return f"{folder / 'bright.py'}:Brightness"


def test_plug_ins_are_found_by_file_and_by_entry_point(
    tmp_path: Path, image: np.ndarray, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    uv, scale = corners(rng)
    name = plug_in(tmp_path)
    found, kind = NamedDescriber(name).describe(image, uv, scale)
    assert (kind.metric, kind.length, kind.name) == ("euclidean", 16, "Brightness")
    monkeypatch.syspath_prepend(tmp_path)
    declared = EntryPoints([EntryPoint("bright", "bright:Brightness", descriptors.GROUP)])
    monkeypatch.setattr(descriptors, "entry_points", lambda group: declared.select(group=group))
    again, kind = NamedDescriber("bright").describe(image, uv, scale)
    np.testing.assert_array_equal(again, found)
    assert kind.name == "bright"
    assert target_of("bright") == "bright:Brightness"
    with pytest.raises(
        ValueError, match=r"unknown descriptor 'brigth', known are usurf, .*; did you"
    ):
        FrontEndParameters(descriptor="brigth")
    with pytest.raises(ValueError, match="no such file"):
        FrontEndParameters(descriptor="nowhere.py:Mine")


@pytest.mark.parametrize(
    ("metric", "answer", "said"),
    [
        ("euclidean", "values[1:]", r"gave float32 \(59, 16\), expected float32 \(60, D\)"),
        ("euclidean", "values.astype(float)", "gave float64"),
        ("hamming", "values", "gave float32 .* expected uint8"),
        ("euclidean", "values / 0 * 0", "not finite"),
        ("cosine", "0 * values", "row 0 is zero"),
        ("euclidean", "values[0, 99]", "raised IndexError"),
        ("euclidean", "None", "gave <class 'NoneType'>"),
    ],
)
def test_wrong_answers_of_plug_ins_are_told_in_one_line(
    tmp_path: Path, image: np.ndarray, rng: np.random.Generator, metric: str, answer: str, said: str
) -> None:
    describer = NamedDescriber(plug_in(tmp_path, metric, answer))
    with np.errstate(all="ignore"), pytest.raises(InputError, match=said):
        describer.describe(image, *corners(rng))


def test_plug_ins_that_cannot_be_made_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be made: descriptor_metric: is 'manhattan'"):
        NamedDescriber(plug_in(tmp_path, "manhattan"))
    with pytest.raises(InputError, match=r"cannot be made: .* no class Dark; there: Brightness"):
        NamedDescriber(plug_in(tmp_path).replace("Brightness", "Dark"))
