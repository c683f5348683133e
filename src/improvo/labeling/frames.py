"""The frames behind the labels: by reference to the recording, or packed beside the labels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.types import Float64, Int64, Mask, UInt8

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
        pq.write_table(pa.table(columns), temporary)


def read_frames(path: Path) -> FramesTable:
    """Read `frames.parquet`.

    Raises:
        InputError: missing or damaged.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path, memory_map=False)
        columns = [table[name].to_numpy() for name in ("frame", "index", "time", "segment", "trusted")]
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read ({str(error).splitlines()[0]}); run `improvo label` again") from None
    frame, index, time, segment, trusted = columns
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
        self._group: tuple[int, list[bytes], list[bytes | None]] = (-1, [], [])

    def image(self, frame: int) -> UInt8:
        """The grey image (H, W) of a frame of the processed sequence."""
        import cv2

        self._read(frame)
        jpeg = np.frombuffer(self._group[1][frame % _FRAMES_PER_GROUP], np.uint8)
        return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), np.uint8)

    def mask(self, frame: int) -> Mask | None:
        """Where keypoints may be in it (H, W); None is everywhere."""
        import cv2

        self._read(frame)
        png = self._group[2][frame % _FRAMES_PER_GROUP]
        if png is None:
            return None
        return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)) > 0

    def _read(self, frame: int) -> None:
        """Have the row group of a frame at hand."""
        import pyarrow.parquet as pq

        number = frame // _FRAMES_PER_GROUP
        if self._group[0] != number:
            file = pq.ParquetFile(self._folder / _shard_name(frame))
            table = file.read_row_group(frame % _FRAMES_PER_SHARD // _FRAMES_PER_GROUP)
            masks = table["mask"].to_pylist() if "mask" in table.column_names else [None] * len(table)
            self._group = number, table["jpeg"].to_pylist(), masks


def _shard_name(frame: int) -> str:
    return f"images-{frame // _FRAMES_PER_SHARD:05d}.parquet"
