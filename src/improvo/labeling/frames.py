"""The frames behind the labels: by reference to the recording, or packed beside the labels."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.locations import exists, opened
from improvo.sequences.base import UnreadableFrameError
from improvo.stability.table_reading import read_table
from improvo.types import Float64, Int64, Mask, UInt8
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


def pack_images(folder: Path, images: Iterable[tuple[UInt8, Mask | None]]) -> int:
    """Write the frames with their masks, in order, as shards of JPEGs and PNGs; returns how many."""
    import cv2
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema([("frame", pa.int32()), ("jpeg", pa.binary()), ("mask", pa.binary())])
    group: list[tuple[int, bytes, bytes | None]] = []
    writer: pq.ParquetWriter | None = None
    count = 0

    def flush() -> None:
        if writer is not None and group:
            numbers, pictures, masks = zip(*group, strict=True)
            writer.write_table(pa.table({"frame": numbers, "jpeg": pictures, "mask": masks}, schema))
            group.clear()

    try:
        for image, mask in images:
            if count % _FRAMES_PER_SHARD == 0:
                flush()
                if writer is not None:
                    writer.close()
                writer = pq.ParquetWriter(folder / _shard_name(count), schema, compression="none")
            _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            png = None if mask is None else cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes()
            group.append((count, jpeg.tobytes(), png))
            count += 1
            if len(group) == _FRAMES_PER_GROUP:
                flush()
        flush()
        if writer is not None:
            writer.close()
    except BaseException:
        if writer is not None:
            with suppress(OSError):
                writer.close()
            writer.is_open = False  # or it tries again when it is freed, and prints a traceback
        raise
    return count


class PackedImages:
    """Random access to packed frames; keeps the row group that was read last.

    Raises:
        InputError: the folder has no packed frames.
    """

    def __init__(self, folder: Path) -> None:
        if not exists(folder / _shard_name(0)):
            raise InputError(f"{folder}: has no packed frames; label it with --pack")
        self._folder = folder
        self._group: tuple[int, list[bytes], list[bytes | None]] = (-1, [], [])

    def image(self, frame: int) -> UInt8:
        """The grey image (H, W) of a frame of the processed sequence."""
        return self._decoded(frame, self._read(frame)[0])

    def mask(self, frame: int) -> Mask | None:
        """Where keypoints may be in it (H, W); None is everywhere."""
        png = self._read(frame)[1]
        return None if png is None else self._decoded(frame, png) > 0

    def _decoded(self, frame: int, data: bytes) -> UInt8:
        """The grey picture (H, W) of a file's bytes."""
        import cv2

        from improvo.sequences.images import decode

        try:
            return np.asarray(decode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
        except (UnreadableFrameError, TypeError) as error:
            where = self._folder / _shard_name(frame)
            raise InputError(f"{where}: frame {frame} cannot be read ({reason(error)}); label it again") from None

    def _read(self, frame: int) -> tuple[bytes, bytes | None]:
        """Picture and mask of a frame, as they lie in its row group."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        number, row, path = frame // _FRAMES_PER_GROUP, frame % _FRAMES_PER_GROUP, self._folder / _shard_name(frame)
        try:
            if self._group[0] != number:
                with pq.ParquetFile(opened(path)) as file:
                    table = file.read_row_group(frame % _FRAMES_PER_SHARD // _FRAMES_PER_GROUP)
                masks = table["mask"].to_pylist() if "mask" in table.column_names else [None] * len(table)
                self._group = number, table["jpeg"].to_pylist(), masks
            return self._group[1][row], self._group[2][row]
        except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as error:
            raise InputError(f"{path}: cannot be read ({reason(error)}); label it again") from None


def _shard_name(frame: int) -> str:
    return f"images-{frame // _FRAMES_PER_SHARD:05d}.parquet"
