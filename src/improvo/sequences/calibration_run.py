"""A recording of a board -> `camera.yaml` and a picture of where the board was."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError, OutputError
from improvo.files import write_text, written_atomically
from improvo.sequences.base import Recording, UnreadableFrameError
from improvo.sequences.board import Board
from improvo.sequences.calibration import calibration_yaml
from improvo.sequences.camera_fit import CameraFit, choose_views, find_views, fit_camera
from improvo.sequences.images import grey
from improvo.types import UInt8


def calibrate(
    recording: Recording,
    board: Board,
    model: str = "auto",
    samples: int = 120,
    views: int = 40,
    progress: Callable[[bool], object] = lambda _: None,
) -> CameraFit:
    """Calibrate the camera that made a recording.

    Args:
        recording: of the board, from many sides; its own calibration is not used.
        board: what it shows.
        model: see `camera_fit.MODELS`.
        samples: frames to search, spread over the recording.
        views: how many of the found boards to use at most.
        progress: called for each searched frame with whether the board was found.

    Raises:
        InputError: no readable frame, or views that leave the camera undetermined.
    """
    rows = np.unique(np.linspace(0, len(recording) - 1, min(samples, len(recording))).astype(int))
    size: list[tuple[int, int]] = []
    found = find_views(board, _pictures(recording, rows.tolist(), size), progress)
    if not size:
        raise InputError(f"{recording.path}: none of its frames can be read; check the recording")
    try:
        return fit_camera(choose_views(found, views), size[0], model)
    except InputError as error:
        raise InputError(f"{recording.path}: {error} (found in {len(found)} of {len(rows)} searched frames)") from None


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


def _pictures(recording: Recording, rows: list[int], size: list[tuple[int, int]]) -> Iterator[tuple[str, UInt8]]:
    """Readable grey pictures of the size of the first, which is put into `size`."""
    for row in rows:
        try:
            image = grey(recording.image(row))
        except UnreadableFrameError:
            continue
        if not size:
            size.append((image.shape[1], image.shape[0]))
        if size[0] == (image.shape[1], image.shape[0]):
            yield recording.source(row), image
