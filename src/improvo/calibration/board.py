"""Calibration boards: what `--board` says, where its corners are in a picture, and the board itself as a PDF."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError, require_plots
from improvo.files import written_atomically
from improvo.types import Float32, Float64, UInt8

MARKER_SHARE = 0.75  # of a ChArUco square
PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "letter": (215.9, 279.4)}  # millimetres
_SPECIFICATION = re.compile(r"(charuco:)?(\d{1,2})x(\d{1,2}):(\d+(?:\.\d+)?)(mm|cm|m)?", re.IGNORECASE)
_UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0}
_MAX_SIDE = 1280  # pixels in which the board is first looked for
# half the window in which a corner is refined, as a share of the distance to the next one
_CLEAR_OF_CORNERS, _CLEAR_OF_MARKERS = 0.3, 0.12
_MARGIN = 10.0  # millimetres of paper that printers leave white


@dataclass(frozen=True)
class Board:
    """A flat board. Checkerboards are named by their inner corners, ChArUco boards by their squares, as is usual."""

    columns: int
    rows: int
    square: float  # metres
    charuco: bool = False

    @cached_property
    def points(self) -> Float32:
        """(N, 3) metres, inner corners row by row, z = 0."""
        columns, rows = (self.columns - 1, self.rows - 1) if self.charuco else (self.columns, self.rows)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        if self.charuco:
            x, y = x + 1, y + 1
        return (np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1) * self.square).astype(np.float32)

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        return (self.columns, self.rows) if self.charuco else (self.columns + 1, self.rows + 1)

    def find(self, image: UInt8) -> tuple[Float32, Float32] | None:
        """Corners in a grey picture.

        Returns:
            Points (N, 3) on the board in metres and their pixels (N, 2); None where the board is not (wholly) seen.
            A ChArUco board may be seen in part, from eight corners on.
        """
        return self._find_charuco(image) if self.charuco else self._find_checkerboard(image)

    def _find_checkerboard(self, image: UInt8) -> tuple[Float32, Float32] | None:
        shrink = max(1.0, max(image.shape) / _MAX_SIDE)
        small = image if shrink == 1 else cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink)
        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        pixels = ((corners.reshape(-1, 2) + 0.5) * shrink - 0.5).astype(np.float32)
        return self.points, _refined(image, pixels, _CLEAR_OF_CORNERS)

    def _find_charuco(self, image: UInt8) -> tuple[Float32, Float32] | None:
        corners, ids, _, _ = self._detector.detectBoard(image)
        if ids is None or len(ids) < 8:
            return None
        points = self.points[ids.ravel()]
        if min(len(np.unique(points[:, 0])), len(np.unique(points[:, 1]))) < 2:
            return None
        return points, _refined(image, corners.reshape(-1, 2), _CLEAR_OF_MARKERS)

    @cached_property
    def charuco_board(self) -> Any:
        """OpenCV's board, with markers of the smallest 5x5 dictionary that has enough."""
        needed = self.columns * self.rows // 2
        names = (("50", 50), ("100", 100), ("250", 250), ("1000", 1000))
        name = next(name for name, count in names if needed <= count)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_5X5_{name}"))
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square, MARKER_SHARE * self.square, dictionary)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self.charuco_board)


def parse_board(text: str) -> Board:
    """`9x6:25mm`: a checkerboard with 9 by 6 inner corners and squares of 25 mm; `charuco:8x11:20mm`: 8 by 11 squares.

    Raises:
        InputError: anything else, a board with too few corners, or one with more squares than there are markers.
    """
    match = _SPECIFICATION.fullmatch(text.strip())
    if match is None:
        raise InputError(f"--board {text}: write it as 9x6:25mm (inner corners) or charuco:8x11:20mm (squares)")
    columns, rows = int(match.group(2)), int(match.group(3))
    square = float(match.group(4)) * _UNITS[(match.group(5) or "mm").lower()]
    board = Board(columns, rows, square, match.group(1) is not None)
    if min(columns, rows) < 3 or not 0.001 <= square <= 1.0:
        raise InputError(f"--board {text}: needs at least 3x3 corners and squares of 1 mm to 1 m")
    if board.charuco and columns * rows > 2000:
        raise InputError(f"--board {text}: has more squares than there are markers; use fewer")
    return board


def print_board(board: Board, path: Path, paper: str = "A4") -> None:
    """The board at true size as a vector PDF, with a ruler of 100 mm to check the printer.

    Raises:
        InputError: it does not fit on the paper.
        OutputError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("printing a board")
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    columns, rows = board.squares
    side = 1000 * board.square
    width, height = columns * side, rows * side
    page = PAPERS[paper]
    for page_width, page_height in (page, page[::-1]):
        if width + 2 * _MARGIN <= page_width and height + 2 * _MARGIN + 12 <= page_height:
            break
    else:
        raise InputError(
            f"a board of {width:.0f}x{height:.0f} mm does not fit on {paper}; use smaller squares or --paper"
        )
    figure = Figure(figsize=(page_width / 25.4, page_height / 25.4))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, page_width)
    axes.set_ylim(page_height, 0)
    axes.axis("off")
    left, top = (page_width - width) / 2, (page_height - height - 12) / 2
    for x, y, size in _black(board):
        corner = (left + 1000 * x, top + 1000 * y)
        axes.add_patch(Rectangle(corner, 1000 * size, 1000 * size, facecolor="black", edgecolor="none", linewidth=0))
    ruler = min(100.0, width)
    axes.plot([left, left + ruler], [top + height + 6] * 2, color="black", linewidth=0.8)
    for x in (left, left + ruler):
        axes.plot([x, x], [top + height + 4.5, top + height + 7.5], color="black", linewidth=0.8)
    kind = "ChArUco, squares" if board.charuco else "checkerboard, inner corners"
    text = f"{ruler:.0f} mm if printed at 100 %   {kind} {board.columns}x{board.rows}, square {side:g} mm"
    axes.text(left, top + height + 11, text, fontsize=7)
    with written_atomically(path) as temporary:
        figure.savefig(temporary, format="pdf")


def _black(board: Board) -> list[tuple[float, float, float]]:
    """x, y and size in metres of the black squares, the markers' own among them."""
    columns, rows = board.squares
    cells = [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == 0]
    black = [(c * board.square, r * board.square, board.square) for c, r in cells]
    if board.charuco:
        white = [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == 1]
        dictionary = board.charuco_board.getDictionary()
        bits_aside = 7  # five bits and a border
        bit = MARKER_SHARE * board.square / bits_aside
        for number, (c, r) in zip(board.charuco_board.getIds().ravel().tolist(), white, strict=False):
            picture = cv2.aruco.generateImageMarker(dictionary, number, bits_aside)
            inset = (1 - MARKER_SHARE) / 2 * board.square
            for row, column in np.argwhere(picture < 128).tolist():
                black.append((c * board.square + inset + column * bit, r * board.square + inset + row * bit, bit))
    return black


def _refined(image: UInt8, corners: Float32, share: float) -> Float32:
    """Corners (N, 2) to a fraction of a pixel, from the grey around each.

    Halves the checkerboard detector's own error (0.13 to 0.06 px in rendered pictures). The window stays clear of what
    is not the corner's own: other corners, or a ChArUco board's markers.
    """
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    half = int(np.clip(round(share * float(distance.min())), 2, 15))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2).copy()
    refined = np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria)).reshape(-1, 2)
    moved = np.linalg.norm(refined - corners, axis=1) > half
    return np.where(moved[:, None], corners, refined).astype(np.float32)


def homography_tilt(points: Float32, pixels: Float32, size: tuple[int, int]) -> Float64:
    """How a view shows the board: centre x, y and extent as shares of the picture, and the two perspective terms."""
    scale = float(max(size))
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    homography, _ = cv2.findHomography(flat / (np.abs(flat).max() or 1.0), pixels / scale)
    if homography is None:
        return np.zeros(5)
    homography = homography / homography[2, 2]
    x, y = pixels.mean(axis=0) / np.array(size)
    extent = np.sqrt(np.ptp(pixels[:, 0]) * np.ptp(pixels[:, 1])) / scale
    return np.array([x, y, extent, 2 * homography[2, 0], 2 * homography[2, 1]])
