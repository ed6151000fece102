"""Tables of maps and logs, written by this program, by other programs, or as CSV.

A file of another program needs no metadata and may omit columns that have a default. Numbers may
have any width, and lists any list type. In CSV, a list consists of columns NAME_0, NAME_1, ... (or
from NAME_1 on). Data without any height column (z_m and its covariances) are planar. A column whose
name is similar to a known name is rejected, since an omitted column may change the meaning of the
data. `mapfusion docs formats` lists all columns.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv

from mapfusion.descriptors import (
    METRICS,
    USURF,
    DescriptorKind,
    as_vectors,
    kind_from,
    pack_bits,
    require_metric,
    stated_metric,
    unpack_bits,
)
from mapfusion.errors import InputError, TellingWarning
from mapfusion.exchange import read_g2o, read_ply
from mapfusion.files import (
    UNREADABLE,
    column,
    default_of,
    described,
    read_parquet,
    require_cells,
    require_file,
    require_kind,
    text_attributes,
)

HEIGHT = ("z_m", "cov_xz_m2", "cov_yz_m2", "cov_zz_m2")
# Other usual names of heights, without units.
_HEIGHT_NAMES = ("z", "height", "elevation", "altitude", "alt", "pos_z", "position_z", "p_z", "pz")
# Norms of packed bits, taken as numbers, differ by 8 % for 32 bytes and by 4 % for 128 bytes.
# SIFT's numbers have one norm, and rounding changes it by less than 1 %.
_SAME_NORM, _LEAST_NORMS = 0.02, 10
_PARQUET_MAGIC = b"PAR1"  # first bytes of a Parquet file, whatever its ending
_OTHER_READERS = {".ply": read_ply, ".g2o": read_g2o}
# Units at the end of the names of columns, other spellings, and their names in messages.
_UNIT = re.compile(
    r"_?(\[.*\]|\(.*\)|(?:(?<=_)|^)(?:rad|deg|[mck]?m)_s|km_?h|degps|[mck]?m2?|met(er|re)s?|ft|feet"
    r"|[mun]?s|rad(ian)?s?|deg(ree)?s?|px)$"
)
_SPELLINGS: dict[str, str] = dict.fromkeys(("meter", "meters", "metre", "metres"), "m")
_SPELLINGS |= {"feet": "ft", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad"}
_SPELLINGS |= {"°": "deg", "sec": "s", "seconds": "s", "degps": "deg_s"}
_UNIT_NAMES = {"deg": "degrees", "mm": "millimetres", "cm": "centimetres", "ft": "feet"}
_UNIT_NAMES |= {"km_h": "kilometres per hour", "kmh": "kilometres per hour"}
_UNIT_NAMES |= {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_UNIT_NAMES |= {"deg_s": "degrees per second", "km": "kilometres", "m": "metres", "s": "seconds"}
# What numbers of a unit are multiplied by, by the unit and the needed unit.
_CONVERSIONS = {
    ("deg", "rad"): "pi/180",
    ("deg_s", "rad_s"): "pi/180",
    ("mm", "m"): "0.001",
    ("cm", "m"): "0.01",
    ("km", "m"): "1000",
    ("ft", "m"): "0.3048",
    ("mm2", "m2"): "1e-6",
    ("cm2", "m2"): "1e-4",
    ("mm_s", "m_s"): "0.001",
    ("cm_s", "m_s"): "0.01",
    ("km_h", "m_s"): "1/3.6",
    ("kmh", "m_s"): "1/3.6",
    ("ms", "s"): "0.001",
    ("us", "s"): "1e-6",
    ("ns", "s"): "1e-9",
}
# Other usual names of labels, and of the numbers of descriptors.
_LABEL_LIKE = re.compile(
    r"((landmark|lm|marker|tag|point|object|feature|beacon|label)_?)?(id|no|nr|number|name|key)"
    r"|labels|landmark|marker|tag|beacon|barcode|identity"
)
_DESCRIPTOR_LIKE = re.compile(
    r"(desc|descr|descriptors|des|feat|feature|features|vec|vector|emb|embedding)(_?\[?\d{1,9}\]?)?"
    r"|f_?\d{1,9}"
)
_NUMBER_LABELS = "number the landmarks 0, 1, 2, ..., with the same number in all maps and logs"
_MAX_NAMED = 3  # columns with similar names in one message
_SEPARATORS = {";": "';'", "\t": "tabs", "|": "'|'", " ": "blanks"}
_MOST_NAMED = 12  # columns in one message


def table_path(folder: Path, name: str) -> Path:
    """Return the path of a table in a folder: NAME.csv if there is no NAME.parquet."""
    parquet, csv = (folder / f"{name}.{kind}" for kind in ("parquet", "csv"))
    return csv if csv.is_file() and not parquet.is_file() else parquet


def is_csv(path: Path) -> bool:
    """Return True for a file whose name ends in `.csv`."""
    return path.suffix.lower() == ".csv"


def is_alone(path: Path) -> bool:
    """Return True for a map in one file that is not Parquet, beside which nothing belongs to it."""
    return is_csv(path) or path.suffix.lower() in _OTHER_READERS


def csv_bytes(columns: Mapping[str, np.ndarray]) -> bytes:
    """Return columns as CSV, from which `read_open_table` recovers every bit.

    A column (N, k) becomes k columns NAME_0, NAME_1, ...; NaN is an empty cell.
    """
    apart = {
        name if values.ndim == 1 else f"{name}_{number}": each
        for name, values in columns.items()
        for number, each in enumerate([values] if values.ndim == 1 else values.T)
    }
    table = pa.table({name: pa.array(each, from_pandas=True) for name, each in apart.items()})
    text = pa.BufferOutputStream()
    pyarrow.csv.write_csv(table, text, pyarrow.csv.WriteOptions(include_header=False))
    return f"{','.join(apart)}\n".encode() + text.getvalue().to_pybytes()


def read_open_table(
    path: Path,
    table_schema: pa.Schema,
    content: pa.Table | None = None,
    descriptor_metric: str = "",
) -> tuple[pa.Table, dict[str, str]]:
    """Read a table written by this or another program.

    Args:
        path: path of the file; its suffix is that of CSV, PLY or g2o, or it is Parquet.
        table_schema: required and optional columns.
        content: table that is not in a file; `path` is then its name in messages.
        descriptor_metric: metric of descriptors whose table states none; empty if unknown.

    Returns:
        The table with the columns of the schema, and its text attributes. The attribute `planar` is
        added for a table without heights, and `descriptor_metric` where a column's name or type
        tells it. Descriptors are vectors of any length, NaN for none.

    Raises:
        InputError: the file is missing, damaged, or of another kind; it lacks a column, has a
            column with a similar name, or a cell without a number.
    """
    kind = table_schema.metadata[b"mapfusion.kind"].decode()
    table = _as_given(path, table_schema) if content is None else content
    attributes, given = text_attributes(path, table), table.column_names
    if twice := sorted({name for name in given if given.count(name) > 1}):
        raise InputError(f"{path}: has two columns {', '.join(twice)}")
    if "descriptor" in table_schema.names:
        table, table_schema, metric = _with_vectors(
            path, table, table_schema, stated_metric(attributes), descriptor_metric
        )
        attributes |= {"descriptor_metric": metric} if metric else {}
    if "kind" in attributes:
        # Files of earlier versions are read, too: later columns have defaults.
        known = int(table_schema.metadata[b"mapfusion.schema_version"])
        version = attributes.get("schema_version", "")
        earlier = version.isdecimal() and 0 < int(version) < known
        if not (earlier and attributes["kind"] == kind):
            require_kind(path, table, attributes, table_schema)
    names = table.column_names
    similar = _similar_names(names, table_schema)
    planar = not set(HEIGHT) & set(names)
    found = {field.name: _column(path, table, field, planar) for field in table_schema}
    if missing := [name for name, values in found.items() if values is None]:
        remedy = f"`mapfusion docs formats` describes the columns of a {kind} table"
        unread = _names_like(_LABEL_LIKE, names, table_schema)
        if here := [name for name in missing if name in similar]:
            remedy = _renaming({name: similar[name] for name in here})
        elif missing == ["label"] and unread:
            remedy = f"if {unread[0]} is the identity of the landmark, rename it to label"
        elif kind == "landmark_map" and {"x_m", "y_m"} & set(missing):
            has = f"it has {', '.join(names[:_MOST_NAMED])}"
            remedy = f"rename the columns of the position, in metres, to x_m and y_m ({has})"
        elif kind == "landmark_map" and {"cov_xx_m2", "cov_yy_m2"} <= set(missing):
            remedy = "`--sigma 0.05` states one standard deviation for all landmarks, in metres"
        raise InputError(f"{path}: has no column {', '.join(missing)}; {remedy}")
    if similar:
        reason = "columns with unknown names are ignored"
        raise InputError(f"{path}: {_renaming(similar)}, or remove it: {reason}")
    _tell_ignored_appearance(path, table, table_schema)
    if planar:
        attributes = {"planar": "true"} | attributes
    plain = [pa.field(field.name, field.type) for field in table_schema]
    columns = pa.table(found, schema=pa.schema(plain))
    return columns, attributes


def _as_given(path: Path, table_schema: pa.Schema) -> pa.Table:
    """Read all columns of a file, with its own names; raises InputError."""
    kind = table_schema.metadata[b"mapfusion.kind"].decode()
    if read := _OTHER_READERS.get(path.suffix.lower()):
        return read(path, kind)
    if is_csv(path):
        return _read_csv(path, table_schema)
    if path.suffix.lower() != ".parquet" and path.is_file():
        with path.open("rb") as file:
            if file.read(len(_PARQUET_MAGIC)) != _PARQUET_MAGIC:
                endings = ", ".join([".csv", ".parquet", *_OTHER_READERS])
                ending = f"has the ending {path.suffix}" if path.suffix else "has no ending"
                raise InputError(
                    f"{path}: {ending}, but tables have {endings}; convert or rename it"
                )
    return read_parquet(path, f"{kind} table")


def columns_as_read(path: Path, table_schema: pa.Schema) -> dict[str, str]:
    """Return the known column that each column of a file is read as; empty for ignored ones.

    Raises:
        InputError: the file is missing or damaged.
    """
    table, descriptors = _as_given(path, table_schema), dict[str, str]()
    if "descriptor" in table_schema.names:
        descriptors, _ = _descriptor_names(path, table)
    known = {name: name for name in table_schema.names} | dict.fromkeys(descriptors, "descriptor")
    return {name: known.get(name, "") for name in table.column_names}


def _names_like(
    pattern: re.Pattern[str], names: Sequence[str], table_schema: pa.Schema
) -> list[str]:
    """Return the unknown columns whose plain names match a pattern."""
    unknown = (name for name in names if name not in table_schema.names)
    return [name for name in unknown if pattern.fullmatch(_plain_name(name))]


def _tell_ignored_appearance(path: Path, table: pa.Table, table_schema: pa.Schema) -> None:
    """Warn of unknown columns that look like labels or descriptors of a table without descriptors.

    In a table with descriptors, such a column usually numbers the rows only.
    """
    names, messages = table.column_names, list[str]()
    if "descriptor" not in table_schema.names or "descriptor" in names:
        return
    columns = _names_like(_DESCRIPTOR_LIKE, names, table_schema)
    if len(columns) > 1:
        wanted = f"descriptor_0 to descriptor_{len(columns) - 1}"
        ignored = f"columns {columns[0]} to {columns[-1]} are ignored"
        messages.append(f"{ignored}; if they are descriptors, name them {wanted}")
    elif columns and pa.types.is_nested(table.schema.field(columns[0]).type):
        messages.append(
            f"column {columns[0]} is ignored; if it holds descriptors, name it descriptor"
        )
    if "label" not in names and (label_columns := _names_like(_LABEL_LIKE, names, table_schema)):
        condition = "if it is the same number wherever a landmark is seen"
        messages.append(f"column {label_columns[0]} is ignored; {condition}, name it label")
    if messages:
        warnings.warn(f"{path}: {'; '.join(messages)}", TellingWarning, stacklevel=3)


def _similar_names(names: Sequence[str], table_schema: pa.Schema) -> dict[str, str]:
    """Return misspelled columns of a table, by the name that the schema gives them.

    Similar names differ only in letter case, blanks, hyphens or the unit. Every usual name of a
    height is similar to z_m, since data without z_m would be read as planar.
    """
    known = {_plain_name(field.name): field.name for field in table_schema}
    known = {_UNIT.sub("", name): field for name, field in known.items()} | known
    if "z_m" in table_schema.names and "z_m" not in names:
        known |= dict.fromkeys(_HEIGHT_NAMES, "z_m")
    similar: dict[str, str] = {}
    for name in names:
        if name in table_schema.names:
            continue
        plain = _plain_name(name)
        known_name = known.get(plain) or known.get(_UNIT.sub("", plain))
        if known_name is not None and known_name not in names:
            similar.setdefault(known_name, name)
    return similar


def _read_csv(path: Path, table_schema: pa.Schema) -> pa.Table:
    """Read a CSV file and strip blanks from its column names; raises InputError."""
    kind = table_schema.metadata[b"mapfusion.kind"].decode()
    require_file(path, f"{kind} table")
    data = path.read_bytes()
    try:
        # Threads of Arrow that still run when the process exits would abort it.
        table = pyarrow.csv.read_csv(
            pa.BufferReader(data), pyarrow.csv.ReadOptions(use_threads=False)
        )
        names = [name.strip() for name in table.column_names]  # fails for names that are not UTF-8
    except UNREADABLE as error:
        _require_dialect(path, data, table_schema)
        raise InputError(f"{path}: not readable as CSV ({error})") from error
    if not set(names) & set(table_schema.names):
        _require_dialect(path, data, table_schema)
    return table.rename_columns(names)


def _require_dialect(path: Path, data: bytes, table_schema: pa.Schema) -> None:
    """Raise InputError if the first line of a CSV file has another separator, or holds no names."""
    first = data.split(b"\n", 1)[0].decode("utf-8-sig", "replace").strip()
    for separator, called in _SEPARATORS.items():
        names = {_plain_name(each.strip("\"'")) for each in first.split(separator)}
        if len(names) > 1 and names & set(table_schema.names):
            raise InputError(f"{path}: is separated by {called}; write it with commas")
    cells = [each for each in re.split(r"[,;\s]+", first.replace('"', "")) if each]
    if cells and all(_is_number(each) for each in cells):
        required = ", ".join(f.name for f in table_schema if default_of(f) is None)
        wanted = f"put one with the columns' names above the numbers ({required}, ...)"
        raise InputError(f"{path}: has no header line; {wanted}")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _column(path: Path, table: pa.Table, field: pa.Field, planar: bool) -> pa.Array | None:
    """Return a column in the type of the schema, or its default; None if it is required."""
    default = 0.0 if planar and field.name in HEIGHT else default_of(field)
    remedy = f"; {_NUMBER_LABELS}" if field.name == "label" else ""
    try:
        if pa.types.is_fixed_size_list(field.type):
            return _rows_of_numbers(path, table, field)
        if field.name not in table.column_names:
            filled = None if default is None else np.full(table.num_rows, default)
            return None if filled is None else pa.array(filled).cast(field.type)
        values = table.column(field.name).combine_chunks()
        is_number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
        if not is_number and values.null_count < len(values):
            raise InputError(f"{path}: column {field.name} {_no_number(values)}{remedy}")
        is_float = pa.types.is_floating(field.type)
        if is_number and not is_float:
            given, limits = values.to_numpy(zero_copy_only=False), np.iinfo(str(field.type))
            inside = (given >= limits.min) & (given <= limits.max) & (np.trunc(given) == given)
            wrong = np.flatnonzero(~inside & ~np.isnan(given))
            if len(wrong):
                found = f"is {given[wrong[0]]:.15g} in row {wrong[0]}"
                wanted = f"expected a whole number up to {limits.max}"
                raise InputError(f"{path}: column {field.name}: {found}, {wanted}{remedy}")
            # pandas stores integers with gaps as floats
            values = pa.array(given, from_pandas=True)
        empty = np.nan if is_float else default  # pandas stores NaN as an empty cell
        if values.null_count and empty is None:
            row = values.is_null().to_pylist().index(True)
            raise InputError(f"{path}: column {field.name} is empty in row {row}")
        values = values.cast(field.type)
        return values.fill_null(pa.scalar(empty, field.type)) if values.null_count else values
    except pa.ArrowException as error:
        reason = f"{' '.join(str(error).split())} (expected {field.type})"
        raise InputError(f"{path}: column {field.name}: {reason}") from error


def _no_number(values: pa.Array) -> str:
    """Return a message about the first cell of a column that holds no number."""
    if pa.types.is_string(values.type) or pa.types.is_large_string(values.type):
        for row, cell in enumerate(values.to_pylist()):
            if cell is not None and not _is_number(cell):
                return f"holds {cell!r} in row {row}, expected a number"
    return f"holds {values.type}, not numbers"


def _rows_of_numbers(path: Path, table: pa.Table, field: pa.Field) -> pa.Array:
    """Return a column of N lists, from one column or NAME_0, NAME_1, ...; NaN if missing."""
    width, n = field.type.list_size, table.num_rows
    pattern = re.compile(re.escape(field.name) + r"_?(\d{1,9})", re.IGNORECASE)
    numbered = {
        int(match[1]): name for name in table.column_names if (match := pattern.fullmatch(name))
    }
    order = sorted(numbered)
    if order and order not in (list(range(width)), list(range(1, width + 1))):
        first, last = numbered[order[0]], numbered[order[-1]]
        found = f"has {len(order)} columns {first} to {last}" if first != last else f"has {first}"
        wanted = f"{field.name}_0 to {field.name}_{width - 1}, {width} of them"
        raise InputError(f"{path}: {found}; expected {wanted}")
    values = None
    if not order and field.name in table.column_names:
        values = table.column(field.name).combine_chunks()
        if values.type == field.type and not values.null_count and not values.flatten().null_count:
            return values
    matrix = np.full((n, width), np.nan)
    for i, name in enumerate(numbered[k] for k in order):
        cells = table.column(name).combine_chunks()
        if cells.null_count == n:
            continue
        if pa.types.is_string(cells.type):
            raise InputError(f"{path}: column {name} {_no_number(cells)}")
        matrix[:, i] = cells.cast(pa.float64()).fill_null(np.nan).to_numpy(zero_copy_only=False)
    if values is not None and values.null_count < n:
        lengths = pc.call_function("list_value_length", [values]).drop_null().unique().to_pylist()
        if lengths != [width]:
            raise pa.ArrowInvalid(f"lists of {sorted(lengths)} numbers")
        there = ~values.is_null().to_numpy(zero_copy_only=False)
        flat = pc.call_function("list_flatten", [values]).cast(pa.float64()).fill_null(np.nan)
        matrix[there] = flat.to_numpy(zero_copy_only=False).reshape(-1, width)
    with np.errstate(over="ignore"):  # infinite numbers are refused by their cell
        flat = pa.array(matrix.ravel().astype(field.type.value_type.to_pandas_dtype()))
    return pa.FixedSizeListArray.from_arrays(flat, type=field.type)


NO_LABEL = -1
APPEARANCE_FIELDS = [
    described(
        pa.field("label", pa.int32()), "known identity of the landmark, -1 for none", NO_LABEL
    ),
    described(
        pa.field("descriptor", pa.list_(pa.float32(), USURF.length)),
        "descriptor of its appearance, of any length (64 is that of U-SURF), NaN for none; packed "
        "bits of the metric hamming are uint8",
        np.nan,
    ),
]
# Names of columns of descriptors: one column of lists, or one column for each number. A metric
# other than the Euclidean one is part of the name where a file has no metadata.
_DESCRIPTOR_COLUMN = re.compile(
    rf"descriptor(?:_(?P<metric>{'|'.join(METRICS)}))?(?:_?(?P<number>\d{{1,9}}))?"
    r"|d_?(?P<short>\d{1,9})",
    re.IGNORECASE,
)


def _with_vectors(
    path: Path, table: pa.Table, table_schema: pa.Schema, stated: str, asked: str
) -> tuple[pa.Table, pa.Schema, str]:
    """Replace the columns of descriptors by one column of vectors.

    Args:
        path: of the table, for messages.
        table: table with any columns.
        table_schema: its schema, with 64 numbers in a descriptor.
        stated: metric that the metadata state; empty if they state none.
        asked: metric that the caller states; empty if unknown.

    Returns:
        The table, the schema with the length of its descriptors, and their metric; empty if
        unknown.

    Raises:
        InputError: metrics contradict each other, or a cell holds no descriptor.
    """
    if asked:
        try:
            require_metric(asked)
        except ValueError as error:
            raise InputError(str(error)) from error
    renamed, metrics = _descriptor_names(path, table)
    if not renamed:
        return table, table_schema, ""
    first = next(iter(renamed))
    cells = table.column(first).type
    is_list = renamed[first] == "descriptor"
    width = _length_of_lists(path, first, table) if is_list else len(renamed)
    number = getattr(cells, "value_type", None) if is_list else cells
    metrics |= {"hamming"} if number == pa.uint8() else set()
    metrics |= {stated} if stated else set()
    if asked and metrics - {asked}:
        found = f"has descriptors of metric {' and '.join(sorted(metrics))}"
        raise InputError(f"{path}: {found}, not {asked}; leave --descriptor-metric out")
    if len(metrics) > 1:
        raise InputError(f"{path}: has descriptors of metrics {' and '.join(sorted(metrics))}")
    metric = asked or next(iter(metrics), "")
    own = table.rename_columns([renamed.get(name, name) for name in table.column_names])
    try:
        field = pa.field("descriptor", pa.list_(pa.float32(), width))
        vectors = _rows_of_numbers(path, own, field)
    except pa.ArrowException as error:
        reason = f"{' '.join(str(error).split())} (expected numbers)"
        raise InputError(f"{path}: column {first}: {reason}") from error
    if metric == "hamming":
        vectors = _unpacked(path, first, vectors, width, own_file=bool(stated))
    vectors = vectors.cast(pa.list_(pa.float32(), vectors.type.list_size))
    place = min(map(own.column_names.index, renamed.values()))
    joined = own.drop_columns(list(renamed.values())).add_column(place, "descriptor", vectors)
    at = table_schema.get_field_index("descriptor")
    known = table_schema.field(at).with_type(vectors.type)
    return joined, table_schema.set(at, known), metric


def _descriptor_names(path: Path, table: pa.Table) -> tuple[dict[str, str], set[str]]:
    """Return the columns of descriptors with their plain names, and the metrics in their names.

    Plain names are `descriptor` of a column of lists, or `descriptor_0` and so on.
    """
    lists, numbered, short = dict[str, str](), dict[str, str](), dict[str, str]()
    metrics = set[str]()
    for name in table.column_names:
        match = _DESCRIPTOR_COLUMN.fullmatch(name)
        if match is None:
            continue
        if match["short"]:
            short[name] = f"descriptor_{int(match['short'])}"
            continue
        metrics |= {match["metric"].lower()} if match["metric"] else set()
        if match["number"] is None:
            lists[name] = "descriptor"
        else:
            numbered[name] = f"descriptor_{int(match['number'])}"
    if not lists and not numbered and len(short) > 1:  # a single column d0 has another meaning
        numbered = short
    if len(lists) > 1 or (lists and numbered):
        both = [*lists, *numbered]
        raise InputError(f"{path}: has two columns of descriptors, {both[0]} and {both[1]}")
    return lists or numbered, metrics


def _length_of_lists(path: Path, name: str, table: pa.Table) -> int:
    """Return the length of the lists of a column; that of U-SURF if all are empty cells."""
    cells = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(cells.type):
        return cells.type.list_size
    if not (pa.types.is_list(cells.type) or pa.types.is_large_list(cells.type)):
        return USURF.length
    lengths = pc.call_function("list_value_length", [cells]).drop_null().unique().to_pylist()
    if len(lengths) > 1 or 0 in lengths:
        found = f"lists of {' and '.join(map(str, sorted(lengths)[:2]))} numbers"
        raise InputError(f"{path}: column {name}: {found}, expected one length")
    return lengths[0] if lengths else USURF.length


def _unpacked(path: Path, name: str, packed: pa.Array, width: int, own_file: bool) -> pa.Array:
    """Return bytes (N, width) of bits as vectors of bits (N, 8 width), NaN for none.

    A TellingWarning names bytes that look like numbers, unless the metadata of the file state the
    metric (`own_file`).
    """
    matrix = packed.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    has_descriptor = np.logical_not(np.all(np.isnan(matrix), axis=1))
    numbers = matrix[has_descriptor]
    wrong = np.argwhere(~((numbers >= 0) & (numbers <= 255) & (numbers == np.floor(numbers))))
    if len(wrong):
        row, number = wrong[0]
        cell = re.sub(r"_0$", f"_{number}", name)  # the first of numbered columns, or one of lists
        found = f"is {numbers[row, number]:g} in row {np.flatnonzero(has_descriptor)[row]}"
        needed = "packed bits are whole numbers from 0 to 255; a row without descriptor has all "
        needed += "its cells empty; numbers that are no bits have the metric euclidean or cosine"
        raise InputError(f"{path}: column {cell}: {found}; {needed}")
    norms = np.linalg.norm(numbers, axis=1)
    if not own_file and len(numbers) >= _LEAST_NORMS and norms.std() < _SAME_NORM * norms.mean():
        found = f"column {name}: is read as packed bits, but all rows have the norm"
        remedy = "numbers of SIFT look so: store them as floats, without the metric hamming"
        text = f"{path}: {found} {norms.mean():.0f}; {remedy}"
        warnings.warn(text, TellingWarning, stacklevel=2)
    bits = np.full((len(matrix), 8 * width), np.nan, np.float32)
    bits[has_descriptor] = unpack_bits(numbers.astype(np.uint8))
    return pa.FixedSizeListArray.from_arrays(pa.array(bits.ravel()), 8 * width)


def appearance_columns(
    n: int,
    descriptor: np.ndarray | None,
    label: np.ndarray | None,
    kind: DescriptorKind | None = None,
) -> dict[str, np.ndarray]:
    """Return descriptors and labels of n points as columns, the inverse of `appearance_from`.

    The column of descriptors is `descriptor`, also for packed bits, of which those without a
    descriptor are masked.
    """
    if descriptor is None:
        descriptor = np.full((n, USURF.length), np.nan)
    if label is None:
        label = np.full(n, NO_LABEL)
    if kind is not None and kind.metric == "hamming":
        absent = np.any(np.isnan(descriptor), axis=1, keepdims=True)
        packed = pack_bits(descriptor)
        vectors = np.ma.MaskedArray(packed, np.broadcast_to(absent, packed.shape))
    else:
        vectors = descriptor.astype(np.float32)
    return {"label": label.astype(np.int32), "descriptor": vectors}


def appearance_schema(table_schema: pa.Schema, columns: Mapping[str, np.ndarray]) -> pa.Schema:
    """Return a schema with the type of the descriptors among some columns."""
    looks = columns["descriptor"]
    number = pa.uint8() if looks.dtype == np.uint8 else pa.float32()
    at = table_schema.get_field_index("descriptor")
    field = table_schema.field(at).with_type(pa.list_(number, looks.shape[1]))
    return table_schema.set(at, field)


def appearance_from(
    path: Path, table: pa.Table, attributes: Mapping[str, str]
) -> tuple[np.ndarray | None, np.ndarray | None, DescriptorKind | None]:
    """Return descriptors and labels of a table, None if no row has any, and the descriptors' kind.

    A TellingWarning names the kind of descriptors that the table does not tell, unless they are
    those of U-SURF.

    Raises:
        InputError: the kind is not as documented, or a descriptor is not of the kind.
    """
    descriptor, label = column(table, "descriptor"), column(table, "label")
    label = None if np.all(label == NO_LABEL) else label
    if np.isnan(descriptor).all():
        return None, label, None
    try:
        stated = kind_from(attributes, descriptor.shape[1])
        descriptor, kind = as_vectors(descriptor, stated)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if stated is None and kind.differs_from(USURF):
        text = f"{path}: descriptors taken as {kind}"
        whole = descriptor[np.isfinite(descriptor)]
        if np.all((whole >= 0) & (whole <= 255) & (whole == np.floor(whole))):
            text += (
                "; if they are packed bits, name the column descriptor_hamming (or give `align` "
            )
            text += "and `merge` --descriptor-metric hamming)"
        warnings.warn(text, TellingWarning, stacklevel=3)
    return descriptor, label, kind


def require_appearance(path: Path, table: pa.Table) -> None:
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


def _plain_name(name: str) -> str:
    """Return a name in lower case, with an underscore for each blank or hyphen."""
    return re.sub(r"[\s-]+", "_", name.strip().lower())


def _renaming(similar: Mapping[str, str]) -> str:
    """Return what to do with columns of similar names, given by the known name.

    Numbers in another unit must be converted, not only renamed.
    """
    converted, renamed = [], []
    for name, there in similar.items():
        unit, needed = _unit_of(there), _unit_of(name)
        factor, called = _CONVERSIONS.get((unit, needed)), _UNIT_NAMES.get(unit, unit)
        if factor:
            converted.append(f"{there} is in {called}: multiply by {factor} and name it {name}")
        elif unit and unit != needed:
            converted.append(f"{there} is in {called}: convert it and name it {name}")
        else:
            renamed.append(f"{there} to {name}")
    asked = [f"rename column {' and '.join(renamed[:_MAX_NAMED])} (mind the unit)"]
    more = ", ..." if max(len(renamed), len(converted)) > _MAX_NAMED else ""
    return "; ".join([*converted[:_MAX_NAMED], *(asked if renamed else [])]) + more


def _unit_of(name: str) -> str:
    """Return the unit at the end of a column's name, in one spelling; empty if there is none."""
    match = _UNIT.search(_plain_name(name))
    unit = match[0].strip("_[]() ") if match else ""
    return _SPELLINGS.get(unit, unit)
