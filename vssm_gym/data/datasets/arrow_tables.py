"""Write tables in Apache Parquet, whose library is imported when it is used."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vssm_gym.errors import InputError

INDEX = "__index_level_0__"  # pandas' name of an index that has none


def load_arrow(source: object) -> Any:
    """Import Apache Arrow; raise :class:`InputError` where it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(source, "pyarrow", "this library: pip install -c constraints.txt '.[datasets]'") from error
    return pyarrow


class Table:
    """Write a table to a file, a group of rows at a time; the first one decides the columns."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._writer: Any = None
        self._arrow = load_arrow(path)

    def write(self, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """Add rows: an array or a list for each column, all of one length."""
        table = self._arrow.table({name: _column(self._arrow, values) for name, values in columns.items()})
        if metadata:
            table = table.replace_schema_metadata(metadata)
        if self._writer is None:
            self._writer = self._arrow.parquet.ParquetWriter(self._path, table.schema)
        self._writer.write_table(table)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()


def write_table(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
    """Write a table of one group of rows."""
    table = Table(path)
    table.write(columns, metadata)
    table.close()


def write_texts(path: Path, texts: list[str], number: str) -> None:
    """Write texts with their numbers: pandas reads a frame with the texts as its index and a column ``number``."""
    kinds = {INDEX: ("unicode", "object"), number: ("int64", "int64")}
    columns = [
        {"name": None if name == INDEX else name, "field_name": name, "pandas_type": kind, "numpy_type": numpy}
        | {"metadata": None}
        for name, (kind, numpy) in kinds.items()
    ]
    about = {"index_columns": [INDEX], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    write_table(path, {number: np.arange(len(texts)), INDEX: texts}, {"pandas": json.dumps(about)})


def png(image: np.ndarray) -> bytes:
    """Return an image (height, width, 3) uint8 as the bytes of a PNG file, without loss."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG", compress_level=1)
    return file.getvalue()


def image_column(images: np.ndarray) -> list[dict[str, Any]]:
    """Return images ``(n, height, width, 3)`` uint8 as the entries of a column: PNG files, with no path."""
    return [{"bytes": png(image), "path": None} for image in images]


def _column(arrow: Any, values: Any) -> Any:
    """Return an array ``(n, ...)`` as nested lists, those of one dimension of a fixed length, and a list as it is."""
    if not isinstance(values, np.ndarray):
        if values and isinstance(values[0], dict):
            return arrow.array(values, arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())]))
        return arrow.array(values)
    if values.ndim <= 1 or values.shape[1:] == (1,):
        return arrow.array(np.ascontiguousarray(values).reshape(len(values)))
    column = arrow.array(np.ascontiguousarray(values).ravel())
    if values.ndim == 2:
        return arrow.FixedSizeListArray.from_arrays(column, values.shape[1])
    for axis in range(values.ndim - 1, 0, -1):
        count = int(np.prod(values.shape[:axis]))
        column = arrow.ListArray.from_arrays(np.arange(count + 1, dtype=np.int32) * values.shape[axis], column)
    return column
