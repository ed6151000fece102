"""By what points are recognised: labels and descriptors, as columns of tables."""

from pathlib import Path

import numpy as np
import pyarrow as pa

from mapfusion.errors import InputError
from mapfusion.open_tables import told
from mapfusion.storage import column, require_cells

DESCRIPTOR_LENGTH = 64
NO_LABEL = -1
LOOK_FIELDS = [
    told(pa.field("label", pa.int32()), "known identity of the landmark, -1 for none", NO_LABEL),
    told(
        pa.field("descriptor", pa.list_(pa.float32(), DESCRIPTOR_LENGTH)),
        "what it looks like (U-SURF or another), NaN for none",
        np.nan,
    ),
]


def look_columns(
    n: int, descriptor: np.ndarray | None, label: np.ndarray | None
) -> dict[str, np.ndarray]:
    """By what n points are recognised, as the columns of `LOOK_FIELDS`."""
    if descriptor is None:
        descriptor = np.full((n, DESCRIPTOR_LENGTH), np.nan)
    if label is None:
        label = np.full(n, NO_LABEL)
    return {"label": label.astype(np.int32), "descriptor": descriptor.astype(np.float32)}


def looks_from(table: pa.Table) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Descriptors and labels of a table, None where no row has any."""
    descriptor, label = column(table, "descriptor"), column(table, "label")
    return (
        None if np.isnan(descriptor).all() else descriptor,
        None if np.all(label == NO_LABEL) else label,
    )


def require_looks(path: Path, table: pa.Table) -> None:
    """Raise InputError for the first row whose label or descriptor is not as documented."""
    known_label = f"labels are {NO_LABEL} for none, or 0 and more"
    require_cells(path, table, ["label"], lambda label: label >= NO_LABEL, known_label)
    descriptor = column(table, "descriptor")
    unusable = ~np.isfinite(descriptor).all(1) & ~np.isnan(descriptor).all(1)
    if unusable.any():
        row = np.flatnonzero(unusable)[0]
        k = np.flatnonzero(~np.isfinite(descriptor[row]))[0]
        found = f"number {k} is {descriptor[row, k]} in row {row}"
        remedy = "give finite numbers, or leave the whole cell empty"
        raise InputError(f"{path}: column descriptor: {found}; {remedy}")
