"""Structure from motion with COLMAP (Schoenberger and Frahm 2016): images of a recording to poses, points, a camera.

Everything lies in a working folder, so that what was interrupted goes on: `images` and, where there are any, `masks`,
`database.db` with features and matches, and `model` with the result.
"""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError, OutputError, imported
from improvo.evaluation.truth.settings import TruthSettings
from improvo.files import write_picture
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import colmap_calibration
from improvo.sequences import Sequence as FrameSequence
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import grey
from improvo.types import Float64, Int64

MIN_TRACK = 3  # images that must see a point for its depth to count
MAX_POINT_ERROR = 2.0  # pixels
_FEATURE_BYTES = 350  # of a feature in the database, with its matches
_CHUNK = 8  # images or pairs between two steps of the progress

Progress = Callable[[str, int, int], None]  # stage, done, of how many


@dataclass(frozen=True)
class ReconstructedImage:
    """A registered image and the good points that it sees."""

    name: str
    cam_from_world: Float64  # (4, 4), unit of the reconstruction
    pixels: Float64  # (M, 2) the centre of the top-left pixel at (0, 0), distorted
    depth: Float64  # (M,) Z of the points in this camera
    points: Int64  # (M,) their numbers


@dataclass(frozen=True)
class Reconstruction:
    """What structure from motion found."""

    images: tuple[ReconstructedImage, ...]  # sorted by name
    camera: Camera  # of the raw images
    points: int
    mean_track_length: float
    mean_error_px: float  # re-projection


def load_pycolmap() -> Any:
    """COLMAP's Python module, with its log silenced.

    Raises:
        MissingExtraError: it is not installed.
    """
    before = signal.getsignal(signal.SIGTERM)
    pycolmap = imported("pycolmap", "structure from motion", "truth")
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # the import lets SIGTERM print a stack and end the process
    pycolmap.logging.minloglevel = 3  # FATAL: what goes wrong is told by what is missing from the result
    return pycolmap


@contextmanager
def colmap_at(path: Path) -> Iterator[None]:
    """COLMAP works on this file or folder: what it raises is told in one line.

    Raises:
        OutputError: it cannot go on, as on a full disk.
    """
    try:
        yield
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise OutputError(f"{path}: COLMAP cannot go on ({reason}); if the disk is full, free some space") from None


def image_pairs(count: int, overlap: int, farthest: int) -> Int64:
    """Pairs (K, 2) of images to match, each with later ones.

    Args:
        count: of images, in the order of time.
        overlap: how many of the next images.
        farthest: beyond them 2^k images later, up to this.
    """
    steps = list(range(1, overlap + 1))
    steps += [step for power in range(20) if overlap < (step := 2**power) <= farthest]
    pairs = [(first, first + step) for step in steps for first in range(count - step)]
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def reconstruct(
    sequence: FrameSequence, folder: Path, settings: TruthSettings, threads: int, progress: Progress
) -> Reconstruction:
    """Structure from motion over the raw images of the selected frames, camera included.

    Args:
        sequence: its raw camera is where self-calibration starts from.
        folder: working folder; what an interrupted call left there is used.
        settings: of the reconstruction.
        threads: of COLMAP.
        progress: told after every step.

    Raises:
        MissingExtraError: without `pycolmap`.
        InputError: a camera model that a truth file cannot hold, or no reconstruction.
    """
    pycolmap = load_pycolmap()
    start = sequence.raw_camera
    if start.distortion_model != "brown":
        raise InputError(
            f"{sequence.path}: its {start.distortion_model} camera has no place in a truth file, which holds "
            "k1 k2 p1 p2; undistort the images first"
        )
    if settings.calibrate == "none" and any(start.distortion[4:]):
        raise InputError(
            f"{sequence.path}: its camera has more distortion than k1 k2 p1 p2, which is all that a truth file holds; "
            "leave out --calibrate none, or undistort the images first"
        )
    if not (folder / "model").is_dir():
        _check_space(folder, len(sequence) * (start.width * start.height + _FEATURE_BYTES * settings.max_features))
        names = _write_images(sequence, folder, progress)
        with colmap_at(folder):
            _extract(pycolmap, folder, names, start, settings, threads, progress)
            _match(pycolmap, folder, names, settings, threads, progress)
            best = _map(pycolmap, folder, len(names), settings, threads, progress)
        if best is None:
            raise InputError(f"{sequence.path}: structure from motion found no model; the camera moves too little")
        if settings.calibrate == "full":
            _refine(pycolmap, best, threads)
        unfinished = folder / "model.partial"  # a model appears complete or not at all
        unfinished.mkdir(exist_ok=True)
        with colmap_at(folder):
            best.write(str(unfinished))
        unfinished.rename(folder / "model")
    return read_reconstruction(folder / "model")


def _check_space(folder: Path, needed: int) -> None:
    """Refuse before any work what would not fit, since a full disk ends COLMAP and the process that it is part of."""
    needed -= sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    free = shutil.disk_usage(folder).free
    if free < needed:
        sizes = f"needs about {needed / 1e6:.0f} MB, and {free / 1e6:.0f} MB are free"
        raise OutputError(f"{folder}: {sizes}; free some space, or choose another folder")


def read_reconstruction(folder: Path) -> Reconstruction:
    """A COLMAP model with its points.

    Raises:
        MissingExtraError: without `pycolmap`.
        InputError: no model, or images of several cameras.
    """
    pycolmap = load_pycolmap()
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, OSError, IndexError):
        raise InputError(f"{folder}: is no COLMAP model; give a folder with cameras, images and points") from None
    registered = [image for image in model.images.values() if image.has_pose]
    cameras = {image.camera_id for image in registered}
    if len(cameras) != 1:
        raise InputError(f"{folder}: its images have {len(cameras)} cameras; a truth needs a single one")
    own = model.cameras[cameras.pop()]
    size = (int(own.width), int(own.height))
    try:
        calibration = colmap_calibration(str(folder), own.model.name, size, [float(value) for value in own.params])
    except ValueError as error:
        raise InputError(f"{folder}: {error}; make the model with the camera model OPENCV") from None
    good = {
        number: np.asarray(point.xyz)
        for number, point in model.points3D.items()
        if point.track.length() >= MIN_TRACK and point.error <= MAX_POINT_ERROR
    }
    images = [_image(image, good) for image in sorted(registered, key=lambda image: str(image.name))]
    return Reconstruction(
        tuple(images),
        calibration.camera(*size),
        model.num_points3D(),
        float(model.compute_mean_track_length()),
        float(model.compute_mean_reprojection_error()),
    )


def _image(image: Any, good: dict[int, Float64]) -> ReconstructedImage:
    cam_from_world = np.vstack([np.asarray(image.cam_from_world().matrix()), [0.0, 0.0, 0.0, 1.0]])
    seen = {point.point3D_id: point.xy for point in image.points2D if point.point3D_id in good}
    pixels = np.array(list(seen.values()), np.float64).reshape(-1, 2) - 0.5
    xyz = np.array([good[number] for number in seen], np.float64).reshape(-1, 3)
    depth = xyz @ cam_from_world[2, :3] + cam_from_world[2, 3]
    return ReconstructedImage(str(image.name), cam_from_world, pixels, depth, np.array(list(seen), np.int64))


def _write_images(sequence: FrameSequence, folder: Path, progress: Progress) -> list[str]:
    """The raw images as grey PNG, named by their number in the recording, and their masks where COLMAP looks for them.

    Unreadable frames are left out.
    """
    images, masks = folder / "images", folder / "masks"
    images.mkdir(parents=True, exist_ok=True)
    names = []
    for done, index in enumerate(sequence.indices.tolist()):
        name = f"{index:06d}.png"
        if not (images / name).is_file():
            try:
                image = grey(sequence.recording.image(index))
            except UnreadableFrameError:
                continue
            mask = sequence.raw_mask(done)
            if mask is not None:
                masks.mkdir(exist_ok=True)
                write_picture(masks / f"{name}.png", mask)
            write_picture(images / name, image)
        names.append(name)
        progress("images", done + 1, len(sequence))
    return names


def _extract(
    pycolmap: Any,
    folder: Path,
    names: list[str],
    start: Camera,
    settings: TruthSettings,
    threads: int,
    progress: Progress,
) -> None:
    """SIFT features; COLMAP skips images that have them already."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    distortion = (*start.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    parameters = (start.fx, start.fy, start.cx + 0.5, start.cy + 0.5, *distortion)
    reader.camera_params = ",".join(repr(float(value)) for value in parameters)
    if (folder / "masks").is_dir():
        reader.mask_path = folder / "masks"
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = threads, False
    options.sift.max_num_features = settings.max_features
    database = pycolmap.Database.open(folder / "database.db")
    known = database.num_cameras() > 0
    database.close()
    done = 0
    for chunk in _chunks(names):
        if known or done:  # one camera for all images, those of an interrupted call too
            reader.existing_camera_id = 1
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        done += len(chunk)
        progress("features", done, len(names))


def _match(
    pycolmap: Any, folder: Path, names: list[str], settings: TruthSettings, threads: int, progress: Progress
) -> None:
    """Matches of the chosen pairs, verified by two-view geometry; COLMAP skips pairs that have them already."""
    pairs = image_pairs(len(names), settings.overlap, settings.farthest).tolist()
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = threads, False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    done = 0
    for chunk in _chunks(pairs, 8 * _CHUNK):
        (folder / "pairs.txt").write_text("".join(f"{names[a]} {names[b]}\n" for a, b in chunk), encoding="utf-8")
        pycolmap.match_image_pairs(
            folder / "database.db", matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
        )
        done += len(chunk)
        progress("matches", done, len(pairs))


def _map(
    pycolmap: Any, folder: Path, images: int, settings: TruthSettings, threads: int, progress: Progress
) -> Any | None:
    """The largest model; None where there is none."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, settings.seed
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = settings.calibrate != "none"
    (folder / "mapping").mkdir(exist_ok=True)
    registered = 2

    def tick() -> None:
        nonlocal registered
        registered = min(registered + 1, images)  # models that fail are begun again
        progress("mapping", registered, images)

    models = pycolmap.incremental_mapping(
        folder / "database.db", folder / "images", folder / "mapping", options=options, next_image_callback=tick
    )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _refine(pycolmap: Any, model: Any, threads: int) -> None:
    """One more adjustment of everything, the principal point too, which incremental mapping holds."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    options.ceres.solver_options.num_threads = threads
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _chunks(values: Sequence[Any], size: int = _CHUNK) -> list[list[Any]]:
    return [list(values[start : start + size]) for start in range(0, len(values), size)]
