"""Reading Parquet tables that anyone may have written: whole, or a row group at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from improvo.errors import InputError
from improvo.locations import fetched
from improvo.untrusted.arrays import check_array
from improvo.untrusted.limits import MAX_TABLE_BYTES
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import reason

if TYPE_CHECKING:
    import pyarrow as pa

Found = TypeVar("Found")


def read_table(path: Path, schema: pa.Schema) -> pa.Table:
    """The columns of a schema, as it has them, and none of them with gaps.

    Raises:
        InputError: missing, no Parquet, other columns, or many more rows than the file can hold.
    """
    return _checked(path, _reading(path, schema, lambda file: _cast(file.read(columns=schema.names), schema)))


def read_parts(path: Path, schema: pa.Schema, between: tuple[str, int, int] | None = None) -> Iterator[pa.Table]:
    """The row groups of a table, one after another; memory is that of the largest.

    Args:
        path: of the table.
        schema: the columns to read.
        between: column, first and last value; row groups without any of them are left out.

    Raises:
        InputError: as `read_table`.
    """

    def read(number: int) -> pa.Table:
        return _reading(path, schema, lambda file: _cast(file.read_row_group(number, columns=schema.names), schema))

    for number in _reading(path, schema, lambda file: _groups_with(file.metadata, between)):
        yield _checked(path, read(number))


def _reading(path: Path, schema: pa.Schema, read: Callable[[Any], Found]) -> Found:
    """What `read` takes from the open file, whose columns and size are right.

    Raises:
        InputError: see `read_table`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(check_is_file(fetched(path))) as file:
            missing = [name for name in schema.names if name not in file.schema_arrow.names]
            if missing:
                raise InputError(f"{path}: lacks the column(s) {', '.join(missing)}; write it again with this version")
            check_array("rows", (file.metadata.num_rows,), 8 * len(schema.names), _most_bytes(path.stat().st_size))
            return read(file)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; `improvo run` and `improvo label` write it") from None
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read as Parquet ({reason(error)}); write it again") from None


def _cast(table: pa.Table, schema: pa.Schema) -> pa.Table:
    cast = table.select(schema.names).cast(schema)
    cast.validate(full=True)  # else words by number are looked up beyond the list of words
    return cast


def _checked(path: Path, table: pa.Table) -> pa.Table:
    """The table, which has a value everywhere, and no negative numbers of tracks and frames."""
    gaps = [name for name in table.column_names if table[name].null_count]
    if gaps:
        raise InputError(f"{path}: has rows without {', '.join(gaps)}; write it again")
    if any((table[name].to_numpy() < 0).any() for name in ("track", "frame") if name in table.column_names):
        raise InputError(f"{path}: has rows with a negative number; write it again")
    return table


def _groups_with(metadata: Any, between: tuple[str, int, int] | None) -> list[int]:
    """The row groups that may hold such values, by their statistics."""
    numbers = list(range(metadata.num_row_groups))
    if between is None or not numbers:
        return numbers
    name, first, last = between
    column = metadata.schema.names.index(name)

    def may_hold(number: int) -> bool:
        found = metadata.row_group(number).column(column).statistics
        return found is None or not found.has_min_max or (found.min <= last and found.max >= first)

    return [number for number in numbers if may_hold(number)]


def _most_bytes(file_bytes: int) -> int:
    """What a file may hold: compression makes less of our tables, but not a thousandth."""
    return min(MAX_TABLE_BYTES, 1000 * file_bytes + (1 << 24))
