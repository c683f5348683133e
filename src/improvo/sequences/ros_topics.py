"""The image streams of a bag, by random access."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from improvo.errors import InputError, imported
from improvo.sequences import ros_messages
from improvo.sequences.base import UnreadableFrameError
from improvo.types import Float64, Int64
from improvo.untrusted.decompression import decompress, opened_with_limit

_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_SAMPLES = 16  # messages whose header stamps are compared with the bag's


def open_reader(path: Path) -> Any:
    """A `rosbags` reader of the bag.

    Raises:
        MissingExtraError: `rosbags` is not installed.
        InputError: the bag cannot be read.
    """
    bags, types = (imported(f"rosbags.{part}", "reading ROS bags", "ros") for part in ("highlevel", "typesys"))
    _bound_decompressors()
    try:
        reader = bags.AnyReader([path], default_typestore=types.get_typestore(types.Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:  # a damaged bag may fail anywhere in three container formats and their codecs
        mend = (
            "run `rosbag reindex` on it, or record it again" if path.suffix == ".bag" else "record or convert it again"
        )
        raise InputError(f"{path}: cannot be read as a ROS bag ({_reason(error)}); {mend}") from None
    return reader


def _bound_decompressors() -> None:
    """Let rosbags unpack no chunk to more than our limit: a few kilobytes of bz2 can become gigabytes.

    A version that keeps its decompressors elsewhere does as before.
    """
    import bz2
    from importlib import import_module

    with suppress(ImportError, AttributeError):
        lz4 = partial(decompress, import_module("lz4.frame").LZ4FrameDecompressor)
        first: Any = import_module("rosbags.rosbag1.reader")
        second: Any = import_module("rosbags.rosbag2.reader")
        mcap: Any = import_module("rosbags.rosbag2.storage_mcap")
        first.decompressors.update(bz2=partial(decompress, bz2.BZ2Decompressor), lz4=lz4)
        if isinstance(second.zstd, ModuleType):
            zstd = partial(decompress, second.zstd.ZstdDecompressor)
            mcap.DECOMPRESSORS.update(lz4=lambda data, _: lz4(data), zstd=lambda data, _: zstd(data))
            second.zstd = SimpleNamespace(
                open=partial(opened_with_limit, second.zstd.open), compress=second.zstd.compress, decompress=zstd
            )


def candidates(reader: Any, path: Path) -> tuple[list[Stream], list[Stream]]:
    """The streams with pictures and those with depth, told apart by their first message.

    Raises:
        InputError: there is no image topic at all.
    """
    pictures: list[Stream] = []
    depths: list[Stream] = []
    if not all(isinstance(c.topic, str) and isinstance(c.msgtype, str) for c in reader.connections):
        raise InputError(f"{path}: its metadata names topics that are no words; run `ros2 bag reindex` on it")
    for topic in sorted({c.topic for c in reader.connections if c.msgtype in _IMAGE_TYPES and c.msgcount}):
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype in _IMAGE_TYPES]
        stream = Stream(reader, topic, connections, path)
        try:
            first = stream.message(0)
        except UnreadableFrameError:
            continue
        (depths if ros_messages.is_depth(first, topic) else pictures).append(stream)
    if not pictures and not depths:
        types = ", ".join(sorted({c.msgtype for c in reader.connections})) or "nothing"
        raise InputError(f"{path}: has no readable Image or CompressedImage topic (it has {types}); record one")
    return pictures, depths


class Stream:
    """Messages of one topic in the bag's order: sequential reading is one pass, other access restarts at a time."""

    def __init__(self, reader: Any, topic: str, connections: list[Any], path: Path) -> None:
        self.topic = topic
        self._reader = reader
        self._connections = connections
        self._path = path
        self._bag_times: Int64 | None = None
        self._iterator: Iterator[tuple[Any, int, bytes]] | None = None
        self._next = 0  # row that the iterator gives next

    def message(self, row: int) -> Any:
        """The deserialised message of a row.

        Raises:
            UnreadableFrameError: it is damaged.
        """
        data = self._data(row)
        try:
            return self._reader.deserialize(data, self._connections[0].msgtype)
        except Exception as error:  # rosbags reports damaged messages with errors of several modules
            raise UnreadableFrameError(f"the message is damaged ({_reason(error)})") from None

    def stamps(self) -> Float64:
        """(N,) header stamps in seconds, in the bag's order.

        Raises:
            InputError: the bag is damaged before its end and cannot be indexed.
        """
        bag_times = self._times()
        count = len(bag_times)
        samples = np.unique(np.linspace(0, count - 1, min(_SAMPLES, count)).astype(np.int64))
        headers = [ros_messages.header_stamp(self._data(int(row)), self._reader.is2) for row in samples]
        if not any(headers) or (np.abs(np.array(headers) - bag_times[samples]) < 1000).all():
            return bag_times / 1e9
        raw = guarded(self._messages(), self._path)
        every = [ros_messages.header_stamp(data, self._reader.is2) for _, _, data in raw]
        return np.array(every[:count], np.int64) / 1e9

    def _data(self, row: int) -> bytes:
        if self._iterator is None or row < self._next or row > self._next + 8:
            start = 0
            if row > 0:
                # several messages may share one time: begin at the first of them
                times = self._times()
                start = int(np.searchsorted(times, times[row]))
                self._iterator = self._messages(int(times[row]))
            else:
                self._iterator = self._messages()
            self._next = start
        try:
            while True:
                _, _, data = next(self._iterator)
                self._next += 1
                if self._next > row:
                    return data
        except StopIteration:
            self._iterator = None
            raise UnreadableFrameError("the bag ends before this message") from None
        except Exception as error:  # a chunk that cannot be decompressed, a page that is not there
            self._iterator = None
            raise UnreadableFrameError(f"the bag is damaged here ({_reason(error)})") from None

    def _messages(self, start: int | None = None) -> Iterator[tuple[Any, int, bytes]]:
        messages: Iterator[tuple[Any, int, bytes]] = self._reader.messages(connections=self._connections, start=start)
        return messages

    def _times(self) -> Int64:
        """(N,) nanoseconds of the bag's own clock, from its index where there is one that can be read alone."""
        if self._bag_times is None:
            try:
                times = self._indexed_times()
                if times is None:
                    times = [time for _, time, _ in self._messages()]
            except Exception as error:
                reason = _reason(error)
                raise InputError(f"{self._path}: is damaged ({reason}); repair or record it again") from None
            self._bag_times = np.sort(np.array(times, np.int64), kind="stable")
        return self._bag_times

    def _indexed_times(self) -> list[int] | None:
        owners = {id(c.owner): c.owner for c in self._connections}
        if not self._reader.is2:
            return [entry.time for c in self._connections for entry in c.owner.indexes[c.id]]
        files = sorted(self._path.glob("*.db3")) if self._path.is_dir() else [self._path]
        if not files or any(file.suffix != ".db3" for file in files) or len(owners) != 1:
            return None
        times: list[int] = []
        for file in files:
            database = sqlite3.connect(f"file:{file}?immutable=1", uri=True)
            query = "SELECT m.timestamp FROM messages m JOIN topics t ON m.topic_id = t.id WHERE t.name = ?"
            times += [row[0] for row in database.execute(query, (self.topic,))]
            database.close()
        return times


def deserialized(reader: Any, data: bytes, kind: str) -> Any:
    """The message, None if it is damaged (which rosbags reports with errors of several modules)."""
    try:
        return reader.deserialize(data, kind)
    except Exception:
        return None


def guarded(messages: Iterator[tuple[Any, int, bytes]], path: Path) -> Iterator[tuple[Any, int, bytes]]:
    """The same messages; damage in the bag, which shows as errors of many kinds, becomes an InputError."""
    try:
        yield from messages
    except Exception as error:
        raise InputError(f"{path}: is damaged ({_reason(error)}); repair or record it again") from None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
