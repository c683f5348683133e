"""Nine families of drawn shapes whose corners are known exactly: what a detector can learn without any photograph.

The families are those of SuperPoint's synthetic data set (its section 4); the drawing is our own. Every picture is a
function of one random generator.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from improvo.types import Float32, Float64, UInt8

SUPERSAMPLED = 4  # drawn this much larger, then reduced: smooths edges, and makes OpenCV's wide outlines narrow
LEAST_CONTRAST = 40.0  # grey levels between a shape and what is behind it


class Canvas:
    """A picture being drawn; coordinates are pixels of the finished picture, with sub-pixel precision.

    Args:
        rng: of the background and its grey level.
        width: pixels.
        height: pixels.
    """

    def __init__(self, rng: np.random.Generator, width: int, height: int) -> None:
        self.rng, self.size = rng, np.array([width, height], np.float64)
        self.grey = float(rng.uniform(0, 255))
        self.image = _background(rng, width * SUPERSAMPLED, height * SUPERSAMPLED, self.grey)
        self.points: list[Float64] = []

    def contrasting(self, *others: float) -> float:
        """A grey level that differs from the background and from `others`."""
        for _ in range(50):
            grey = float(self.rng.uniform(0, 255))
            if all(abs(grey - other) >= LEAST_CONTRAST for other in (self.grey, *others)):
                return grey
        return 0.0 if self.grey > 127 else 255.0

    def polygon(self, corners: Float64, grey: float) -> None:
        """Fill a polygon with corners (N, 2)."""
        cv2.fillPoly(self.image, [_fixed(corners)], grey, cv2.LINE_8, 4)

    def line(self, start: Float64, end: Float64, grey: float, thickness: float) -> None:
        """Draw a line.

        Args:
            start: (2,) pixels.
            end: (2,) pixels.
            grey: level, 0 to 255.
            thickness: pixels.
        """
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        across = 0.5 * thickness * np.array([-along[1], along[0]])
        self.polygon(np.stack([start + across, end + across, end - across, start - across]), grey)

    def ellipse(self, centre: Float64, axes: Float64, angle: float, grey: float) -> None:
        """Fill an ellipse.

        Args:
            centre: (2,) pixels.
            axes: (2,) half axes, pixels.
            angle: of the first axis, radians.
            grey: level, 0 to 255.
        """
        turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        circle = np.stack([axes[0] * np.cos(turns), axes[1] * np.sin(turns)], axis=1)
        c, s = np.cos(angle), np.sin(angle)
        self.polygon(centre + circle @ np.array([[c, s], [-s, c]]), grey)

    def mark(self, points: Float64) -> None:
        """Corners (N, 2) of what was drawn."""
        self.points.extend(np.atleast_2d(points))

    def finished(self) -> tuple[UInt8, Float32]:
        """The picture (H, W) and its corners (N, 2) inside it."""
        size = (int(self.size[0]), int(self.size[1]))
        image = cv2.resize(self.image, size, interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image, (0, 0), self.rng.uniform(0.3, 0.8))
        points = np.array(self.points).reshape(-1, 2)
        kept = ((points >= 0) & (points <= self.size - 1)).all(axis=1)
        return np.clip(image, 0, 255).astype(np.uint8), points[kept].astype(np.float32)


def draw_shape(rng: np.random.Generator, family: str, width: int, height: int) -> tuple[UInt8, Float32]:
    """One picture of a family.

    Args:
        rng: of all choices.
        family: a key of `FAMILIES`.
        width: pixels.
        height: pixels.

    Returns:
        grey image (height, width) uint8, and its corners (N, 2) float32, x, y in pixels.
    """
    canvas = Canvas(rng, width, height)
    FAMILIES[family](canvas, rng)
    return canvas.finished()


def _lines(canvas: Canvas, rng: np.random.Generator) -> None:
    drawn: list[Float64] = []
    for _ in range(int(rng.integers(2, 11))):
        segment = rng.uniform(0, 1, (2, 2)) * canvas.size
        if np.linalg.norm(segment[1] - segment[0]) < 0.15 * canvas.size.min():
            continue
        if any(_segments_near(segment, other, 6.0) for other in drawn):
            continue
        drawn.append(segment)
        canvas.line(segment[0], segment[1], canvas.contrasting(), rng.uniform(1.0, 3.5))
        canvas.mark(segment)


def _polygon(canvas: Canvas, rng: np.random.Generator) -> None:
    radius = canvas.size.min() * rng.uniform(0.2, 0.48)
    centre = canvas.size * rng.uniform(0.35, 0.65, 2)
    corners = _random_polygon(rng, centre, radius)
    canvas.polygon(corners, canvas.contrasting())
    canvas.mark(corners)


def _polygons(canvas: Canvas, rng: np.random.Generator) -> None:
    placed: list[tuple[Float64, float]] = []
    for _ in range(30):
        radius = canvas.size.min() * rng.uniform(0.06, 0.2)
        centre = rng.uniform(0, 1, 2) * canvas.size
        if not _placed_apart(placed, centre, radius):
            continue
        corners = _random_polygon(rng, centre, radius)
        canvas.polygon(corners, canvas.contrasting())
        canvas.mark(corners)


def _ellipses(canvas: Canvas, rng: np.random.Generator) -> None:
    placed: list[tuple[Float64, float]] = []
    for _ in range(20):
        axes = canvas.size.min() * rng.uniform(0.03, 0.2, 2)
        centre = rng.uniform(0, 1, 2) * canvas.size
        if not _placed_apart(placed, centre, float(axes.max())):
            continue
        canvas.ellipse(centre, axes, rng.uniform(0, np.pi), canvas.contrasting())


def _star(canvas: Canvas, rng: np.random.Generator) -> None:
    branches = int(rng.integers(3, 7))
    centre = canvas.size * rng.uniform(0.35, 0.65, 2)
    angles = _spread_angles(rng, branches)
    lengths = canvas.size.min() * rng.uniform(0.15, 0.5, branches)
    ends = centre + lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    grey, thickness = canvas.contrasting(), rng.uniform(1.0, 3.5)
    for end in ends:
        canvas.line(centre, end, grey, thickness)
    canvas.mark(centre)
    canvas.mark(ends)


def _checkerboard(canvas: Canvas, rng: np.random.Generator) -> None:
    rows, columns = (int(v) for v in rng.integers(3, 8, 2))
    grid = _board(canvas, rng, np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1))
    first = canvas.contrasting()
    second = canvas.contrasting(first)
    for i in range(rows):
        for j in range(columns):
            corners = np.stack([grid[i, j], grid[i, j + 1], grid[i + 1, j + 1], grid[i + 1, j]])
            canvas.polygon(corners, first if (i + j) % 2 else second)
    canvas.mark(grid.reshape(-1, 2))


def _stripes(canvas: Canvas, rng: np.random.Generator) -> None:
    widths = rng.uniform(0.4, 1.0, int(rng.integers(4, 13)))
    edges = np.concatenate([[0.0], np.cumsum(widths)]) / widths.sum()
    grid = _board(canvas, rng, np.array([0.0, 1.0]), edges)
    grey = canvas.grey
    for j, (left, right) in enumerate(pairwise(range(len(edges)))):
        grey = canvas.contrasting(grey) if j else canvas.contrasting()
        canvas.polygon(np.stack([grid[0, left], grid[0, right], grid[1, right], grid[1, left]]), grey)
    canvas.mark(grid.reshape(-1, 2))


def _cube(canvas: Canvas, rng: np.random.Generator) -> None:
    """A box in space under weak perspective: of its eight corners the farthest is hidden."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    sides = rng.uniform(0.6, 1.0, 3)
    yaw, tilt, roll = np.radians(rng.uniform(20, 70)), np.radians(rng.uniform(20, 55)), rng.uniform(-0.4, 0.4)
    R = _rotation(2, roll) @ _rotation(0, tilt) @ _rotation(1, yaw)
    camera = (corners * sides) @ R.T + [0, 0, rng.uniform(5, 9)]
    projected = camera[:, :2] / camera[:, 2:]
    projected *= canvas.size.min() * rng.uniform(0.25, 0.45) / np.abs(projected).max()
    projected += canvas.size * rng.uniform(0.4, 0.6, 2)
    greys = [canvas.contrasting()]
    greys.append(canvas.contrasting(greys[0]))
    greys.append(canvas.contrasting(*greys))
    shown = set()
    faces = [[i for i in range(8) if corners[i, axis] == sign] for axis in range(3) for sign in (-1, 1)]
    for face in faces:
        a, b, d, c = face  # two edges share corner a; c is the one opposite
        normal = camera[face].mean(axis=0) - camera.mean(axis=0)
        if normal @ camera[face].mean(axis=0) >= 0:  # it looks away
            continue
        canvas.polygon(projected[[a, b, c, d]], greys.pop())
        shown.update(face)
    canvas.mark(projected[sorted(shown)])


def _noise(canvas: Canvas, rng: np.random.Generator) -> None:
    shape = canvas.image.shape
    grain = rng.standard_normal((shape[0] // SUPERSAMPLED, shape[1] // SUPERSAMPLED), np.float32)
    grain = cv2.resize(grain, shape[::-1], interpolation=cv2.INTER_NEAREST)
    canvas.image = canvas.image + grain * np.float32(rng.uniform(5, 60))


FAMILIES: dict[str, Callable[[Canvas, np.random.Generator], None]] = {
    "lines": _lines,
    "polygon": _polygon,
    "polygons": _polygons,
    "ellipses": _ellipses,
    "star": _star,
    "checkerboard": _checkerboard,
    "stripes": _stripes,
    "cube": _cube,
    "noise": _noise,
}


def _fixed(points: Float64) -> np.ndarray:
    """Pixels of the finished picture as OpenCV's fixed point (4 bits) in the supersampled one."""
    return np.round(((points + 0.5) * SUPERSAMPLED - 0.5) * 16).astype(np.int32)


def _background(rng: np.random.Generator, width: int, height: int, grey: float) -> np.ndarray:
    """A grey level with soft blotches of any size, never as strong as a shape's contrast."""
    cells = int(rng.integers(2, 24))
    blotches = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
    blotches = cv2.resize(blotches, (width, height), interpolation=cv2.INTER_LINEAR)
    return (grey + blotches * np.float32(rng.uniform(0, 0.4) * LEAST_CONTRAST)).astype(np.float32)


def _spread_angles(rng: np.random.Generator, count: int) -> Float64:
    """Increasing angles once round, none of them close to the next."""
    shares = rng.uniform(0.6, 1.4, count)
    return np.asarray(rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.cumsum(shares) / shares.sum())


def _random_polygon(rng: np.random.Generator, centre: Float64, radius: float) -> Float64:
    """Corners (N, 2), N from 3 to 7, in order; each of them a visible bend."""
    while True:
        angles = _spread_angles(rng, int(rng.integers(3, 8)))
        radii = radius * rng.uniform(0.6, 1.0, len(angles))
        corners = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
        bend = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
        bend /= np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        if bend.min() > 0.35:
            return np.asarray(corners)


def _placed_apart(placed: list[tuple[Float64, float]], centre: Float64, radius: float) -> bool:
    """Whether a circle keeps 3 pixels from those that are placed; it is then one of them."""
    if any(np.linalg.norm(centre - other) < radius + r + 3 for other, r in placed):
        return False
    placed.append((centre, radius))
    return True


def _segments_near(one: Float64, other: Float64, distance: float) -> bool:
    t = np.linspace(0, 1, 40)[:, None]
    a, b = one[0] + t * (one[1] - one[0]), other[0] + t * (other[1] - other[0])
    return bool((np.linalg.norm(a[:, None] - b[None], axis=2) < distance).any())


def _board(canvas: Canvas, rng: np.random.Generator, rows: Float64, columns: Float64) -> Float64:
    """(R, C, 2) grid points of a flat board in perspective."""
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    spread = rng.uniform(0.25, 0.48) * canvas.size
    quad = canvas.size / 2 + (2 * unit - 1 + rng.uniform(-0.35, 0.35, (4, 2))) * spread
    angle = rng.uniform(-0.6, 0.6)
    c, s = np.cos(angle), np.sin(angle)
    quad = canvas.size / 2 + (quad - canvas.size / 2) @ np.array([[c, s], [-s, c]])
    H = cv2.getPerspectiveTransform(unit, quad.astype(np.float32))
    y, x = np.meshgrid(rows, columns, indexing="ij")
    homogeneous = np.stack([x, y, np.ones_like(x)], axis=-1) @ H.T
    return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])


def _rotation(axis: int, angle: float) -> Float64:
    vector = np.zeros(3)
    vector[axis] = angle
    return np.asarray(cv2.Rodrigues(vector)[0])
