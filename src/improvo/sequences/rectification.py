"""From raw images to the delivered pinhole view: undistorted once, then resized; depth too."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import check_field_of_view
from improvo.types import Float32, Float64, UInt8

MAX_FOV = 120.0  # degrees of the wider side, where nothing else is asked for
SMALLEST_CAP = 90.0  # degrees that a view is never narrowed below to keep the middle's resolution
_ZOOM_LIMITS = (1 / 64, 8.0)


class Rectifier:
    """Carries raw images and depth of one camera to a pinhole camera of the same or another width.

    A distorted camera gets the widest pinhole view of the raw size, pixel shape and principal point that shows no
    border: its focal lengths are the raw ones times `zoom`. A pinhole view wider than `MAX_FOV` would shrink its centre
    too much; such a view keeps the focal length of the centre instead. `description` says what part is left out.

    Args:
        raw: the camera of the recording's images.
        width: of the delivered frames in pixels; None is that of the recording.
        fov: degrees that the wider side of the undistorted view shall see, as far as the picture goes.

    Raises:
        InputError: a distortion that cannot be undone, or an angle that no pinhole has.
    """

    def __init__(self, raw: Camera, width: int | None = None, fov: float | None = None) -> None:
        if fov is not None:
            check_field_of_view(fov, "--undistorted-fov")
        self.raw = raw
        self.zoom = 1.0
        self._widest = 1.0
        self._maps: tuple[Float32, Float32] | None = None
        view = raw.pinhole()
        if not raw.is_pinhole:
            self._widest = _widest_zoom(raw)
            self.zoom = _chosen_zoom(raw, self._widest, fov)
            view = replace(view, fx=raw.fx * self.zoom, fy=raw.fy * self.zoom)
            self._maps = _maps(raw, view)
        self._undistorted = view
        if width is not None and width != view.width:
            view = view.resized(width, max(1, round(view.height * width / view.width)))
        self.camera = view

    @property
    def description(self) -> str:
        """What was done, for a person: the crop of the undistortion and the resize."""
        parts = []
        if self._maps is not None:
            parts.append(
                f"undistorted ({self.raw.distortion_model}) to a {self._undistorted.width}x{self._undistorted.height} "
                f"pinhole, focal length x {self.zoom:.3f}, {100 * self._share_kept():.0f} % of the raw picture kept"
            )
            if self.zoom > 1.001 * self._widest:
                parts[-1] += f" (--undistorted-fov shows up to {_fov(self.raw, self._widest):.0f} degrees)"
        if (self.camera.width, self.camera.height) != (self.raw.width, self.raw.height):
            parts.append(f"resized to {self.camera.width}x{self.camera.height}")
        return ", ".join(parts) or "as recorded"

    def image(self, image: UInt8) -> UInt8:
        """Raw image (H, W) or (H, W, C) -> delivered; sampling bilinear, shrinking by pixel area."""
        if self._maps is not None:
            image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        size = (self.camera.width, self.camera.height)
        if size != (image.shape[1], image.shape[0]):
            shrinks = size[0] < image.shape[1]
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return np.ascontiguousarray(image)

    def depth(self, depth: Float32) -> Float32:
        """Raw depth (H, W) -> depth of the delivered frame by nearest pixel, so that edges are not mixed."""
        if self._maps is not None:
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        size = (self.camera.width, self.camera.height)
        if size != (depth.shape[1], depth.shape[0]):
            depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return np.ascontiguousarray(depth)

    def _share_kept(self) -> float:
        """Area of the raw picture that the view shows, as a share."""
        contour = _distort_pixels(self.raw, self._undistorted, _border(self.raw.width, self.raw.height))
        x, y = contour[:, 0], contour[:, 1]
        area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
        return float(area / ((self.raw.width - 1) * (self.raw.height - 1) or 1))


def _widest_zoom(raw: Camera) -> float:
    """The smallest factor on the focal lengths at which every pixel of the view lies within the raw picture."""
    narrow, wide = _ZOOM_LIMITS[1], _ZOOM_LIMITS[0]
    border = _border(raw.width, raw.height)
    if not _inside(raw, narrow, border):
        size = f"{raw.width}x{raw.height}"
        raise InputError(f"distortion {raw.distortion} of the {size} camera cannot be undone; check the calibration")
    # from narrow to wide, so that a polynomial that folds back far outside is never reached
    zoom = narrow
    while zoom / 1.05 >= wide and _inside(raw, zoom / 1.05, border):
        zoom /= 1.05
    low, high = zoom / 1.05, zoom
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _inside(raw, middle, border) else (middle, high)
    return high


def _chosen_zoom(raw: Camera, widest: float, fov: float | None) -> float:
    """The factor on the focal lengths: the widest, unless that shows more than was asked for or than can be seen."""
    if fov is not None:
        return max(widest, _zoom_for(raw, fov))
    if _fov(raw, widest) <= MAX_FOV:
        return widest
    return max(widest, min(1.0, _zoom_for(raw, SMALLEST_CAP)), _zoom_for(raw, MAX_FOV))


def _fov(raw: Camera, zoom: float) -> float:
    """Degrees that the wider side of a pinhole view sees."""
    return float(2 * np.degrees(np.arctan(max(raw.width / raw.fx, raw.height / raw.fy) / (2 * zoom))))


def _zoom_for(raw: Camera, fov: float) -> float:
    return float(max(raw.width / raw.fx, raw.height / raw.fy) / (2 * np.tan(np.radians(fov) / 2)))


def _inside(raw: Camera, zoom: float, border: Float64) -> bool:
    view = replace(raw.pinhole(), fx=raw.fx * zoom, fy=raw.fy * zoom)
    pixels = _distort_pixels(raw, view, border)
    rays = view.unproject(border)[:, :2]
    # a ray further out must project further out; beyond that the polynomial is not valid
    further = raw.distort(rays * 1.001)
    here = raw.distort(rays)
    grows = (further**2).sum(axis=1) >= (here**2).sum(axis=1)
    limit = np.array([raw.width - 1, raw.height - 1]) + 1e-6
    return bool(np.isfinite(pixels).all() and (pixels >= -1e-6).all() and (pixels <= limit).all() and grows.all())


def _distort_pixels(raw: Camera, view: Camera, pixels: Float64) -> Float64:
    """Pixels (..., 2) of the pinhole view -> pixels of the raw image."""
    distorted = raw.distort(view.unproject(pixels)[..., :2])
    return np.asarray(distorted * [raw.fx, raw.fy] + [raw.cx, raw.cy])


def _maps(raw: Camera, view: Camera) -> tuple[Float32, Float32]:
    x, y = np.meshgrid(np.arange(view.width, dtype=np.float64), np.arange(view.height, dtype=np.float64))
    pixels = _distort_pixels(raw, view, np.stack([x, y], axis=-1)).astype(np.float32)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


def _border(width: int, height: int) -> Float64:
    """Pixels (N, 2) round the edge of a picture, in order."""
    x, y = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    top, bottom = np.zeros_like(x), np.full_like(x, height - 1)
    left, right = np.zeros_like(y), np.full_like(y, width - 1)
    sides = [(x, top), (right, y), (x[::-1], bottom), (left, y[::-1])]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])
