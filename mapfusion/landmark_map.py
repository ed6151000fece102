"""Landmark map of one robot in its own frame, and its files.

A map is one file with one row a landmark: Parquet, readable with plain pandas, or CSV, PLY or g2o.
It contains the descriptor (or label) of the observation that created each landmark. Files beside a
Parquet map hold the joint covariance of the landmarks' errors and the viewing evidence, if they are
known.

The file of a joint covariance stores the independent part of each landmark's covariance in double
precision, and the effect of the shared variables in single precision.
"""

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from mapfusion.camera import EXACT, CalibrationError, calibration_from
from mapfusion.descriptors import USURF, DescriptorKind, as_vectors
from mapfusion.errors import InputError, TellingWarning
from mapfusion.exchange import g2o_text, ply_text
from mapfusion.files import (
    COVARIANCE_FIELDS,
    POSITION_FIELDS,
    Write,
    column,
    covariance_columns,
    covariances_from,
    described,
    float_fields,
    name_in_text,
    named_columns,
    point_columns,
    point_fields,
    points_from,
    read_parquet,
    require_cells,
    require_kind,
    schema,
    table_write,
    text_attributes,
    write_all_atomically,
)
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import (
    Float,
    require_finite,
    require_no_twins,
    require_points,
    require_shape,
    with_rows,
)
from mapfusion.tables import (
    APPEARANCE_FIELDS,
    HEIGHT,
    NO_LABEL,
    appearance_columns,
    appearance_from,
    appearance_schema,
    csv_bytes,
    is_alone,
    read_open_table,
    require_appearance,
)
from mapfusion.viewing import Viewing, read_viewing, viewing_writes

if TYPE_CHECKING:  # maps are read and written without data frames
    import pandas as pd

_OWN_FIELDS = [f"own_{name}" for name in COVARIANCE_FIELDS]
# Largest difference of marginal covariances as a share of the trace; errors of single precision are
# much smaller.
_MARGINAL_TOLERANCE = 1e-4
_KIND = "joint_covariance"
# Attribute of the file: the map's covariances are "marginal", or "conditional" on the path.
_GIVEN = "map_covariance"


def joint_schema(rank: int) -> pa.Schema:
    """Return the schema of a joint covariance with R shared variables."""
    cell = pa.list_(pa.float32(), 3 * rank)
    own = (
        described(field, "independent part of the landmark's covariance")
        for field in float_fields(_OWN_FIELDS)
    )
    moved = "shift per sigma of each of R shared variables: x, y, z of the first, ..."
    return schema(_KIND, 1, [*own, described(pa.field("common_m", cell), moved)])


def joint_path(map_path: Path) -> Path:
    """Return the path of the joint covariance beside a map's file."""
    return map_path.with_suffix(".joint.parquet")


def joint_writes(
    map_path: Path, joint: JointCovariance | None, covariance_m2: Float
) -> dict[Path, Write]:
    """Return the writes of the file beside a map's file; None removes this file."""
    path = joint_path(map_path)
    if joint is None:
        return {path: None}
    rank = max(joint.rank, 1)  # a list type needs at least one number
    common = np.zeros((len(joint), rank, 3), dtype=np.float32)
    common[:, : joint.rank] = joint.common_m
    columns = covariance_columns(_OWN_FIELDS, joint.own_m2)
    columns |= {"common_m": common.reshape(-1, 3 * rank)}
    given = "conditional" if len(_other_marginals(joint, covariance_m2)) else "marginal"
    return {path: table_write(columns, joint_schema(rank), {_GIVEN: given})}


def _other_marginals(joint: JointCovariance, covariance_m2: Float) -> np.ndarray:
    """Return the rows of a map whose covariances (N, 3, 3) are not the marginals."""
    off = np.abs(joint.marginal_m2 - covariance_m2).max(axis=(1, 2), initial=0.0)
    return np.flatnonzero(off > _MARGINAL_TOLERANCE * np.trace(covariance_m2, axis1=1, axis2=2))


def read_joint(map_path: Path, covariance_m2: Float) -> JointCovariance | None:
    """Read the joint covariance beside a map's file; None if there is none.

    Args:
        map_path: file of the map.
        covariance_m2: (N, 3, 3) covariances of the map's landmarks.

    Raises:
        InputError: the file is damaged, has another version or belongs to another map.
    """
    path = joint_path(map_path)
    if not path.is_file():
        return None
    table = read_parquet(path, f"{_KIND} table")
    known = "common_m" in table.column_names
    cell = table.schema.field("common_m").type if known else pa.null()
    rank = cell.list_size // 3 if pa.types.is_fixed_size_list(cell) else 1
    attributes = text_attributes(path, table)
    require_kind(path, table, attributes, joint_schema(rank))
    try:
        common = column(table, "common_m").astype(np.float64).reshape(table.num_rows, rank, 3)
        joint = JointCovariance(covariances_from(table, _OWN_FIELDS), common)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if len(joint) != len(covariance_m2):
        own = f"of {len(joint)} landmarks, {map_path.name} has {len(covariance_m2)}"
        raise InputError(f"{path}: {own}; remove it, or give the map that it belongs to")
    wrong = _other_marginals(joint, covariance_m2)
    if len(wrong) and attributes.get(_GIVEN) != "conditional":
        other = f"another covariance than {map_path.name} in row {wrong[0]}"
        raise InputError(f"{path}: {other}; remove it, or give the map that it belongs to")
    return joint


ATTRIBUTE_FIELDS = [
    described(pa.field("size_m", pa.float64()), "size of the landmark, empty for none", np.nan),
    described(pa.field("category", pa.int32()), "class of the landmark, -1 for none", NO_LABEL),
]
LANDMARKS = schema(
    "landmark_map",
    3,  # 2 had descriptors of 64 numbers only
    [
        *(described(field, "in the map frame") for field in point_fields()),
        described(pa.field("count", pa.int32()), "number of observations of the landmark", 1),
        described(
            pa.field("source_observation", pa.int64()),
            "row of the log that created the landmark, -1 for none",
            -1,
        ),
        *ATTRIBUTE_FIELDS,
        *APPEARANCE_FIELDS,
    ],
)


@dataclass(frozen=True)
class LandmarkMap:
    """Map of N landmarks.

    Attributes:
        position_m: (N, 3).
        covariance_m2: (N, 3, 3).
        count: (N,) int32 number of observations of each landmark.
        source_observation: (N,) int64 row in the robot's log of the observation that created it.
        descriptor: (N, D) float32 vectors, NaN for none; or None. Packed bits (N, B) uint8 become
            vectors of bits.
        label: (N,) int32, or None.
        size_m: (N,) size of each landmark, such as a diameter, NaN for none; or None.
        category: (N,) int32 class of each landmark, -1 for none; or None.
        planar: z is 0 and carries no information (2 degrees of freedom).
        name: name of the map.
        joint: joint covariance of the landmarks' errors, or None. Its marginals are covariance_m2,
            or larger if covariance_m2 is conditional on the path (a map of the filter).
        viewing: viewing evidence, or None.
        calibration: error of the camera calibration, which all landmarks share; neither covariance
            includes it.
        descriptor_kind: kind of the descriptors; None: that of the numbers (see `as_vectors`).
    """

    position_m: Float
    covariance_m2: Float
    count: np.ndarray
    source_observation: np.ndarray
    descriptor: np.ndarray | None = None
    label: np.ndarray | None = None
    planar: bool = False
    name: str = "map"
    joint: JointCovariance | None = None
    viewing: Viewing | None = None
    calibration: CalibrationError = EXACT
    size_m: Float | None = None
    category: np.ndarray | None = None
    descriptor_kind: DescriptorKind | None = None

    def __post_init__(self) -> None:
        n = len(self.position_m)
        require_shape("position_m", self.position_m, (n, 3))
        require_shape("covariance_m2", self.covariance_m2, (n, 3, 3))
        require_shape("count", self.count, (n,))
        require_shape("source_observation", self.source_observation, (n,))
        require_finite("position_m", self.position_m)
        require_finite("covariance_m2", self.covariance_m2)
        if self.descriptor is None:
            object.__setattr__(self, "descriptor_kind", None)
        else:
            require_shape("descriptor", self.descriptor, (n, None))
            descriptor, kind = as_vectors(self.descriptor, self.descriptor_kind)
            object.__setattr__(self, "descriptor", descriptor)
            object.__setattr__(self, "descriptor_kind", kind)
        for name in ("label", "size_m", "category"):
            if getattr(self, name) is not None:
                require_shape(name, getattr(self, name), (n,))
        if self.joint is not None and len(self.joint) != n:
            raise ValueError(f"joint: of {len(self.joint)} landmarks, the map has {n}")
        if self.viewing is not None and len(self.viewing) != n:
            raise ValueError(f"viewing: of {len(self.viewing)} landmarks, the map has {n}")

    @property
    def n_dimensions(self) -> int:
        """Number of estimated coordinates of a landmark: 2 in planar maps, else 3."""
        return 2 if self.planar else 3

    @property
    def called(self) -> str:
        """Name in messages: `map NAME`, or NAME alone if it begins with the word map."""
        return (
            self.name if re.match(r"map(?![a-z])", self.name, re.IGNORECASE) else f"map {self.name}"
        )

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, rows: np.ndarray) -> "LandmarkMap":
        joint = None if self.joint is None else self.joint[rows]
        viewing = None if self.viewing is None else self.viewing[rows]
        bare = with_rows(replace(self, joint=None, viewing=None), rows)
        return replace(bare, joint=joint, viewing=viewing)

    def __repr__(self) -> str:
        own = [name for name in ("descriptor", "label") if getattr(self, name) is not None]
        looks = f", with {' and '.join(f'{each}s' for each in own)}" if own else ""
        where = " in the plane" if self.planar else ""
        return f"<LandmarkMap {self.name}: {len(self)} landmarks{where}{looks}>"

    def to_pandas(self) -> "pd.DataFrame":
        """Return the landmarks as a table with the columns of a map's file."""
        import pandas as pd

        columns = _known_columns(self)
        return pd.DataFrame(
            {n: each if each.ndim == 1 else list(each) for n, each in columns.items()}
        )

    @classmethod
    def from_pandas(
        cls,
        table: "pd.DataFrame",
        name: str = "map",
        sigma_m: float | None = None,
        descriptor_metric: str = "",
    ) -> "LandmarkMap":
        """Return the map of a table with the columns of a map's file.

        `sigma_m` is the standard deviation per axis of landmarks without columns of covariances,
        `descriptor_metric` the metric of descriptors that are neither Euclidean nor of type uint8.

        Raises:
            InputError: the table is not as documented.
        """
        content = pa.Table.from_pandas(table, preserve_index=False)
        return replace(_map_from(Path(name), content, sigma_m, descriptor_metric), name=name)


MAP_ENDINGS = (".parquet", ".csv", ".ply", ".g2o")  # of the files that `write_map` writes


def write_map(path: str | Path, landmarks: LandmarkMap) -> None:
    """Write a map as Parquet, CSV, PLY or g2o, by the ending of the path; replaces the file.

    The joint covariance and the viewing evidence of a Parquet map are written beside it. A map of
    another kind is one file without these; g2o has neither descriptors, labels nor counts. A
    TellingWarning names the omitted parts.

    Raises:
        InputError: the path has another ending, or the map has no form of this kind.
        OSError: a file cannot be written; existing files are then unchanged.
    """
    write_all_atomically(map_writes(Path(path), landmarks))


def map_writes(path: Path, landmarks: LandmarkMap) -> dict[Path, Write]:
    """Return the writes and removals of `write_map`, by file."""
    if path.suffix.lower() not in MAP_ENDINGS:
        raise InputError(f"{path}: maps are written as {' or '.join(MAP_ENDINGS)}")
    kind = path.suffix.lower().removeprefix(".")
    if kind != "parquet":
        parts = {
            "joint covariance": landmarks.joint is not None,
            "viewing evidence": landmarks.viewing is not None,
            "calibration error": landmarks.calibration != EXACT,
        }
        if kind == "g2o":
            parts |= {"descriptors": landmarks.descriptor is not None}
            parts |= {"labels": landmarks.label is not None}
            parts |= {"sizes": landmarks.size_m is not None}
            parts |= {"categories": landmarks.category is not None}
        if lost := [name for name, there in parts.items() if there]:
            format_name = kind if kind == "g2o" else kind.upper()
            lost_text = " and ".join(lost)
            warning = f"{path}: {format_name} cannot hold the map's {lost_text}; .parquet keeps all"
            warnings.warn(warning, TellingWarning, stacklevel=3)
        try:
            if kind == "csv":
                text = csv_bytes(_known_columns(landmarks))
            elif kind == "ply":
                text = coloured_ply(landmarks).encode()
            else:
                p, covariance_m2 = landmarks.position_m, landmarks.covariance_m2
                text = g2o_text(p, covariance_m2, landmarks.name, landmarks.planar).encode()
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error
        return {path: lambda temporary: temporary.write_bytes(text)}
    kind_of, n = landmarks.descriptor_kind, len(landmarks)
    looks = appearance_columns(n, landmarks.descriptor, landmarks.label, kind_of)
    columns = _columns(landmarks) | looks
    attributes = {"name": landmarks.name, "planar": str(landmarks.planar).lower()}
    attributes |= landmarks.calibration.attributes()
    attributes |= {} if kind_of is None else kind_of.attributes()
    return {
        path: table_write(columns, appearance_schema(LANDMARKS, looks), attributes),
        **joint_writes(path, landmarks.joint, landmarks.covariance_m2),
        **viewing_writes(path, landmarks.viewing),
    }


def _columns(landmarks: LandmarkMap) -> dict[str, np.ndarray]:
    """Return all columns but those of the appearance, by name."""
    n, size_m, category = len(landmarks), landmarks.size_m, landmarks.category
    none = np.full(n, NO_LABEL, np.int32)
    return {
        **point_columns(landmarks.position_m, landmarks.covariance_m2),
        "count": landmarks.count.astype(np.int32),
        "source_observation": landmarks.source_observation.astype(np.int64),
        "size_m": np.full(n, np.nan) if size_m is None else size_m,
        "category": none if category is None else category.astype(np.int32),
    }


def _known_columns(landmarks: LandmarkMap) -> dict[str, np.ndarray]:
    """Return the columns of a map without those that hold nothing.

    Without metadata, the name of the descriptors' column states their metric, unless they are those
    of U-SURF. Packed bits with gaps are floats, NaN for none.
    """
    kind = landmarks.descriptor_kind
    given = appearance_columns(len(landmarks), landmarks.descriptor, landmarks.label, kind)
    appearance = {
        name: each for name, each in given.items() if getattr(landmarks, name) is not None
    }
    if kind is not None and kind != USURF:
        looks = appearance.pop("descriptor")
        if np.ma.is_masked(looks):
            looks = np.ma.MaskedArray(looks, dtype=np.float32).filled(np.nan)
        appearance[f"descriptor_{kind.metric}"] = np.asarray(looks)
    absent = set(HEIGHT) if landmarks.planar else set()
    absent |= {name for name in ("size_m", "category") if getattr(landmarks, name) is None}
    kept = {name: each for name, each in _columns(landmarks).items() if name not in absent}
    return kept | appearance


def coloured_ply(landmarks: LandmarkMap, rgb: np.ndarray | None = None) -> str:
    """Return a map as a PLY point cloud, with a colour (N, 3), 0 to 255, for each landmark.

    Properties are x, y, z in metres in the frame of the map (z is 0 in planar maps); red, green,
    blue if they are given; and the columns of the map's table.
    """
    columns = _known_columns(landmarks)
    xyz = named_columns(POSITION_FIELDS, landmarks.position_m)
    if rgb is not None:
        require_shape("rgb", rgb, (len(landmarks), 3))
        xyz |= named_columns(("red", "green", "blue"), rgb.astype(np.uint8))
    return ply_text(xyz | columns, landmarks.name, landmarks.planar)


def read_map(
    path: str | Path,
    alone: bool = False,
    sigma_m: float | None = None,
    descriptor_metric: str = "",
) -> LandmarkMap:
    """Read a map.

    The files beside a Parquet map are read, too, unless `alone` is True. Files beside a map of
    another kind are not read, since they belong to the Parquet map of the same name. `sigma_m` is
    the standard deviation per axis of the landmarks of a map without columns of covariances,
    `descriptor_metric` the metric of descriptors whose file states none.

    Raises:
        InputError: a file is missing, damaged or not as documented.
    """
    path = Path(path)
    found = _map_from(path, None, sigma_m, descriptor_metric)
    if alone or is_alone(path):
        return found
    viewing = read_viewing(path, len(found))
    return replace(found, joint=read_joint(path, found.covariance_m2), viewing=viewing)


def _map_from(
    path: Path, table: pa.Table | None, sigma_m: float | None, descriptor_metric: str
) -> LandmarkMap:
    """Return the map of a table, or of a file if the table is None; raises InputError."""
    known = LANDMARKS
    if sigma_m is not None:  # missing covariances are those of one sigma
        variances = ("cov_xx_m2", "cov_yy_m2", "cov_zz_m2")
        usual = {name: sigma_m**2 if name in variances else 0.0 for name in COVARIANCE_FIELDS}
        fields = [
            described(field, "", usual[field.name]) if field.name in usual else field
            for field in LANDMARKS
        ]
        known = pa.schema(fields, LANDMARKS.metadata)
    table, attributes = read_open_table(path, known, table, descriptor_metric)
    finite = "give a finite number, or remove the row"
    require_cells(path, table, [*POSITION_FIELDS, *COVARIANCE_FIELDS], np.isfinite, finite)
    counted = "a landmark has at least one observation"
    require_cells(path, table, ["count"], lambda count: count >= 1, counted)
    of_log = "give -1 for none, or a row of the log: 0 and more"
    require_cells(path, table, ["source_observation"], lambda row: row >= -1, of_log)
    require_appearance(path, table)
    known_size = "a size is positive, or empty for none"
    require_cells(path, table, ["size_m"], lambda size: ~(size <= 0) & ~np.isinf(size), known_size)
    known_category = f"categories are {NO_LABEL} for none, or 0 and more"
    require_cells(path, table, ["category"], lambda each: each >= NO_LABEL, known_category)
    size_m, category = column(table, "size_m"), column(table, "category")
    position, covariance = points_from(table)
    planar = attributes.get("planar") == "true"
    descriptor, label, kind = appearance_from(path, table, attributes)
    try:
        found = LandmarkMap(
            position,
            covariance,
            column(table, "count"),
            column(table, "source_observation"),
            descriptor,
            label,
            planar,
            attributes.get("name", name_in_text(path.stem)),
            calibration=calibration_from(attributes, path),
            size_m=None if np.isnan(size_m).all() else size_m,
            category=None if np.all(category == NO_LABEL) else category,
            descriptor_kind=kind,
        )
        require_points(position, covariance, planar)
        require_no_twins("landmarks", position, covariance.reshape(-1, 9))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return found
