"""Point clouds (PLY) and pose graphs (g2o) of other programs: write and read them.

PLY: Turk (1994), "The PLY polygon file format". A vertex is a landmark, and its further properties
have the names of the columns of a map.

g2o: Kuemmerle, Grisetti, Strasdat, Konolige, Burgard (2011), "g2o: A general framework for graph
optimization". The error of an EDGE_SE2 with measurement Z is Z^-1 (X_i^-1 X_j), whose position is
in the frame at the end of Z. Covariances of this package are in the frame at the start and are
therefore rotated. A map is a graph with one fixed pose, the origin of the map, from which each
landmark is observed once with its covariance.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSITION_FIELDS,
    covariance_columns,
    named_columns,
)
from mapfusion.geometry.numerics import Float, require_shape
from mapfusion.geometry.se2 import rotation, rotation_about_z

_UPPER_3, _UPPER_2 = np.triu_indices(3), np.triu_indices(2)
_PLANAR, _NAME = "planar", "map "  # comments of a PLY file: heights mean nothing; name of the map
_VERTEX_NAMES = dict(zip(POSITION_FIELDS, "xyz", strict=True))  # viewers know x, y and z
# Types of PLY with their names of before and after 2000, and NumPy's.
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_LARGEST_INT = 2**31 - 1  # PLY has no wider integers; doubles are exact up to 2^53
_MAX_HEADER_BYTES = 1_000_000  # thousands of properties; a longer header is no PLY file


def ply_text(columns: Mapping[str, np.ndarray], name: str, planar: bool) -> str:
    """Return columns of points as an ASCII PLY file; reading it restores every number exactly.

    Args:
        columns: arrays (N,) or (N, k) by name; `x_m`, `y_m` and `z_m` become x, y and z, and a
            column (N, k) becomes k properties NAME_0, NAME_1, ...
        name: name of the map.
        planar: the heights mean nothing.
    """
    header, cells = list[str](), list[list[str]]()
    for column, values in columns.items():
        apart = [values] if values.ndim == 1 else list(values.T)
        for k, each in enumerate(apart):
            if each.dtype == np.uint8:
                kind = "uchar"
            elif each.dtype == np.float32:
                kind = "float"
            elif each.dtype.kind == "i" and np.abs(each).max(initial=0) <= _LARGEST_INT:
                kind = "int"
            else:
                kind = "double"
            own = column if values.ndim == 1 else f"{column}_{k}"
            header.append(f"property {kind} {_VERTEX_NAMES.get(column, own)}")
            cells.append([str(cell) for cell in each])
    n = len(cells[0])
    comments = [f"comment {_NAME}{' '.join(name.split())}", "comment metres"]
    comments += [f"comment {_PLANAR}"] if planar else []
    head = ["ply", "format ascii 1.0", *comments, f"element vertex {n}", *header, "end_header"]
    return "\n".join([*head, *map(" ".join, zip(*cells, strict=True)), ""])


def read_ply(path: Path, what: str) -> pa.Table:
    """Read the vertices of a PLY file, ASCII or binary, as a table of points.

    Columns have the names of the properties; x, y and z become `x_m`, `y_m` and `z_m`. Without
    heights that mean something there is no column of a height.

    Raises:
        InputError: the file is missing, damaged or has no vertices with plain properties.
    """
    data = _bytes_of(path, what)
    order, n_text, properties, comments, start = _ply_header(path, data)
    try:
        n = int(n_text)
        if order:
            row = np.dtype([(name, order + _TYPES[kind]) for kind, name in properties])
            rows = np.frombuffer(data, row, n, start)
            values = {
                name: rows[name].astype(row[name].newbyteorder("=")) for _, name in properties
            }
        else:
            cells = [line.split() for line in data[start:].decode("ascii").splitlines()[:n]]
            if len(cells) < n or any(len(each) != len(properties) for each in cells):
                raise ValueError(f"expected {n} lines of {len(properties)} numbers")
            matrix = np.array(cells, np.float64).reshape(n, len(properties))
            values = {name: matrix[:, k] for k, (_, name) in enumerate(properties)}
    except (ValueError, IndexError, TypeError) as error:
        raise InputError(f"{path}: not readable as PLY ({error})") from error
    known = {short: name for name, short in _VERTEX_NAMES.items()}
    flat = _PLANAR in comments
    kept = {
        known.get(name, name): column
        for name, column in values.items()
        if not (flat and (name == "z" or (name.startswith("cov_") and "z" in name)))
    }
    names = [each.removeprefix(_NAME) for each in comments if each.startswith(_NAME)]
    metadata = {"mapfusion.name": names[0]} if names else None
    return pa.table(kept).replace_schema_metadata(metadata)


def _ply_header(path: Path, data: bytes) -> tuple[str, str, list[list[str]], list[str], int]:
    """Parse the header of a PLY file.

    Returns:
        Byte order of numbers, empty for ASCII; number of vertices as written; type and name of each
        property; comments; and the position of the first vertex.
    """
    lines, start = list[str](), 0
    while not lines or lines[-1] != "end_header":
        end = data.find(b"\n", start, start + _MAX_HEADER_BYTES)
        if end < 0 or (not lines and data[:3] != b"ply"):
            raise InputError(f"{path}: not readable as PLY (no header from ply to end_header)")
        lines.append(data[start:end].decode("utf-8", "replace").strip())
        start = end + 1
    words = [line.split() for line in lines]
    form = next((each[1] for each in words if each[0:1] == ["format"] and len(each) == 3), "")
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    elements = [k for k, each in enumerate(words) if each[0:1] == ["element"]]
    if order is None or not elements or words[elements[0]][1:2] != ["vertex"]:
        raise InputError(f"{path}: not readable as PLY (format {form or 'unknown'}, no vertices)")
    last = elements[1] if len(elements) > 1 else len(words) - 1
    properties = [each[1:] for each in words[elements[0] + 1 : last] if each[0:1] == ["property"]]
    if not all(len(each) == 2 and each[0] in _TYPES for each in properties) or not properties:
        raise InputError(f"{path}: a property of the vertices is no single number")
    comments = [" ".join(each[1:]) for each in words if each[0:1] == ["comment"]]
    n_text = " ".join(words[elements[0]][2:3])  # empty if it is missing
    return order, n_text, properties, comments, start


def _bytes_of(path: Path, what: str) -> bytes:
    if not path.is_file():
        raise InputError(f"{path}: no such file (expected a {what} table)")
    return path.read_bytes()


class _Dimensions(NamedTuple):
    """Lines of g2o for landmarks in the plane or in space, and the pose that observes them."""

    landmark: str
    edge: str
    pose: str
    head: tuple[str, ...]  # numbers of an edge before the measurement
    size: int


_ORIGIN_2D, _ORIGIN_3D = "VERTEX_SE2 0 0 0 0", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1"
_SENSOR_3D = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"  # the sensor is at the pose
_PLANE = _Dimensions("VERTEX_XY", "EDGE_SE2_XY", _ORIGIN_2D, (), 2)
_SPACE = _Dimensions("VERTEX_TRACKXYZ", "EDGE_SE3_TRACKXYZ", _ORIGIN_3D, ("0",), 3)


def g2o_text(position_m: Float, covariance_m2: Float, name: str, planar: bool) -> str:
    """Return a map (N, 3), (N, 3, 3) as a pose graph: one fixed pose that observes each landmark.

    Raises:
        ValueError: a covariance has no inverse.
    """
    kind = _PLANE if planar else _SPACE
    upper = np.triu_indices(kind.size)
    try:
        information = np.linalg.inv(covariance_m2[:, : kind.size, : kind.size])
    except np.linalg.LinAlgError as error:
        raise ValueError("a covariance has no inverse, which g2o needs") from error
    vertices, edges = list[str](), list[str]()
    for k, (p, own) in enumerate(zip(position_m, information, strict=True), start=1):
        place = _text(p[: kind.size].tolist())
        vertices.append(f"{kind.landmark} {k} {place}")
        edges.append(
            " ".join([kind.edge, "0", str(k), *kind.head, place, _text(own[upper].tolist())])
        )
    sensor = [] if planar else [_SENSOR_3D]
    head = [f"# {_NAME}{' '.join(name.split())}, metres", *sensor, kind.pose, "FIX 0"]
    return "\n".join([*head, *vertices, *edges, ""])


def read_g2o(path: Path, what: str) -> pa.Table:
    """Read a map that is a pose graph as `g2o_text` writes it, as a table of points.

    Raises:
        InputError: the file is missing or damaged, has several poses, or a landmark without exactly
            one observation. The covariances of such landmarks are unknown before the graph is
            solved.
    """
    text = _bytes_of(path, what).decode("utf-8", "replace")
    kind, poses, position, observed, name = None, 0, dict[str, Float](), dict[str, Float](), ""
    try:
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split()
            if not name and line.startswith(f"# {_NAME}"):
                name = line.removeprefix(f"# {_NAME}").removesuffix(", metres")
            if not words or words[0].startswith("#"):
                continue
            for each in (_PLANE, _SPACE):
                poses += words[0] == each.pose.split()[0]
                if words[0] == each.landmark:
                    kind = kind or each
                    position[words[1]] = _numbers(words[2:], each.size, number)
                elif words[0] == each.edge:
                    if words[2] in observed:
                        raise ValueError(f"line {number}: landmark {words[2]} is observed again")
                    given = words[3 + len(each.head) :]
                    upper = np.triu_indices(each.size)
                    numbers = _numbers(given, each.size + len(upper[0]), number)
                    information = np.zeros((each.size, each.size))
                    information[upper] = numbers[each.size :]
                    observed[words[2]] = information + np.triu(information, 1).T
        if kind is None or poses != 1 or set(position) != set(observed):
            found = f"{poses} poses, {len(position)} landmarks, {len(observed)} of them observed"
            raise ValueError(f"a map has one pose that observes each landmark; found {found}")
        n, size = len(position), kind.size
        places = np.zeros((n, 3))
        places[:, :size] = list(position.values())
        covariance = np.zeros((n, 3, 3))
        covariance[:, :size, :size] = np.linalg.inv(np.array([observed[key] for key in position]))
    except (ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path}: not readable as a map in g2o ({error})") from error
    # inverses are symmetric up to rounding
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    columns = named_columns(POSITION_FIELDS, places)
    columns |= covariance_columns(COVARIANCE_FIELDS, covariance)
    if size == _PLANE.size:
        columns = {key: each for key, each in columns.items() if "z" not in key}
    metadata = {"mapfusion.name": name} if name else None
    return pa.table(columns).replace_schema_metadata(metadata)


# Keys of GTSAM's symbols have the letter of the robot in the highest byte.
_LETTER_BITS = 56
_N_INFORMATION = {3: 6, 6: 21}  # numbers of an upper triangle
# Poses in space are reduced to the plane. A motion that tilts further is no motion on a floor.
_MAX_TILT_RAD = math.radians(10)


class PlanarPoseGraph(NamedTuple):
    """Poses of several robots and measured motions between them, in the plane.

    Attributes:
        robot: name of the robot of each of the n poses.
        key: key of each pose in its file.
        pairs: rows of the poses i and j of each motion, shape (E, 2).
        T_i_j: measured motions, shape (E, 3).
        covariance: their covariances in the frame of i, shape (E, 3, 3).
        n_left_out: number of motions from or to poses that no file has.
    """

    robot: tuple[str, ...]
    key: tuple[int, ...]
    pairs: np.ndarray
    T_i_j: Float
    covariance: Float
    n_left_out: int


def read_pose_graph(paths: Sequence[Path]) -> PlanarPoseGraph:
    """Read one pose graph of several robots from g2o files, for example one file for each robot.

    The robot of a pose is the letter of its key if this is a symbol of GTSAM. Otherwise it is the
    first word of the last comment above, as `G2oGraph.add_comment` writes it. Motions in space are
    reduced to x, y and yaw. The rotational part of their information is that of a rotation vector,
    as GTSAM has it. A motion that several files contain counts once. Landmarks are left out.

    Raises:
        InputError: a file is missing or damaged, a pose belongs to no robot, or a motion tilts.
    """
    row, robots, motions = dict[int, int](), list[str](), dict[tuple[str, ...], Float]()
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: no such file or folder")
        section, n_before = "", len(robots)
        text = path.read_text(encoding="utf-8", errors="replace")
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split()
            try:
                if words and words[0].startswith("#"):
                    section = line.removeprefix("#").strip().partition(",")[0]
                elif words and words[0] in ("VERTEX_SE2", "VERTEX_SE3:QUAT"):
                    key = int(words[1])
                    letter = chr(key >> _LETTER_BITS) if key >> _LETTER_BITS else section
                    if not letter or not letter.isprintable():
                        raise ValueError("the key of the pose names no robot")
                    if key not in row:
                        row[key] = len(robots)
                        robots.append(letter)
                elif words and words[0] in ("EDGE_SE2", "EDGE_SE3:QUAT"):
                    motions.setdefault(tuple(words), _planar_motion(words, number))
            except (ValueError, IndexError, np.linalg.LinAlgError) as error:
                reason = f"line {number}: {str(error).removeprefix(f'line {number}: ')}"
                raise InputError(
                    f"{path}: not readable as a pose graph in g2o ({reason})"
                ) from error
        if len(robots) == n_before:
            raise InputError(f"{path}: has no poses (VERTEX_SE2 or VERTEX_SE3:QUAT) of its own")
    known = {words: T for words, T in motions.items() if {*map(int, words[1:3])} <= row.keys()}
    pairs = [(row[int(words[1])], row[int(words[2])]) for words in known]
    values = np.array([*known.values()]).reshape(-1, 4, 3)
    return PlanarPoseGraph(
        tuple(robots),
        tuple(row),
        np.array(pairs, dtype=np.int64).reshape(-1, 2),
        values[:, 0],
        values[:, 1:],
        len(motions) - len(known),
    )


def _planar_motion(words: Sequence[str], line: int) -> Float:
    """Return the motion (3,) of an edge and, below it, its covariance (3, 3) in the first frame."""
    is_planar = words[0] == "EDGE_SE2"
    n_pose, size = (3, 3) if is_planar else (7, 6)
    numbers = _numbers(words[3:], n_pose + _N_INFORMATION[size], line)
    information = np.zeros((size, size))
    information[np.triu_indices(size)] = numbers[n_pose:]
    information += np.triu(information, 1).T
    if np.linalg.eigvalsh(information)[0] <= 0:
        raise ValueError("the information of the motion is not positive definite")
    covariance = np.linalg.inv(information)
    T = numbers[:3]
    if not is_planar:
        qx, qy, qz, qw = numbers[3:7] / np.linalg.norm(numbers[3:7])
        if 1 - 2 * (qx * qx + qy * qy) < math.cos(_MAX_TILT_RAD):
            raise ValueError(
                "the motion tilts by more than 10 degrees, but robots drive in a plane"
            )
        yaw_rad = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        T = np.array([numbers[0], numbers[1], yaw_rad])
        covariance = covariance[np.ix_([0, 1, 5], [0, 1, 5])]
    turn = rotation_about_z(T[2])
    return np.vstack([T, turn @ covariance @ turn.T])


def _numbers(words: Sequence[str], count: int, line: int) -> Float:
    values = np.array([float(word) for word in words])
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"line {line}: expected {count} finite numbers")
    return values


class G2oGraph:
    """Pose graph in the g2o format; vertices are numbered from 0 as they are added."""

    def __init__(self) -> None:
        self._vertices: list[str] = []
        self._edges: list[str] = []
        self._n = 0

    def add_comment(self, text: str) -> None:
        """Add a comment line before the following vertices."""
        self._vertices.append(f"# {text}")

    def add_poses(self, T: Float) -> np.ndarray:
        """Add poses (n, 3) in the frame of the graph and return their numbers (n,)."""
        require_shape("T", T, (len(T), 3))
        return self._add("VERTEX_SE2", T)

    def add_points(self, p: Float) -> np.ndarray:
        """Add landmarks (n, 2) in the frame of the graph and return their numbers (n,)."""
        require_shape("p", p, (len(p), 2))
        return self._add("VERTEX_XY", p)

    def _add(self, kind: str, values: Float) -> np.ndarray:
        numbers = np.arange(self._n, self._n + len(values))
        self._n += len(values)
        rows = zip(numbers.tolist(), values.tolist(), strict=True)
        self._vertices += [f"{kind} {number} {_text(row)}" for number, row in rows]
        return numbers

    def add_motion(self, i: int, j: int, T_i_j: Float, covariance: Float) -> None:
        """Add a measured motion (3,) from pose i to j with its covariance (3, 3) in frame i."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(T_i_j[2]).T
        information = turn @ np.linalg.inv(covariance) @ turn.T
        numbers = [*T_i_j.tolist(), *information[_UPPER_3].tolist()]
        self._edges.append(f"EDGE_SE2 {i} {j} {_text(numbers)}")

    def add_sighting(self, i: int, point: int, p_i: Float, covariance: Float) -> None:
        """Add a landmark (2,) observed from pose i with its covariance (2, 2) in frame i."""
        information = np.linalg.inv(covariance)
        numbers = [*p_i.tolist(), *information[_UPPER_2].tolist()]
        self._edges.append(f"EDGE_SE2_XY {i} {point} {_text(numbers)}")

    def text(self) -> str:
        """Return the text of the file; reading it restores every number exactly."""
        return "\n".join([*self._vertices, *self._edges, ""])


def _text(numbers: list[float]) -> str:
    """Return numbers separated by spaces."""
    return " ".join(map(str, numbers))
