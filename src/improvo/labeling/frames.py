"""The frames behind the labels: by reference to the recording, or packed beside the labels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.sequences.base import UnreadableFrameError
from improvo.stability.tables import read_table
from improvo.types import Float64, Int64, UInt8
from improvo.untrusted.text import reason

if TYPE_CHECKING:
    import pyarrow as pa

FRAMES_FILE = "frames.parquet"
_FRAMES_PER_SHARD = 4096
_FRAMES_PER_GROUP = 32  # what must be read to get at one frame
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class FramesTable:
    """`frames.parquet`: one row per processed frame."""

    frame: Int64  # (F,) index in the processed sequence, as in tracks.parquet
    source_index: Int64  # (F,) index in the recording; the file's column is `index`
    time: Float64  # (F,) seconds
    segment: Int64  # (F,) -1 without a pose
    trusted: NDArray[np.bool_]  # (F,) by the quality gate

    def __len__(self) -> int:
        return len(self.frame)


def frames_schema() -> pa.Schema:
    """One row per processed frame."""
    import pyarrow as pa

    integers = [(name, pa.int32()) for name in ("frame", "index")]
    return pa.schema([*integers, ("time", pa.float64()), ("segment", pa.int32()), ("trusted", pa.bool_())])


def write_frames(path: Path, frames: FramesTable) -> None:
    """Write `frames.parquet`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {
        "frame": frames.frame.astype(np.int32),
        "index": frames.source_index.astype(np.int32),
        "time": frames.time,
        "segment": frames.segment.astype(np.int32),
        "trusted": frames.trusted,
    }
    with written_atomically(path) as temporary:
        pq.write_table(pa.table(columns, frames_schema()), temporary)


def read_frames(path: Path) -> FramesTable:
    """Read `frames.parquet`.

    Raises:
        InputError: missing or damaged.
    """
    table = read_table(path, frames_schema())
    frame, index, time, segment, trusted = (table[name].to_numpy() for name in table.column_names)
    if (np.diff(index) <= 0).any() or (frame != np.arange(len(frame))).any():
        raise InputError(f"{path}: its frames are out of order; run `improvo label` again")
    return FramesTable(
        frame.astype(np.int64), index.astype(np.int64), time, segment.astype(np.int64), trusted.astype(np.bool_)
    )


def pack_images(folder: Path, images: Iterable[UInt8]) -> int:
    """Write the frames, in order, as shards of JPEGs; returns how many."""
    import cv2
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema([("frame", pa.int32()), ("jpeg", pa.binary())])
    group: list[tuple[int, bytes]] = []
    writer: pq.ParquetWriter | None = None
    count = 0

    def flush() -> None:
        if writer is not None and group:
            numbers, pictures = zip(*group, strict=True)
            writer.write_table(pa.table({"frame": numbers, "jpeg": pictures}, schema))
            group.clear()

    try:
        for image in images:
            if count % _FRAMES_PER_SHARD == 0:
                flush()
                if writer is not None:
                    writer.close()
                writer = pq.ParquetWriter(folder / _shard_name(count), schema, compression="none")
            _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            group.append((count, jpeg.tobytes()))
            count += 1
            if len(group) == _FRAMES_PER_GROUP:
                flush()
        flush()
    finally:
        if writer is not None:
            writer.close()
    return count


class PackedImages:
    """Random access to packed frames; keeps the row group that was read last.

    Raises:
        InputError: the folder has no packed frames.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / _shard_name(0)).is_file():
            raise InputError(f"{folder}: has no packed frames; label it with --pack")
        self._folder = folder
        self._group: tuple[int, list[bytes]] = (-1, [])

    def __getitem__(self, frame: int) -> UInt8:
        """The grey image (H, W) of a frame of the processed sequence."""
        import cv2

        from improvo.sequences.images import decode

        number = frame // _FRAMES_PER_GROUP
        try:
            if self._group[0] != number:
                self._group = number, self._read(frame)
            return np.asarray(decode(self._group[1][frame % _FRAMES_PER_GROUP], cv2.IMREAD_GRAYSCALE), np.uint8)
        except (UnreadableFrameError, LookupError, TypeError) as error:
            where = self._folder / _shard_name(frame)
            raise InputError(f"{where}: frame {frame} cannot be read ({reason(error)}); label it again") from None

    def _read(self, frame: int) -> list[bytes]:
        """The pictures of the row group that a frame is in."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = self._folder / _shard_name(frame)
        try:
            file = pq.ParquetFile(path)
            row_group = frame % _FRAMES_PER_SHARD // _FRAMES_PER_GROUP
            return list(file.read_row_group(row_group, columns=["jpeg"])["jpeg"].to_pylist())
        except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as error:
            raise InputError(f"{path}: cannot be read ({reason(error)}); label it again") from None


def _shard_name(frame: int) -> str:
    return f"images-{frame // _FRAMES_PER_SHARD:05d}.parquet"
