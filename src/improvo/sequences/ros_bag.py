"""ROS 1 and ROS 2 bags, through the `rosbags` package (extra `ros`): Image, CompressedImage, CameraInfo, poses.

The image topic is the one with pictures, or `--topic`; its CameraInfo is the one beside it. Times are the header stamps
of the messages (the bag's own if headers have none). If a few samples show that both agree, the times are read from the
index of the bag, without reading images; otherwise all headers are read once.
"""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration
from improvo.geometry.trajectory_files import increasing_order
from improvo.sequences import ros_messages
from improvo.sequences.association import nearest
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.sequences.grey_levels import SAMPLES, Stretch, stretch_of, to_8_bits
from improvo.sequences.ros_topics import Stream, candidates, deserialized, guarded, open_reader
from improvo.types import Float32, Int64, Trajectory, UInt8

_TRUTH_NAME = re.compile(r"ground.?truth|(^|[/_])gt([/_]|$)|vicon|mocap|optitrack|leica", re.IGNORECASE)
_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)


class RosBag(Recording):
    """A `.bag`, `.mcap` or `.db3` file, or the folder of a ROS 2 bag."""

    format = "rosbag"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._reader = open_reader(path)
        notes: list[str] = []
        pictures, depths = candidates(self._reader, path)
        self._images = _choose(pictures, settings.topic, path)
        others = [stream.topic for stream in pictures if stream is not self._images]
        if others and settings.topic is None:
            notes.append(f"{path}: topic {self._images.topic} chosen; --topic can be {', '.join(others)}")
        stamps = self._images.stamps()
        order, repeated = increasing_order(stamps)
        notes += [f"{path}: {repeated} images repeat a time stamp and were left out"] if repeated else []
        self._rows, self.times = order, stamps[order]
        self.calibration = self.own_calibration(lambda: _camera_info(self._reader, self._images.topic, path))
        self._depths = depths
        self._stretch = self._common_stretch()
        notes += [f"{path}: {self._stretch.note}"] if self._stretch is not None else []
        self._notes = notes

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self._notes)

    @cached_property
    def ground_truth(self) -> Trajectory | None:  # type: ignore[override]
        """Read when it is first asked for: a bag has no index of poses."""
        trajectory, notes = _ground_truth(self._reader, self.path)
        self._notes += notes
        return trajectory

    @cached_property
    def _depth(self) -> tuple[Stream, Int64] | None:
        """The depth stream and its row for each image, -1 where there is none."""
        if not self._depths:
            return None
        stream, rows, notes = self._associate_depth(self._depths)
        self._notes += notes
        return None if stream is None else (stream, rows)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if path.is_file():
            return path.suffix.lower() in (".bag", ".mcap", ".db3")
        return (path / "metadata.yaml").is_file() and any(
            file.suffix in (".db3", ".mcap", ".zstd") for file in path.iterdir()
        )

    def source(self, index: int) -> str:
        return f"{self.path}#{self._images.topic}/{index}"

    def image(self, index: int) -> UInt8:
        return to_8_bits(self._picture(index), self._stretch)

    def _picture(self, index: int) -> np.ndarray:
        return ros_messages.image(self._images.message(int(self._rows[index])))

    def _common_stretch(self) -> Stretch | None:
        """The range of deep pictures; read from a few of them, where the first is deep."""
        pictures = []
        for row in np.unique(np.linspace(0, len(self.times) - 1, min(SAMPLES, len(self.times))).astype(int)).tolist():
            try:
                pictures.append(self._picture(row))
            except UnreadableFrameError:  # any message may be damaged
                continue
            if pictures[-1].dtype == np.uint8:
                return None
        return stretch_of(pictures)

    def depth(self, index: int) -> Float32 | None:
        if self._depth is None:
            return None
        stream, rows = self._depth
        return None if rows[index] < 0 else ros_messages.depth(stream.message(int(rows[index])))

    def _associate_depth(self, depths: list[Stream]) -> tuple[Stream | None, Int64, list[str]]:
        """The depth stream of the images' camera and its row for each image.

        Depth of another camera is left out, because the bag may not contain the transform between the two.
        """
        depths = sorted(depths, key=lambda stream: ("aligned" not in stream.topic, "regist" not in stream.topic))
        stream = depths[0]
        info = _camera_info(self._reader, stream.topic, self.path)
        ours = self.calibration
        if info is not None and ours is not None and info.size == ours.size:
            same = np.allclose(info.intrinsics, ours.intrinsics, rtol=1e-3, atol=0.5)
        else:
            same = info is None or ours is None
        if not same:
            note = f"{self.path}: depth of {stream.topic} is not registered to {self._images.topic} and was left out"
            return None, np.zeros(0, np.int64), [note]
        stamps = stream.stamps()
        order, _ = increasing_order(stamps)
        row = nearest(self.times, stamps[order])
        without = int((row < 0).sum())
        notes = [f"{self.path}: depth for {len(row) - without} of {len(row)} images (within 0.02 s)"] if without else []
        return stream, np.where(row >= 0, order[np.maximum(row, 0)], -1), notes


def _choose(pictures: list[Stream], topic: str | None, path: Path) -> Stream:
    if topic is not None:
        for stream in pictures:
            if stream.topic == topic or stream.topic.lstrip("/") == topic.lstrip("/"):
                return stream
    if not pictures or topic is not None:
        known = ", ".join(stream.topic for stream in pictures) or "none (depth alone cannot be tracked)"
        wanted = f"no image topic {topic}" if topic else "no image topic"
        raise InputError(f"{path}: has {wanted}; topics with pictures: {known}")

    def rank(stream: Stream) -> tuple[bool, bool, bool, str]:
        name = stream.topic.lower()
        # colour before infrared, left before right, the raw stream before its compressed or rectified copies
        return (
            "infra" in name or "/ir/" in name,
            "right" in name,
            "compressed" in name or "rect" in name,
            stream.topic,
        )

    return min(pictures, key=rank)


def _camera_info(reader: Any, topic: str, path: Path) -> Calibration | None:
    """The CameraInfo beside an image topic, else the only one of the bag."""
    infos = [c for c in reader.connections if c.msgtype == "sensor_msgs/msg/CameraInfo" and c.msgcount]
    parents = [topic.rsplit("/", depth)[0] for depth in (1, 2, 3) if topic.count("/") >= depth]
    names = [f"{parent}{name}" for parent in parents for name in ("/camera_info", "/info/camera_info")]
    beside = next((c for name in names for c in infos if c.topic == name), None)
    chosen = beside or (infos[0] if len(infos) == 1 else None)
    if chosen is None:
        return None
    message = _first_message(reader, chosen, path)
    source = f"{path}#{chosen.topic}"
    return None if message is None else ros_messages.calibration(message, source, rectified="image_rect" in topic)


def _first_message(reader: Any, connection: Any, path: Path) -> Any:
    """The first message of a connection, None if there is none that can be deserialised."""
    for _, _, data in guarded(reader.messages(connections=[connection]), path):
        return deserialized(reader, data, connection.msgtype)
    return None


def _ground_truth(reader: Any, path: Path) -> tuple[Trajectory | None, list[str]]:
    """Poses of a topic that calls itself ground truth, else of the only PoseStamped; they are taken as the camera's."""
    poses = [c for c in reader.connections if c.msgtype in _POSE_TYPES and c.msgcount]
    named = [c for c in poses if _TRUTH_NAME.search(c.topic)]
    stamped = [c for c in poses if c.msgtype == "geometry_msgs/msg/PoseStamped"]
    chosen = named[0] if named else stamped[0] if len(stamped) == 1 else None
    if chosen is None:
        return None, []
    times, matrices = [], []
    notes = [f"{path}: ground truth from {chosen.topic}, taken as poses of the camera (x right, y down, z forward)"]
    try:
        for _, time, data in guarded(reader.messages(connections=[chosen]), path):
            message = deserialized(reader, data, chosen.msgtype)
            times.append((ros_messages.header_stamp(data, reader.is2) or time) / 1e9)
            matrices.append(np.full((4, 4), np.nan) if message is None else ros_messages.pose(message))
    except InputError as error:
        notes.append(f"{error} (ground truth ends there)")
    if not times:
        return None, notes
    order, _ = increasing_order(np.array(times))
    trajectory = Trajectory(np.array(times)[order], np.stack(matrices)[order])
    bad = int((~trajectory.valid).sum())
    notes += [f"{path}: {bad} poses of {chosen.topic} are no rigid motion"] if bad else []
    return (trajectory if trajectory.valid.any() else None), notes
