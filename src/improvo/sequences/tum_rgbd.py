"""TUM RGB-D (Sturm et al. 2012): `rgb.txt`, `depth.txt`, `groundtruth.txt`, time stamps in seconds; and its writer.

Depth is 16 bit, 5000 per metre unless `camera.yaml` says otherwise, registered to colour. The original data set has no
calibration file; the published cameras are used where the folder's name tells which Kinect it was.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from improvo.errors import InputError, OutputError
from improvo.files import write_text, written_atomically
from improvo.geometry.camera import Camera
from improvo.sequences.association import nearest
from improvo.sequences.base import Recording, SequenceSettings
from improvo.sequences.calibration import Calibration, calibration_yaml, folder_calibration
from improvo.sequences.images import read_depth, read_image
from improvo.sequences.trajectory_files import increasing_order, read_trajectory_report, tum_row
from improvo.types import Float32, Float64, UInt8

DEPTH_SCALE = 5000.0
_PUBLISHED = {  # the data set's page, "Intrinsic Camera Calibration of the Kinect"
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


class TumRgbd(Recording):
    """A folder with `rgb.txt`, or with the `associations.txt` that other tools make of both lists."""

    format = "tum"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        pairs = None if (path / "rgb.txt").is_file() else _pairs_file(path)
        self.times, self._images, notes = _read_list(pairs or path / "rgb.txt", "rgb")
        self.calibration = folder_calibration(path) or _published(path)
        self._scale = (self.calibration and self.calibration.depth_scale) or DEPTH_SCALE
        self._depth: list[Path] = []
        self._depth_row = np.full(len(self.times), -1, np.int64)
        if pairs is not None or (path / "depth.txt").is_file():
            depth_times, self._depth, depth_notes = _read_list(pairs or path / "depth.txt", "depth")
            self._depth_row = nearest(self.times, depth_times)
            notes += depth_notes
            without = int((self._depth_row < 0).sum())
            if without:
                notes.append(f"{path}: {without} of {len(self.times)} images have no depth within 0.02 s")
        if (path / "groundtruth.txt").is_file():
            self.ground_truth, problems = read_trajectory_report(path / "groundtruth.txt")
            notes += problems
        self.notes = tuple(notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / "rgb.txt").is_file() or (path.is_dir() and _pairs_file(path) is not None)

    def source(self, index: int) -> str:
        return str(self._images[index])

    def image(self, index: int) -> UInt8:
        return read_image(self._images[index])

    def depth(self, index: int) -> Float32 | None:
        row = self._depth_row[index]
        return None if row < 0 else read_depth(self._depth[row], self._scale)


def _pairs_file(path: Path) -> Path | None:
    """The list of `time rgb/file time depth/file` rows, in either order."""
    names = ("associations.txt", "associate.txt", "associated.txt", "association.txt", "assoc.txt")
    return next((path / name for name in names if (path / name).is_file()), None)


def _read_list(path: Path, kind: str) -> tuple[Float64, list[Path], list[str]]:
    """Times (N,), increasing, and files of an `rgb.txt` or of the `kind` in a list of pairs; notes on bad rows.

    Raises:
        InputError: the file cannot be read or has no row `timestamp filename`.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); it must list `timestamp filename` rows") from None
    in_pairs = path.name != f"{kind}.txt"
    times, files, bad = [], [], 0
    for line in lines:
        fields = line.replace(",", " ").split() if in_pairs else line.replace(",", " ").split(maxsplit=1)
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) == 4 and fields[3].split("/")[0] == kind:
            fields = fields[2:4]
        try:
            time = float(fields[0])
        except ValueError:
            time = float("nan")
        if len(fields) < 2 or not np.isfinite(time):
            bad += 1
            continue
        times.append(time)
        files.append(path.parent / fields[1].strip())
    if not times:
        raise InputError(f"{path}: has no row `timestamp filename`; repair it or give the image folder itself")
    stamps = np.asarray(times, np.float64)
    order, repeated = increasing_order(stamps)
    notes = [f"{path}: {bad} rows are not `timestamp filename` and were left out"] if bad else []
    notes += [f"{path}: {repeated} rows repeat a time stamp and were left out"] if repeated else []
    return stamps[order], [files[row] for row in order], notes


def _published(path: Path) -> Calibration | None:
    match = re.search(r"(?:freiburg|fr)([123])(?![0-9])", path.absolute().name)
    if match is None:
        return None
    intrinsics, distortion = _PUBLISHED[match.group(1)]
    return Calibration(f"TUM RGB-D freiburg{match.group(1)}", intrinsics, distortion, size=(640, 480))


class TumRgbdWriter:
    """Writes a sequence in TUM RGB-D layout, frame by frame.

    Every image is written whole or not at all, and the lists when the writer is closed, also by an exception or
    Ctrl-C: what then lies there is a valid, shorter sequence.

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
        """Write the lists of the frames so far."""
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
