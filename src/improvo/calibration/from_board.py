"""A recording of a board -> `camera.yaml` and a picture of where the board was."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from improvo.calibration.board import Board
from improvo.calibration.camera_fit import CameraFit, choose_views, find_views, fit_camera
from improvo.errors import InputError, OutputError
from improvo.files import write_text, written_atomically
from improvo.geometry.camera_files import calibration_yaml
from improvo.types import UInt8


def calibrate(
    pictures: Iterable[tuple[str, UInt8]],
    board: Board,
    model: str = "auto",
    views: int = 40,
    progress: Callable[[bool], object] = lambda _: None,
) -> CameraFit:
    """Calibrate the camera that made pictures of a board.

    Args:
        pictures: name and grey picture (H, W) of each, from many sides; those of another size than the first are
            left out.
        board: what they show.
        model: see `camera_fit.MODELS`.
        views: how many of the found boards to use at most.
        progress: called for each searched picture with whether the board was found.

    Raises:
        InputError: no picture, or views that leave the camera undetermined.
    """
    size: list[tuple[int, int]] = []
    searched = 0

    def of_one_size() -> Iterator[tuple[str, UInt8]]:
        nonlocal searched
        for name, picture in pictures:
            if not size:
                size.append((picture.shape[1], picture.shape[0]))
            if size[0] == (picture.shape[1], picture.shape[0]):
                searched += 1
                yield name, picture

    found = find_views(board, of_one_size(), progress)
    if not size:
        raise InputError("none of its frames can be read; check the recording")
    try:
        return fit_camera(choose_views(found, views), size[0], model)
    except InputError as error:
        raise InputError(f"{error} (found in {len(found)} of {searched} searched frames)") from None


def write_camera(path: Path, fit: CameraFit) -> None:
    """`camera.yaml`, with the error and the deviations as comments."""
    deviations = ", ".join(f"{name} {value:.2g}" for name, value in fit.deviations.items())
    comment = f"# from {len(fit.views)} views of a board: RMS {fit.rms:.3f} px; standard deviations {deviations}\n"
    write_text(path, comment + calibration_yaml(fit.camera))


def write_coverage(path: Path, fit: CameraFit) -> None:
    """A picture of the camera's frame with all corners, green where they fit and red where they do not."""
    camera = fit.camera
    canvas = np.full((camera.height, camera.width, 3), 255, np.uint8)
    rows, columns = fit.coverage.shape
    for row, column in np.argwhere(fit.coverage == 0).tolist():
        corner = (column * camera.width // columns, row * camera.height // rows)
        opposite = ((column + 1) * camera.width // columns, (row + 1) * camera.height // rows)
        cv2.rectangle(canvas, corner, opposite, (225, 225, 225), cv2.FILLED)
    radius = max(1, camera.width // 320)
    worst = max(1.0, 3 * float(np.median(fit.view_errors)))  # pixels; anything below one is fine
    for view, error in zip(fit.views, fit.view_errors.tolist(), strict=False):
        share = min(1.0, error / worst)
        colour = (0, round(170 * (1 - share)), round(230 * share))
        for x, y in np.rint(view.pixels).astype(int).tolist():
            cv2.circle(canvas, (x, y), radius, colour, cv2.FILLED, cv2.LINE_AA)
    text = f"{len(fit.views)} views, RMS {fit.rms:.2f} px; grey: no corner"
    scale = camera.width / 1200
    cv2.putText(
        canvas, text, (8, camera.height - 8), cv2.FONT_HERSHEY_SIMPLEX, max(scale, 0.4), (0, 0, 0), 1, cv2.LINE_AA
    )
    with written_atomically(path) as temporary:
        encoded, data = cv2.imencode(".png", canvas)
        if not encoded:
            raise OutputError(f"{path}: the picture cannot be encoded")
        temporary.write_bytes(data.tobytes())
