"""The depth map of one frame of a sequence with known poses: neighbours, depth range, plane sweep, refinement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from improvo.depth.depth_map import DepthMap, half_intrinsics
from improvo.depth.depth_range import search_depth_range
from improvo.depth.neighbours import choose_neighbours
from improvo.depth.plane_sweep import sweep_prepared
from improvo.depth.prepared_image import PreparedImage, prepare_image
from improvo.depth.refine import refine_depth
from improvo.depth.settings import DepthSettings
from improvo.geometry import se3
from improvo.types import Float64, UInt8


def sweep_depth(
    images: Sequence[UInt8] | Mapping[int, UInt8],
    cam_from_world: Float64,
    K: Float64,
    frame: int,
    candidates: Sequence[int],
    depth_range: tuple[float, float, float] | None = None,
    settings: DepthSettings | None = None,
) -> DepthMap:
    """The depth map of one frame, at half resolution and in the unit of the poses.

    Args:
        images: grey images (H, W) uint8; `images[row]` is read for the frame and its candidates only.
        cam_from_world: (N, 4, 4) float64 poses; rows with NaN are no candidates.
        K: (3, 3) float64, of the images as given.
        frame: row of the frame.
        candidates: rows that may serve as neighbours, such as those up to 60 before and after the frame.
        depth_range: nearest, median and farthest depth, as `range_of_depths` makes them from sparse points; without
            it they are searched for with a coarse sweep, which takes about as long again.
        settings: all numbers.

    Returns:
        A map that is empty (0 everywhere) where the camera moved too little, or where nothing can be matched.
    """
    prepared: dict[int, PreparedImage] = {}

    def prepare(row: int) -> PreparedImage:
        if row not in prepared:
            prepared[row] = prepare_image(images[row])
        return prepared[row]

    half = half_intrinsics(K)
    return frame_depth(prepare, cam_from_world, half, frame, candidates, depth_range, settings or DepthSettings())[0]


def frame_depth(
    prepare: Callable[[int], PreparedImage],
    cam_from_world: Float64,
    K: Float64,
    frame: int,
    candidates: Sequence[int],
    depth_range: tuple[float, float, float] | None,
    settings: DepthSettings,
) -> tuple[DepthMap, list[int]]:
    """As `sweep_depth`, over prepared images and their `K`; also returns the neighbours that were chosen."""
    reference = prepare(frame)
    width, height = reference.size
    if depth_range is None:
        depth_range = search_depth_range(prepare, cam_from_world, K, frame, candidates, settings)
    if depth_range is None:
        return DepthMap.empty(height, width, K), []
    near, median, far = depth_range
    rows = choose_neighbours(cam_from_world, K, (width, height), frame, candidates, median, settings.neighbours)
    if not rows:
        return DepthMap.empty(height, width, K), []
    other_from_frame = cam_from_world[rows] @ se3.inverse(cam_from_world[frame])
    others = [prepare(row) for row in rows]
    swept = sweep_prepared(reference, others, other_from_frame, K, (near, far), settings.sweep)
    return refine_depth(swept, reference, others, other_from_frame, settings.refine), rows
