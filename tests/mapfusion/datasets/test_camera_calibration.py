"""Camera calibration against the published lens models."""

from math import atan, hypot
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.scenario.yaml_files import read_calibration
from mapfusion.datasets.camera_calibration import (
    R_ROBOT_OPTICAL,
    Lens,
    Rectification,
    StereoCalibration,
    read_stereo_calibration,
)
from mapfusion.errors import InputError

BROWN = (-0.28, 0.07, 2e-4, 2e-5)
RATIONAL = (0.55, -0.12, 3e-4, -2e-4, 0.02, 0.85, -0.05, 0.03)
KANNALA = (-0.01, 0.02, -0.01, 0.002)


def distorted(kind: str, x: float, y: float) -> tuple[float, float]:
    """Project a point of the plane z = 1 with the published formulas."""
    r = hypot(x, y)
    if kind == "equidistant":
        theta = atan(r)
        k1, k2, k3, k4 = KANNALA
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        return x * bent / r, y * bent / r
    if kind == "rational":
        k1, k2, p1, p2, k3, k4, k5, k6 = RATIONAL
        radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    k1, k2, p1, p2 = BROWN if kind == "radial-tangential" else (0, 0, 0, 0)
    radial = 1 + k1 * r**2 + k2 * r**4
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def head(kind: str) -> StereoCalibration:
    """Return two cameras rotated by one or two degrees and displaced in all directions."""
    models = {"radial-tangential": BROWN, "rational": RATIONAL, "equidistant": KANNALA, "none": ()}
    model, coefficients = "radial-tangential" if kind == "rational" else kind, models[kind]
    lenses = [
        Lens((640, 400), focal, center, model, coefficients)
        for focal, center in (((300, 301), (322.5, 190)), ((298, 299), (310, 205.5)))
    ]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02, -0.015, 0.03]).as_matrix()
    T[:3, 3] = [0.11, 0.003, -0.002]
    return StereoCalibration(*lenses, T)


@pytest.mark.parametrize("kind", ["none", "radial-tangential", "rational", "equidistant"])
def test_rectified_pixels_show_what_the_raw_lens_shows(kind: str) -> None:
    calibration = head(kind)
    made = Rectification.of(calibration)
    assert made.maps is not None
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 8, 300)
    p_left = depth[:, None] * np.column_stack(
        [rng.uniform(-0.9, 0.9, 300), rng.uniform(-0.5, 0.5, 300), np.ones(300)]
    )
    turned = (p_left @ R_ROBOT_OPTICAL.T) @ made.R_left_rectified  # rows: R^T p
    uvd = made.camera.project(turned + made.camera.p_robot_left)
    T_right_left = np.linalg.inv(calibration.T_left_right)
    p_right = p_left @ T_right_left[:3, :3].T + T_right_left[:3, 3]
    n = 0
    for row, *points in zip(uvd, p_left, p_right, strict=True):
        for point, lens, maps, shift in zip(
            points, (calibration.left, calibration.right), made.maps, (0, row[2]), strict=True
        ):
            u, v = row[0] - shift, row[1]
            column, line = round(u), round(v)
            if not (
                1 <= column < made.camera.width_px - 1 and 1 <= line < made.camera.height_px - 1
            ):
                continue
            x, y = distorted(kind, *(point[:2] / point[2]))
            raw = np.array(
                [lens.focal_px[0] * x + lens.center_px[0], lens.focal_px[1] * y + lens.center_px[1]]
            )
            # the map between whole pixels, by its slope
            here = np.array([m[line, column] for m in maps])
            along = np.array([(m[line, column + 1] - m[line, column - 1]) / 2 for m in maps])
            down = np.array([(m[line + 1, column] - m[line - 1, column]) / 2 for m in maps])
            np.testing.assert_allclose(
                here + along * (u - column) + down * (v - line), raw, atol=0.01
            )
            n += 1
    assert n > 300


@pytest.mark.parametrize("kind", ["none", "radial-tangential", "rational", "equidistant"])
def test_all_of_a_rectified_picture_is_filled(kind: str) -> None:
    made = Rectification.of(head(kind))
    assert made.maps is not None
    assert made.camera.width_px > 300
    for columns, rows in made.maps:
        assert columns.min() >= -0.51
        assert columns.max() <= 639.51
        assert rows.min() >= -0.51
        assert rows.max() <= 399.51


@pytest.mark.parametrize("center", [(319.5, 199.5), (300.0, 180.0), (301.4, 190.2), (331.9, 215.7)])
@pytest.mark.parametrize("shift", [0, 12])
def test_a_rectified_pair_keeps_its_grey_levels(center: tuple[float, float], shift: int) -> None:
    """Points keep their positions although the centre of the crop has a subpixel offset."""
    sizes, f, baseline = (640, 400), 500.0, 0.2
    T = np.eye(4)
    T[0, 3] = baseline
    right_center = (center[0] + shift, center[1])
    calibration = StereoCalibration(
        Lens(sizes, (f, f), center), Lens(sizes, (f, f), right_center), T
    )
    made = Rectification.of(calibration)
    rng = np.random.default_rng(0)
    raw = tuple(rng.integers(0, 255, (400, 640), dtype=np.uint8) for _ in "lr")
    left, right = made.apply(raw)
    assert made.crops is not None
    (column, row), (column_right, _) = made.crops
    assert (left == raw[0][row : row + len(left), column : column + left.shape[1]]).all()
    assert (
        right == raw[1][row : row + len(left), column_right : column_right + left.shape[1]]
    ).all()
    middle = np.array([column, row]) + (np.array(left.shape[::-1]) - 1) / 2
    assert np.abs(middle - center).max() <= 0.25 + 1e-9
    p_left = rng.uniform([-1, -0.5, 4], [1, 0.5, 6], (100, 3))
    uv = f * p_left[:, :2] / p_left[:, 2:] + center - [column, row]
    disparity = f * baseline / p_left[:, 2]
    found, _ = made.camera.triangulate(uv, disparity, 0.1, 0.1)
    found = (found - made.camera.p_robot_left) @ made.R_left_rectified.T
    # a turn is a shift of the principal point but for the second order of the angle of view
    np.testing.assert_allclose(found, p_left @ R_ROBOT_OPTICAL.T, atol=1e-3)


def test_a_pair_that_is_central_already_is_not_touched() -> None:
    T = np.eye(4)
    T[0, 3] = 0.1
    lens = Lens((320, 240), (200, 200), (159.5, 119.5))
    made = Rectification.of(StereoCalibration(lens, lens, T))
    assert (made.camera.width_px, made.camera.height_px) == (320, 240)
    assert made.crops == ((0, 0), (0, 0))
    np.testing.assert_array_equal(made.R_left_rectified, np.eye(3))


def test_what_cannot_be_rectified_is_one_line() -> None:
    lens, T = Lens((320, 240), (200, 200), (159.5, 119.5)), np.eye(4)
    for t, words in (([-0.1, 0, 0], "other way round"), ([0.01, 0.2, 0], "to the right")):
        T[:3, 3] = t
        with pytest.raises(InputError, match=words):
            StereoCalibration(lens, lens, T)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("y", 170, degrees=True).as_matrix(), [0.1, 0, 0]
    with pytest.raises(InputError, match="both cameras see"):
        Rectification.of(StereoCalibration(lens, lens, T))


LEFT_BODY, RIGHT_BODY = np.eye(4), np.eye(4)
LEFT_BODY[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.9]).as_matrix()
LEFT_BODY[:3, 3] = [0.2, -0.1, 0.4]
RIGHT_BODY[:3] = LEFT_BODY[:3] @ head("none").T_left_right


def kalibr(lens: Lens, **motions: np.ndarray) -> dict:
    """Return a camera in the layout of Kalibr."""
    return {
        "camera_model": "pinhole",
        "intrinsics": [*lens.focal_px, *lens.center_px],
        "distortion_model": "radtan",
        "distortion_coeffs": list(lens.coefficients),
        "resolution": list(lens.size_px),
    } | {name: T.tolist() for name, T in motions.items()}


def opencv(calibration: StereoCalibration) -> dict:
    """Return a pair in the layout of OpenCV."""
    T_right_left = np.linalg.inv(calibration.T_left_right)
    found = {"image_width": 640, "image_height": 400}
    matrices = {"R": T_right_left[:3, :3], "T": T_right_left[:3, 3:]}
    for n, lens in enumerate((calibration.left, calibration.right), start=1):
        (fu, fv), (cu, cv) = lens.focal_px, lens.center_px
        matrices |= {f"K{n}": np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 1]])}
        matrices |= {f"D{n}": np.array([[*lens.coefficients, *[0.0] * 6]])}
    for name, values in matrices.items():
        rows, cols = values.shape
        found[name] = {"rows": rows, "cols": cols, "dt": "d", "data": values.ravel().tolist()}
    return found


@pytest.mark.parametrize("layout", ["T_cn_cnm1", "T_imu_cam", "T_cam_imu", "opencv"])
def test_layouts_of_calibration_files_agree(layout: str) -> None:
    """OpenVINS states each camera in the IMU's frame, and no camera in the other one's."""
    expected = head("rational")
    lenses, bodies = (expected.left, expected.right), (LEFT_BODY, RIGHT_BODY)
    if layout == "opencv":
        document = opencv(expected)
    elif layout == "T_cn_cnm1":
        T_right_left = np.linalg.inv(expected.T_left_right)
        motions = ({}, {"T_cn_cnm1": T_right_left})
        pairs = zip(("cam0", "cam1"), lenses, motions, strict=True)
        document = {name: kalibr(lens, **motion) for name, lens, motion in pairs}
    else:
        turned = bodies if layout == "T_imu_cam" else tuple(map(np.linalg.inv, bodies))
        pairs = zip(("cam0", "cam1"), lenses, turned, strict=True)
        document = {name: kalibr(lens, **{layout: T}) for name, lens, T in pairs}
    found, mount = read_stereo_calibration(Path("pair.yaml"), document)
    assert mount is None
    assert (found.left, found.right) == (expected.left, expected.right)
    np.testing.assert_allclose(found.T_left_right, expected.T_left_right, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("R"), "pair.yaml: R: is missing, expected a matrix of 9 numbers"),
        (lambda d: d["K2"].update(data=[1.0, 2.0]), "pair.yaml: K2: is 2 numbers, expected"),
        (lambda d: d.pop("image_width"), "pair.yaml: image_width and image_height: are missing"),
        (lambda d: d["T"].update(data=[1.0, 0.0, 0.0]), "pair.yaml: the right camera stands"),
        (lambda d: d["D1"].update(data=[1.0] * 14), "pair.yaml: K1 and D1: distortion_coeff"),
    ],
)
def test_a_damaged_opencv_file_is_one_line(change, words: str) -> None:
    document = opencv(head("rational"))
    change(document)
    with pytest.raises(InputError, match=words):
        read_stereo_calibration(Path("pair.yaml"), document)


def test_files_that_opencv_writes_are_read(tmp_path: Path) -> None:
    path, expected = tmp_path / "pair.yaml", head("rational")
    written = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in opencv(expected).items():
        is_matrix = isinstance(value, dict)
        shaped = np.reshape(value["data"], (value["rows"], value["cols"])) if is_matrix else value
        written.write(name, shaped)
    written.release()
    assert "!!opencv-matrix" in path.read_text()
    found, _ = read_stereo_calibration(path, read_calibration(path))
    assert (found.left, found.right) == (expected.left, expected.right)
    np.testing.assert_allclose(found.T_left_right, expected.T_left_right, atol=1e-12)
