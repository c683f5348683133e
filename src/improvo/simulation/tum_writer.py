"""Writing a sequence in the TUM RGB-D layout, which `improvo.sequences` reads as any other recording of that kind."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from improvo.errors import OutputError
from improvo.files import write_text, written_atomically
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml
from improvo.geometry.trajectory_files import tum_row
from improvo.types import Float32, Float64, UInt8

DEPTH_SCALE = 5000.0  # depth value of one metre


class TumRgbdWriter:
    """Writes a sequence in TUM RGB-D layout, frame by frame.

    Every image is written completely or not at all. The lists are written when the writer is closed, also after an
    exception or Ctrl-C, so the folder is then a valid, shorter sequence.

    ::

        with TumRgbdWriter(folder, camera) as writer:
            writer.add(time, image, depth, world_from_cam)

    Args:
        folder: made if it does not exist.
        camera: of the images, written to `camera.yaml` with its distortion.
        depth_scale: depth value of one metre; 5000 is the data set's own, reaching 13 m.
        jpeg_quality: write the images as JPEG of this quality (0 to 100) instead of PNG.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        fps: float | None = None,
        depth_scale: float = DEPTH_SCALE,
        jpeg_quality: int | None = None,
    ) -> None:
        self.folder = folder
        self._jpeg_quality = jpeg_quality
        self.camera = camera
        self._scale = depth_scale
        self._images: list[str] = []
        self._depth: list[str] = []
        self._truth: list[str] = []
        self._last_time = -np.inf
        try:
            (folder / "rgb").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be created ({error.strerror}); choose another folder") from None
        for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):  # the lists of an earlier recording of other pictures
            (folder / name).unlink(missing_ok=True)
        write_text(folder / "camera.yaml", calibration_yaml(camera, fps, depth_scale))

    def __enter__(self) -> TumRgbdWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._images)

    def add(
        self, time: float, image: UInt8, depth: Float32 | None = None, world_from_cam: Float64 | None = None
    ) -> None:
        """Write one frame.

        Args:
            time: seconds, later than the frame before.
            image: (H, W) grey or (H, W, 3) BGR.
            depth: (H, W) metres, NaN where missing; beyond what 16 bits hold counts as missing.
            world_from_cam: (4, 4).

        Raises:
            ValueError: another size than the camera's, or time does not increase.
            OutputError: the disk does not take it.
        """
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size or (depth is not None and depth.shape != size):
            raise ValueError(f"frame {len(self)}: image and depth must be {size[1]}x{size[0]} like the camera")
        if not time > self._last_time:
            raise ValueError(f"frame {len(self)}: time {time} does not increase")
        name = f"{len(self):06d}.png"
        picture = name if self._jpeg_quality is None else f"{len(self):06d}.jpg"
        _write_image(self.folder / "rgb" / picture, image, self._jpeg_quality)
        if depth is not None:
            (self.folder / "depth").mkdir(exist_ok=True)
            _write_image(self.folder / "depth" / name, depth_values(depth, self._scale))
            self._depth.append(f"{time:.9f} depth/{name}\n")
        if world_from_cam is not None:
            self._truth.append(tum_row(time, world_from_cam))
        self._images.append(f"{time:.9f} rgb/{picture}\n")
        self._last_time = time

    def close(self) -> None:
        """Write the lists of the frames so far; without a frame there is no recording, and no list of it."""
        if not self._images:
            return
        write_text(self.folder / "rgb.txt", "# timestamp filename\n" + "".join(self._images))
        if self._depth:
            write_text(self.folder / "depth.txt", "# timestamp filename\n" + "".join(self._depth))
        if self._truth:
            header = "# camera-to-world: timestamp tx ty tz qx qy qz qw\n"
            write_text(self.folder / "groundtruth.txt", header + "".join(self._truth))


def depth_values(depth: Float32, scale: float) -> np.ndarray:
    """Metres (H, W) -> 16-bit values, 0 where missing or out of reach."""
    values = np.rint(np.nan_to_num(depth.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0) * scale)
    return np.where((values > 0) & (values < 65535), values, 0).astype(np.uint16)


def _write_image(path: Path, image: np.ndarray, jpeg_quality: int | None = None) -> None:
    options = [] if jpeg_quality is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    with written_atomically(path) as temporary:
        encoded, data = cv2.imencode(path.suffix, image, options)
        if not encoded:
            raise OutputError(f"{path}: the image cannot be encoded")
        temporary.write_bytes(data.tobytes())
