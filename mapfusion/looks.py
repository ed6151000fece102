"""By what points are recognised: labels and descriptors, as columns of tables."""

import numpy as np
import pyarrow as pa

from mapfusion.open_tables import told
from mapfusion.storage import column

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
