"""Image pairs with a known homography: HPatches folders, or random homographies of any pictures."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.settings import HomographySettings
from improvo.frontend.architecture import CELL
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import read_grey
from improvo.training.augmentation.views import random_view, warp_image
from improvo.training.settings import ViewSettings
from improvo.types import Float64, UInt8
from improvo.untrusted.paths import check_is_file

SUFFIXES = (".ppm", ".pgm", ".png", ".jpg", ".jpeg", ".bmp")
SPLITS = {"i": "illumination", "v": "viewpoint"}  # first letter of an HPatches folder


@dataclass(frozen=True)
class Scene:
    """A reference image and where to find its other views; small, so that worker processes open it."""

    name: str
    split: str  # illumination, viewpoint, synthetic, or other
    reference: str
    views: tuple[tuple[str, str], ...]  # image and homography file of each view; empty for random homographies


@dataclass(frozen=True)
class View:
    """Another image of a scene."""

    image: UInt8  # (H, W)
    view_from_reference: Float64  # (3, 3)


def hpatches_scenes(folder: Path) -> list[Scene]:
    """Scenes of a folder in the HPatches layout: `SCENE/1.ppm ... 6.ppm` with `SCENE/H_1_2 ... H_1_6`.

    Raises:
        InputError: no such folder, no scene in it, or a view without its homography.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder in the HPatches layout, or use --synthesize")
    scenes = []
    for place in sorted(path for path in (folder, *folder.iterdir()) if path.is_dir()):
        images = {path.stem: path for path in sorted(place.iterdir()) if path.suffix.lower() in SUFFIXES}
        homographies = {path.name[4:]: path for path in place.glob("H_1_*")}
        if "1" not in images or not homographies:
            continue
        missing = sorted(set(homographies) - set(images))
        if missing:
            raise InputError(f"{place}: has H_1_{missing[0]} but no image {missing[0]}; complete the folder")
        views = tuple((str(images[number]), str(homographies[number])) for number in sorted(homographies))
        split = SPLITS.get(place.name[0], "other") if place.name[1:2] == "_" else "other"
        scenes.append(Scene(place.name, split, str(images["1"]), views))
    if not scenes:
        raise InputError(f"{folder}: no HPatches scene in it (1.ppm with H_1_2, ...); or use --synthesize for pictures")
    return scenes


def picture_scenes(folder: Path) -> list[Scene]:
    """A scene for each picture of a folder, whose views are random homographies of it.

    Raises:
        InputError: no such folder, or no picture in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder of pictures")
    pictures = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not pictures:
        raise InputError(f"{folder}: holds no pictures ({', '.join(SUFFIXES)}); give a folder of pictures")
    return [Scene(path.relative_to(folder).as_posix(), "synthetic", str(path), ()) for path in pictures]


def open_scene(scene: Scene, settings: HomographySettings) -> tuple[UInt8, list[View]]:
    """Reference image and views of a scene, made smaller to `settings.longest_side`.

    Random homographies depend on the seed and the picture's name only.

    Raises:
        InputError: an image or homography that cannot be read.
    """
    reference, from_original = _read_image(scene.reference, settings.longest_side)
    if not scene.views:
        return reference, _random_views(scene, reference, settings)
    views = []
    for image_path, homography_path in scene.views:
        image, view_from_original = _read_image(image_path, settings.longest_side)
        homography = view_from_original @ _read_homography(homography_path) @ np.linalg.inv(from_original)
        views.append(View(image, homography / homography[2, 2]))
    return reference, views


def _random_views(scene: Scene, reference: UInt8, settings: HomographySettings) -> list[View]:
    size = (reference.shape[1], reference.shape[0])
    # a view's sides are multiples of a network's cell
    height, width = (side // CELL * CELL for side in reference.shape)
    if min(height, width) < 2 * CELL:
        raise InputError(
            f"{scene.reference}: is {size[0]}x{size[1]} pixels; give pictures of {2 * CELL}x{2 * CELL} or more"
        )
    rng = np.random.default_rng([settings.seed, zlib.crc32(scene.name.encode("utf-8", "surrogateescape"))])
    shape = ViewSettings(height=height, width=width, smallest_zoom=0.7, largest_zoom=1.1)
    middle = np.array([size[0] - 1, size[1] - 1]) / 2.0
    homographies = [random_view(rng, shape, size, middle) for _ in range(settings.views)]
    return [View(warp_image(reference, H, width, height), np.asarray(H, np.float64)) for H in homographies]


def _read_image(path: str, longest_side: int) -> tuple[UInt8, Float64]:
    """Grey image of at most `longest_side`, and the homography (3, 3) from the file's pixels to its pixels."""
    import cv2

    try:
        image = read_grey(Path(path))
    except UnreadableFrameError as error:
        raise InputError(f"{path}: cannot be read as an image ({error}); remove or replace it") from None
    height, width = image.shape
    scale = longest_side / max(height, width)
    if scale >= 1:
        return image, np.eye(3)
    new_width, new_height = round(width * scale), round(height * scale)
    resized = cv2.resize(image, (new_width, new_height), interpolation=cv2.INTER_AREA)
    x, y = new_width / width, new_height / height
    # pixel edges map to pixel edges, and the first pixel's centre is 0
    return resized, np.array([[x, 0, 0.5 * x - 0.5], [0, y, 0.5 * y - 0.5], [0, 0, 1]])


def _read_homography(path: str) -> Float64:
    try:
        text = check_is_file(Path(path)).read_text(encoding="utf-8")
        matrix = np.array(text.split(), np.float64).reshape(3, 3)
    except (OSError, UnicodeDecodeError, ValueError):
        raise InputError(f"{path}: must hold the nine numbers of a homography; mend the file") from None
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise InputError(f"{path}: is no invertible homography; mend the file")
    return matrix
