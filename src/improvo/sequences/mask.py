"""Masks of frames: keypoints lie on white pixels only, never on black ones.

A mask has the size of the recording's own images, and is undistorted, cropped and resized like them. A descriptor uses
some pixels around its keypoint, so a border around black areas counts as black too.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import Recording, UnreadableFrameError
from improvo.sequences.images import grey, list_images, read_image
from improvo.sequences.rectification import Rectifier
from improvo.types import Mask, UInt8
from improvo.untrusted.paths import check_is_file

BORDER = 6  # delivered pixels around black areas
_WHITE = 128  # grey level from which on a pixel is used
_PROBES = 5  # masks of a folder that are looked at before any work


class SequenceMasks:
    """The masks of a recording's frames, in the geometry of the frames as delivered.

    Args:
        path: an image for all frames, or a folder with one for each frame: with the names of the images, or else in
            the order of the recording. Where the folder has a subfolder or an image with the name of the recording,
            that is taken, so that one folder serves several recordings.
        recording: whose frames they are.
        name: of the recording.
        rectifier: carries raw images to delivered ones.

    Raises:
        InputError: nothing there, no image, an image of another size, not one for each frame, or black everywhere.
    """

    def __init__(self, path: str, recording: Recording, name: str, rectifier: Rectifier) -> None:
        self._rectifier = rectifier
        self._size = rectifier.raw.width, rectifier.raw.height
        chosen = chosen_mask(Path(path), name)
        self._files: list[Path] | None = None
        self._read = lru_cache(maxsize=4)(self._delivered)
        if chosen.is_dir():
            self._files = _one_for_each_frame(chosen, recording)
            rows = np.unique(np.linspace(0, len(self._files) - 1, min(_PROBES, len(self._files))).astype(int))
            probes = [self._files[row] for row in rows.tolist()]
        else:
            self._single, probes = chosen, [chosen]
        for file in self._files or ():  # before any work; the sizes stand at the beginning of the files
            self._check_size(file, size_of(file))
        used = [float(self._read(file).mean()) for file in probes]
        if max(used) == 0:
            brightest = int(_image(probes[0]).max())
            raise InputError(
                f"{chosen}: leaves no pixel to use (its brightest is {brightest} of 255); paint white what is to be "
                "used, and black what is not"
            )
        self.used = float(np.mean(used))  # share of the picture

    def __getitem__(self, index: int) -> Mask:
        """(H, W) the mask of frame `index` of the recording, read-only.

        Raises:
            InputError: it cannot be read, or has another size.
        """
        return self._read(self._single if self._files is None else self._files[index])

    def raw(self, index: int) -> UInt8:
        """(H, W) the mask of frame `index` in the size of the recorded picture: 255 used, 0 not, border included.

        Raises:
            InputError: it cannot be read, or has another size.
        """
        file = self._single if self._files is None else self._files[index]
        raw = _image(file)
        self._check_size(file, (raw.shape[1], raw.shape[0]))
        return np.where(_without_border(raw >= _WHITE), np.uint8(255), np.uint8(0))

    @property
    def description(self) -> str:
        """What is masked, for a person."""
        return f"{100 * (1 - self.used):.0f} % masked"

    def _delivered(self, file: Path) -> Mask:
        raw = _image(file)
        self._check_size(file, (raw.shape[1], raw.shape[0]))
        mask = delivered_mask(raw, self._rectifier)
        mask.flags.writeable = False
        return mask

    def _check_size(self, file: Path, size: tuple[int, int] | None) -> None:
        if size is not None and size != self._size:
            raise InputError(
                f"{file}: the mask is {size[0]}x{size[1]}, the images of the recording are "
                f"{self._size[0]}x{self._size[1]}; give a mask of their size"
            )


def delivered_mask(raw: UInt8, rectifier: Rectifier) -> Mask:
    """(H, W) of the delivered frame: white pixels of the raw mask, without the border around black ones."""
    # every raw pixel that contributes to a delivered one must be white
    white = rectifier.image(np.where(raw >= _WHITE, np.uint8(255), np.uint8(0))) == 255
    return _without_border(white)


def _without_border(white: Mask) -> Mask:
    """What is farther than the border from black; outside the picture nothing counts as black."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BORDER + 1, 2 * BORDER + 1))
    return np.asarray(cv2.erode(white.astype(np.uint8), disc), np.bool_)


def size_of(file: Path) -> tuple[int, int] | None:
    """Width and height of an image, from its header; None where that cannot be told."""
    from PIL import Image

    try:
        check_is_file(file)
        with Image.open(file) as image:
            return image.size
    except Exception:  # Pillow raises errors of many kinds
        return None


def _image(file: Path) -> UInt8:
    try:
        return grey(read_image(file))
    except UnreadableFrameError as error:
        raise InputError(f"{file}: cannot be read as a mask ({error}); give an image, white where used") from None


def chosen_mask(path: Path, name: str) -> Path:
    """The part of a path of masks that belongs to the recording `name`.

    Raises:
        InputError: nothing there.
    """
    if not path.exists():
        raise InputError(f"--mask {path}: no such file or folder; `improvo info SEQUENCE --write-mask FILE` makes one")
    if not path.is_dir():
        return path
    own = [path / name, *(file for file in list_images(path) if file.stem == name)]
    return next((each for each in own if each.exists()), path)


def _one_for_each_frame(folder: Path, recording: Recording) -> list[Path]:
    """The mask files in the order of the recording's frames."""
    files = list_images(folder)
    if not files:
        raise InputError(f"{folder}: holds no image; give a mask, or a folder with one for each frame")
    by_name = {file.stem: file for file in files}
    names = [Path(recording.source(index)).name for index in range(len(recording))]
    named = [by_name.get(Path(name).stem) or by_name.get(name) for name in names]  # frame.png, or frame.jpg.png
    found = [file for file in named if file is not None]
    if len(found) == len(names):
        return found
    if found:
        missing = next(name for name, file in zip(names, named, strict=True) if file is None)
        raise InputError(f"{folder}: has masks of {len(found)} of {len(names)} frames, none of {missing}; add the rest")
    if len(files) != len(names):
        raise InputError(
            f"{folder}: has {len(files)} masks with other names than the {len(names)} frames; give one for each frame, "
            "or a single image"
        )
    return files
