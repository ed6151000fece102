"""PLY and g2o files of maps, read by strict readers that share no code with the package."""

from pathlib import Path

import numpy as np
import pytest

from mapfusion.errors import InputError, TellingWarning
from mapfusion.exchange import g2o_text
from mapfusion.landmark_map import LandmarkMap, read_map, write_map

TYPES = {"double": float, "float": float, "int": int, "uchar": int}


def made_map(planar: bool, n: int = 7, seed: int = 0) -> LandmarkMap:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(3)
    position = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-3, 7, (n, 1))
    if planar:
        position[:, 2] = 0.0
        covariance[:, 2] = covariance[:, :, 2] = 0.0
    look = rng.normal(size=(n, 64)).astype(np.float32)
    look[2:3] = np.nan  # a landmark without one
    count, label = rng.integers(1, 9, n).astype(np.int32), np.arange(n, dtype=np.int32)
    return LandmarkMap(position, covariance, count, np.arange(n), look, label, planar, "a map")


def strict_ply(path: Path) -> dict[str, list[float]]:
    """Read a PLY file word by word; anything unexpected is an error."""
    lines = path.read_text(encoding="ascii").split("\n")
    assert lines.pop() == ""
    assert lines[:2] == ["ply", "format ascii 1.0"]
    k, properties = 2, []
    while lines[k].startswith("comment "):
        k += 1
    element, name, count = lines[k].split(" ")
    assert (element, name) == ("element", "vertex")
    for line in lines[k + 1 :]:
        k += 1
        if line == "end_header":
            break
        word, kind, name = line.split(" ")
        assert word == "property"
        properties.append((name, TYPES[kind]))
    rows = [line.split(" ") for line in lines[k + 1 :]]
    assert len(rows) == int(count)
    assert {len(row) for row in rows} <= {len(properties)}
    columns = zip(*rows, strict=True) if rows else [()] * len(properties)
    return {
        name: [kind(cell) for cell in cells]
        for (name, kind), cells in zip(properties, columns, strict=True)
    }


@pytest.mark.parametrize("planar", [True, False])
def test_a_strict_reader_reads_the_point_cloud(tmp_path: Path, planar: bool) -> None:
    own = made_map(planar)
    write_map(tmp_path / "m.ply", own)
    read = strict_ply(tmp_path / "m.ply")
    assert list(read)[:3] == ["x", "y", "z"]  # where viewers look for them
    np.testing.assert_array_equal(np.transpose([read["x"], read["y"], read["z"]]), own.position_m)
    np.testing.assert_array_equal(read["cov_xy_m2"], own.covariance_m2[:, 0, 1])
    assert ("cov_zz_m2" in read) is not planar
    assert (read["count"], read["label"]) == (own.count.tolist(), list(range(7)))


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_a_point_cloud_is_read_back_bit_for_bit(tmp_path: Path, planar: bool, n: int) -> None:
    own = made_map(planar, n)
    write_map(str(tmp_path / "m.ply"), own)
    read = read_map(str(tmp_path / "m.ply"))
    assert (read.name, read.planar) == ("a map", planar)
    for name in ("position_m", "covariance_m2", "count", "source_observation"):
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name))
    for name in ("descriptor", "label") if n else ():
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name))


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_point_clouds_of_other_programs_are_read(tmp_path: Path, order: str) -> None:
    """Made by NumPy, in single precision, with colours and faces that are ignored."""
    row = np.dtype([("x", f"{order}f4"), ("y", f"{order}f4"), ("z", f"{order}f4"), ("red", "u1")])
    row = np.dtype(
        [
            *row.descr,
            *((f"cov_{axes}_m2", f"{order}f8") for axes in ["xx", "xy", "xz", "yy", "yz", "zz"]),
        ]
    )
    points = np.zeros(5, row)
    points["x"], points["y"], points["z"], points["red"] = np.arange(5), 2.5, -1.0, 255
    for axes in ("xx", "yy", "zz"):
        points[f"cov_{axes}_m2"] = 0.25
    names = {f"{order}f4": "float", f"{order}f8": "double", "|u1": "uchar"}
    if order == "<":
        names |= {"<f4": "float32", "<f8": "float64"}
    fields = [f"property {names[kind]} {name}" for name, kind, *_ in row.descr]
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = ["ply", f"format {form} 1.0", "element vertex 5", *fields, "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    path = tmp_path / "other.ply"
    path.write_bytes("\n".join(head).encode() + points.tobytes() + b"\x03" + bytes(12))
    read = read_map(path)
    np.testing.assert_array_equal(read.position_m[:, 0], np.arange(5))
    np.testing.assert_array_equal(read.covariance_m2, np.tile(0.25 * np.eye(3), (5, 1, 1)))
    assert read.name == "other"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"other\.ply: not readable as PLY"):
        read_map(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("solid", "no header"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n", "no header"),
        ("ply\nformat ascii 1.0\nend_header\n", "no vertices"),
        ("ply\nformat text 1.0\nelement vertex 0\nproperty float x\nend_header\n", "format"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n0\n",
            "no single number",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n0\n",
            "expected 2 lines of 1 numbers",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
            "has no column y_m",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n0 0 0\n",
            "has no column cov_xx_m2",
        ),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "m.ply").write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        read_map(tmp_path / "m.ply")
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(f"{tmp_path / 'm.ply'}: ")


def strict_g2o(path: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], list[str]]:
    """Return vertices and the observed (mean, covariance) of each landmark, and all other lines."""
    vertices, observed, others = {}, {}, []
    sizes = {"VERTEX_XY": 2, "VERTEX_TRACKXYZ": 3}
    for line in path.read_text(encoding="ascii").splitlines():
        tag, *words = line.split()
        if tag in sizes:
            vertices[int(words[0])] = np.array(words[1:], float)
            assert len(words) == 1 + sizes[tag]
        elif tag in ("EDGE_SE2_XY", "EDGE_SE3_TRACKXYZ"):
            size = 2 if tag == "EDGE_SE2_XY" else 3
            skipped = 2 if size == 2 else 3  # in space an edge names the sensor's offset
            numbers = np.array(words[skipped:], float)
            assert len(numbers) == size + size * (size + 1) // 2
            information = np.zeros((size, size))
            information[np.triu_indices(size)] = numbers[size:]
            information += np.triu(information, 1).T
            assert words[0] == "0"
            observed[int(words[1])] = (numbers[:size], information)
        elif tag != "#":
            others.append(line)
    return vertices, observed, others


@pytest.mark.parametrize("planar", [True, False])
def test_a_strict_reader_reads_the_graph(tmp_path: Path, planar: bool) -> None:
    own = made_map(planar)
    with pytest.warns(TellingWarning, match="g2o cannot hold the map's descriptors and labels"):
        write_map(tmp_path / "m.g2o", own)
    size = 2 if planar else 3
    vertices, observed, others = strict_g2o(tmp_path / "m.g2o")
    assert list(vertices) == list(observed) == list(range(1, 8))
    assert "FIX 0" in others  # the gauge
    assert len([line for line in others if line.startswith("VERTEX_SE")]) == 1
    for k, S in enumerate(own.covariance_m2[:, :size, :size], start=1):
        mean, information = observed[k]
        np.testing.assert_array_equal(vertices[k], own.position_m[k - 1, :size])
        np.testing.assert_array_equal(mean, vertices[k])  # no error: the graph is solved
        np.testing.assert_allclose(information @ S, np.eye(size), atol=1e-9)
    read = read_map(tmp_path / "m.g2o")
    np.testing.assert_array_equal(read.position_m, own.position_m)
    np.testing.assert_allclose(read.covariance_m2, own.covariance_m2, rtol=1e-9, atol=1e-12)
    assert (read.name, read.planar) == ("a map", planar)
    assert read.label is read.descriptor is None


def test_a_graph_that_is_no_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.g2o"
    own = made_map(True, 2)
    text = g2o_text(own.position_m, own.covariance_m2, "m", True)
    lines = text.splitlines()
    for changed, said in (
        ([*lines, "VERTEX_SE2 9 1 0 0"], "2 poses"),
        ([*lines, lines[-1]], "observed again"),
        (lines[:-1], "2 landmarks, 1 of them observed"),
        ([line + " 1" for line in lines], "expected"),
        (["# nothing"], "0 poses, 0 landmarks"),
    ):
        path.write_text("\n".join(changed))
        with pytest.raises(InputError, match=said) as refused:
            read_map(path)
        assert "\n" not in str(refused.value)
    own.covariance_m2[1] = 0.0
    with pytest.raises(InputError, match="has no inverse"):
        write_map(path, own)
