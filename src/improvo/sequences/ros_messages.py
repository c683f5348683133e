"""ROS messages as pictures, calibrations, poses and times; ROS 1 and ROS 2 differ only in the case of field names."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from improvo.geometry.camera_files import Calibration, camera_of
from improvo.geometry.camera_files.distortion import MODEL_NAMES, normalised
from improvo.geometry.se3 import rigid, rotation_from_quat_xyzw
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import decode, depth_in_metres
from improvo.types import Float32, Float64

# encoding -> dtype, channels, conversion to grey or BGR
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "32FC1": ("f4", 1, None),
    # ROS names the corner of the pattern, OpenCV the pixel beside its diagonal
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
}
_DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")


def header_stamp(data: bytes, ros2: bool) -> int:
    """Nanoseconds of a message that begins with a std_msgs/Header; 0 where it has none.

    ROS 1: seq, secs, nsecs; ROS 2: four bytes of encapsulation, whose second tells the byte order, then sec, nanosec.
    """
    if len(data) < 12:
        return 0
    order = "<" if not ros2 or data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack(f"{order}II", data[4:12])
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def image(message: Any) -> np.ndarray:
    """The picture of an Image or CompressedImage, (H, W) grey or (H, W, 3) BGR, 8 or 16 bits.

    Raises:
        UnreadableFrameError: an encoding that is not known, or fewer bytes than the header says.
    """
    if _is_compressed(message):
        return decode(bytes(message.data), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    pixels, conversion = _pixels(message)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UnreadableFrameError(f"encoding {message.encoding} is no picture; choose another --topic")
    return np.ascontiguousarray(pixels) if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))


def depth(message: Any) -> Float32:
    """Metres (H, W), NaN where missing: 16 bit in millimetres, or 32 bit floats in metres.

    Raises:
        UnreadableFrameError: not a depth image.
    """
    if _is_compressed(message):
        data = bytes(message.data)
        if "compressedDepth" in message.format:
            data = data[12:]  # the transport's own header, needed only for quantised floats
        values = decode(data, cv2.IMREAD_UNCHANGED)
        if values.dtype != np.uint16:
            raise UnreadableFrameError(f"compressed depth {message.format!r} is not 16 bit")
        return depth_in_metres(values, 1000.0)
    values, _ = _pixels(message)
    if values.dtype == np.uint16:
        return depth_in_metres(values, 1000.0)
    if values.dtype == np.float32:
        return depth_in_metres(values, 1.0)
    raise UnreadableFrameError(f"encoding {message.encoding} is no depth")


def is_depth(message: Any, topic: str) -> bool:
    """Whether an image message holds depth rather than a picture."""
    if _is_compressed(message):
        return "compressedDepth" in message.format or ("16UC1" in message.format and "depth" in topic.lower())
    if message.encoding == "mono16":
        return "depth" in topic.lower()
    return message.encoding in _DEPTH_ENCODINGS


def calibration(message: Any, source: str, rectified: bool) -> Calibration | None:
    """The camera of a CameraInfo, None where it is all zeros (not calibrated).

    Args:
        message: sensor_msgs/CameraInfo.
        source: for messages.
        rectified: the images are those of `image_rect`, whose camera is P, without distortion.

    Raises:
        InputError: a distortion that is not supported, or numbers that cannot be.
    """
    matrix = np.asarray(_field(message, "K"), np.float64).reshape(3, 3)
    distortion = [float(value) for value in _field(message, "D")]
    content: dict[str, Any] = {"distortion_model": str(message.distortion_model), "D": distortion}
    if rectified:
        matrix, content = np.asarray(_field(message, "P"), np.float64).reshape(3, 4)[:, :3], {}
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        return None
    if "D" in content and not any(distortion) and MODEL_NAMES.get(normalised(content["distortion_model"])) != "fisheye":
        content = {}
    roi = getattr(message, "roi", None)
    names = ("x_offset", "y_offset", "height", "width") if roi is not None else ()
    content |= {f"roi_{name}": int(getattr(roi, name)) for name in names}
    content |= {name: int(getattr(message, name, 0)) for name in ("binning_x", "binning_y", "width", "height")}
    return camera_of({"K": matrix.tolist(), **content}, source)


def pose(message: Any) -> Float64:
    """(4, 4) of a PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped; NaN where it is no rotation."""
    inner = getattr(message, "transform", None) or message.pose
    inner = getattr(inner, "pose", inner)
    position = getattr(inner, "translation", None) or inner.position
    rotation = getattr(inner, "rotation", None) or inner.orientation
    quat_xyzw = np.array([rotation.x, rotation.y, rotation.z, rotation.w], np.float64)
    if not np.isfinite(quat_xyzw).all() or abs(np.linalg.norm(quat_xyzw) - 1) > 1e-2:
        return np.full((4, 4), np.nan)
    return rigid(rotation_from_quat_xyzw(quat_xyzw), np.array([position.x, position.y, position.z], np.float64))


def _is_compressed(message: Any) -> bool:
    return hasattr(message, "format")


def _field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())


def _pixels(message: Any) -> tuple[np.ndarray, int | None]:
    """(H, W) or (H, W, C) as the encoding says, and the conversion to BGR."""
    known = _ENCODINGS.get(message.encoding)
    if known is None:
        raise UnreadableFrameError(f"encoding {message.encoding!r} is not known")
    kind, channels, conversion = known
    order = ">" if message.is_bigendian else "<"
    item = np.dtype(order + kind)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * item.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    if min(height, width) < 1 or step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        raise UnreadableFrameError(f"has {len(data)} bytes for {width}x{height} {message.encoding}")
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1))
    pixels = np.ascontiguousarray(rows).view(item).astype(item.newbyteorder("="), copy=False)
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels)), conversion
