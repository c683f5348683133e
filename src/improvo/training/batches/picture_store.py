"""Pictures and depth maps of any sizes in one flat buffer of a device, and views of them made there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from improvo.training.device import on_device
from improvo.types import Float32, Float64, Int64, Mask, UInt8

_REDUCED_ABOVE = 1.5  # pixels of the picture per pixel of the view from which on the halved picture is looked at


class PictureStore:
    """Grey pictures on a device, each in full and halved, so that a view from afar does not alias.

    Args:
        pictures: (H, W) uint8 each, of any sizes.
    """

    def __init__(self, pictures: Sequence[UInt8], device: torch.device) -> None:
        halved = [
            cv2.resize(picture, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
            for picture in pictures
        ]
        self.count = len(pictures)
        every = [*pictures, *halved]
        self.sizes = np.array([picture.shape[::-1] for picture in every], np.int64)  # (2N, 2) width, height
        self.starts = _starts(self.sizes)
        self.pixels = torch.from_numpy(np.concatenate([picture.ravel() for picture in every])).to(device)

    def views(self, rows: Int64, view_from_picture: Float64, width: int, height: int) -> Tensor:
        """(V, 1, height, width) float32 grey levels; what lies outside a picture is mirrored.

        Args:
            rows: (V,) numbers of pictures.
            view_from_picture: (V, 3, 3).
        """
        picture_from_view = np.asarray(np.linalg.inv(view_from_picture), np.float64)
        rows, picture_from_view = self._suited_level(rows, picture_from_view, width, height)
        device = self.pixels.device
        H = on_device(picture_from_view, device)[..., None, None]
        start, size = self._places(rows)
        x = torch.arange(width, device=device, dtype=torch.float32)
        y = torch.arange(height, device=device, dtype=torch.float32)[:, None]
        depth = H[:, 2, 0] * x + H[:, 2, 1] * y + H[:, 2, 2]
        shown = [(H[:, row, 0] * x + H[:, row, 1] * y + H[:, row, 2]) / depth for row in (0, 1)]
        (x0, x1, right), (y0, y1, down) = (
            _neighbours(_mirrored(shown[axis], size[:, axis, None]), size[:, axis, None]) for axis in (0, 1)
        )
        above, below = start + y0 * size[:, :1], start + y1 * size[:, :1]
        grey = [self.pixels[place].float() for place in (above + x0, above + x1, below + x0, below + x1)]
        upper, lower = torch.lerp(grey[0], grey[1], right), torch.lerp(grey[2], grey[3], right)
        return torch.lerp(upper, lower, down)[:, None]

    def grey(self, rows: Int64, points: Tensor, level: int) -> Tensor:
        """(P, ...) bilinear grey levels at pixels (P, ..., 2) of a level of the pictures; those of the edge outside.

        Args:
            rows: (P,) numbers of pictures.
            level: 0 the pictures, 1 the halved ones.
        """
        rows = rows + level * self.count
        shape = (-1, *(1,) * (points.ndim - 2))
        start = on_device(self.starts[rows], points.device).view(shape)
        size = on_device(self.sizes[rows], points.device)
        (x0, x1, right), (y0, y1, down) = (
            _neighbours(torch.minimum(points[..., axis].clamp(min=0), last), last.long() + 1)
            for axis, last in enumerate((size - 1.0).T.reshape(2, *shape))
        )
        width = size[:, 0].view(shape)
        above, below = start + y0 * width, start + y1 * width
        corners = [self.pixels[place].float() for place in (above + x0, above + x1, below + x0, below + x1)]
        return torch.lerp(torch.lerp(corners[0], corners[1], right), torch.lerp(corners[2], corners[3], right), down)

    def on_level(self, rows: Int64, points: Tensor, level: int) -> Tensor:
        """Pixels (P, N, 2) of the pictures as pixels of a level."""
        return (points + 0.5) * self._ratio(rows, level, points) - 0.5

    def off_level(self, rows: Int64, points: Tensor, level: int) -> Tensor:
        """Pixels (P, N, 2) of a level as pixels of the pictures."""
        return (points + 0.5) / self._ratio(rows, level, points) - 0.5

    def _ratio(self, rows: Int64, level: int, points: Tensor) -> Tensor:
        """(P, 1, 2) pixels of a level per pixel of the picture."""
        return on_device(self.sizes[rows + level * self.count] / self.sizes[rows], points.device)[:, None]

    def _suited_level(self, rows: Int64, picture_from_view: Float64, width: int, height: int) -> tuple[Int64, Float64]:
        """Rows of halved pictures where the view looks from afar, and their homographies."""
        middle = np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
        depth = picture_from_view[:, 2] @ middle
        zoom = np.sqrt(np.abs(np.linalg.det(picture_from_view) / depth**3))  # of areas at the middle of the view
        far = zoom > _REDUCED_ABOVE
        reduced = np.where(far, rows + self.count, rows)
        ratio = self.sizes[reduced] / self.sizes[rows]
        scale = np.zeros((len(rows), 3, 3))
        scale[:, 0, 0], scale[:, 1, 1], scale[:, 2, 2] = ratio[:, 0], ratio[:, 1], 1.0
        scale[:, :2, 2] = 0.5 * ratio - 0.5
        return reduced, scale @ picture_from_view

    def _places(self, rows: Int64) -> tuple[Tensor, Tensor]:
        """First pixel (V, 1, 1) and width, height (V, 2, 1) int64 on the device."""
        device = self.pixels.device
        start = on_device(self.starts[rows], device)[:, None, None]
        return start, on_device(self.sizes[rows], device)[..., None]


class MaskStore:
    """Which places of pictures are used, on a device; masks are kept at a quarter of their size.

    Args:
        masks: (H, W) each, which pixels are used; None where all are.
        sizes: (N, 2) width, height of the pictures.
    """

    def __init__(self, masks: Sequence[Mask | None], sizes: Int64, device: torch.device) -> None:
        everywhere = np.ones((2, 2), np.float32)
        maps = [everywhere if mask is None else _quartered(mask) for mask in masks]
        scales = [(w / m.shape[1], h / m.shape[0]) for (w, h), m in zip(sizes.tolist(), maps, strict=True)]
        self._maps = DepthStore(maps, np.array(scales).reshape(-1, 2), device)

    def used(self, rows: Int64, points: Tensor) -> Tensor:
        """(V, N) bool, whether places (V, N, 2) of pictures lie on used pixels alone; places near the edge do too."""
        size = on_device(self._maps.sizes[rows] - 1, points.device)[:, None]
        scale = on_device(self._maps.scales[rows], points.device)[:, None]
        middles = torch.minimum(((points + 0.5) / scale - 0.5).clamp(min=0), size.float())
        return self._maps.sample(rows, (middles + 0.5) * scale - 0.5) > 0


class DepthStore:
    """Inverse depth maps on a device; 0 where nothing is known.

    Args:
        maps: (h, w) each, 1 / depth of a grid over the frame.
        scales: (N, 2) pixels of the frame per pixel of the map, along x and y.
    """

    def __init__(self, maps: Sequence[Float32], scales: Float64, device: torch.device) -> None:
        self.sizes = np.array([values.shape[::-1] for values in maps], np.int64).reshape(-1, 2)
        self.starts = _starts(self.sizes)
        self.scales = scales
        flat = [values.ravel() for values in maps]
        self.values = torch.from_numpy(np.concatenate(flat) if flat else np.zeros(1, np.float32)).to(device)

    def sample(self, rows: Int64, points: Tensor) -> Tensor:
        """Inverse depth (V, N) at pixels (V, N, 2) of the frames; 0 outside, at steps and where nothing is known.

        Args:
            rows: (V,) numbers of maps.
        """
        device = self.values.device
        start = on_device(self.starts[rows], device)[:, None]
        size = on_device(self.sizes[rows], device)[:, None]
        scale = on_device(self.scales[rows], device)[:, None]
        places = (points + 0.5) / scale - 0.5
        within = ((places >= 0) & (places <= size - 1)).all(dim=-1)
        places = torch.where(within[..., None], places, 0.0)
        (x0, x1, right), (y0, y1, down) = (_neighbours(places[..., axis], size[..., axis]) for axis in (0, 1))
        above, below = start + y0 * size[..., 0], start + y1 * size[..., 0]
        corners = torch.stack([self.values[place] for place in (above + x0, above + x1, below + x0, below + x1)])
        upper, lower = torch.lerp(corners[0], corners[1], right), torch.lerp(corners[2], corners[3], right)
        least, most = corners.amin(dim=0), corners.amax(dim=0)
        smooth = within & (least > 0) & (most < 1.15 * least)
        return torch.where(smooth, torch.lerp(upper, lower, down), 0.0)


def _quartered(mask: Mask) -> Float32:
    height, width = mask.shape
    small = cv2.resize(mask.astype(np.uint8) * 255, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    return (small == 255).astype(np.float32)


def _starts(sizes: Int64) -> Int64:
    return np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int64) if len(sizes) else sizes[:, 0]


def _mirrored(places: Tensor, size: Tensor) -> Tensor:
    """Coordinates folded into 0..size-1, the edge pixels once, as OpenCV's BORDER_REFLECT_101."""
    last = (size - 1).float()
    return last - (last - places.abs() % (2 * last)).abs()


def _neighbours(places: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two pixels about a coordinate within 0..size-1, and the share of the second."""
    first = places.floor()
    low = first.long()
    return low, torch.minimum(low + 1, size - 1), places - first
