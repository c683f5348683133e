"""ROS bags for the tests, written with the `rosbags` package's writers and type definitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from improvo.geometry.se3 import quat_xyzw_from_rotation
from sequence_encoders import Scene, png


class BagWriter:
    """Messages into a ROS 1 or ROS 2 bag; `latency` is added to the header stamp for the bag's own time."""

    def __init__(self, path: Path, version: int, storage: str = "sqlite3", chunk: int | None = None) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        self.version = version
        if version == 1:
            self.bag: Any = Writer1(path)
            if chunk:
                self.bag.set_compression(Writer1.CompressionFormat.LZ4)
        else:
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self.bag = Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self.bag.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.bag.close()

    def message(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, stamp: int, frame: str = "camera") -> Any:
        time = self.message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        extra = {"seq": 0} if self.version == 1 else {}
        return self.message("std_msgs/msg/Header", **extra, stamp=time, frame_id=frame)

    def write(self, topic: str, message: Any, bag_time: int) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.bag.write(self.connections[topic], bag_time, serialize(message, name))

    def image(self, stamp: int, pixels: np.ndarray, encoding: str, padding: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        data = np.pad(rows, ((0, 0), (0, padding))).ravel()
        return self.message(
            "sensor_msgs/msg/Image",
            header=self.header(stamp),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1] + padding,
            data=data,
        )

    def compressed(self, stamp: int, data: bytes, format: str) -> Any:
        return self.message(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp),
            format=format,
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(self, stamp: int, scene: Scene, model: str = "plumb_bob") -> Any:
        c = scene.camera
        upper = self.version == 1
        fields = {
            "d": np.array(c.distortion or [0.0] * 5),
            "k": c.K.ravel(),
            "r": np.eye(3).ravel(),
            "p": np.concatenate([c.K, np.zeros((3, 1))], axis=1).ravel(),
        }
        roi = self.message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.message(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp),
            height=c.height,
            width=c.width,
            distortion_model=model,
            **{(name.upper() if upper else name): value for name, value in fields.items()},
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def pose(self, stamp: int, world_from_cam: np.ndarray) -> Any:
        x, y, z, w = quat_xyzw_from_rotation(world_from_cam[:3, :3]).tolist()
        px, py, pz = world_from_cam[:3, 3].tolist()
        return self.message(
            "geometry_msgs/msg/PoseStamped",
            header=self.header(stamp, "world"),
            pose=self.message(
                "geometry_msgs/msg/Pose",
                position=self.message("geometry_msgs/msg/Point", x=px, y=py, z=pz),
                orientation=self.message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )


def write_bag(
    path: Path,
    scene: Scene,
    version: int,
    encoding: str = "mono8",
    latency: int = 0,
    storage: str = "sqlite3",
    depth_shift: float = 0.0,
) -> Path:
    """Pictures, depth, camera_info and poses of a scene. `latency` (ns) grows with every message, as in real bags."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with BagWriter(path, version, storage) as bag:
        for i, image in enumerate(scene.images):
            stamp = round(scene.times[i] * 1000) * 1_000_000
            now = stamp + latency * (i + 1)
            if encoding == "compressed":
                bag.write("/cam/image_raw/compressed", bag.compressed(stamp, png(image), "png"), now)
            elif encoding == "mono8":
                bag.write("/cam/image_raw", bag.image(stamp, image, "mono8", padding=3), now)
            else:
                code = {"rgb8": cv2.COLOR_GRAY2RGB, "bgr8": cv2.COLOR_GRAY2BGR, "bgra8": cv2.COLOR_GRAY2BGRA}[encoding]
                bag.write("/cam/image_raw", bag.image(stamp, cv2.cvtColor(image, code), encoding), now)
            bag.write("/cam/camera_info", bag.camera_info(stamp, scene), now)
            depth_stamp = stamp + round(depth_shift * 1e9)
            bag.write("/cam/depth/image", bag.image(depth_stamp, scene.millimetres(i), "16UC1"), now)
            bag.write("/ground_truth", bag.pose(stamp, scene.poses[i]), now)
    return path
