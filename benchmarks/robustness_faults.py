"""Faults that `benchmarks/robustness.py` injects: each takes a clip, and gives another clip with its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from improvo.types import Float64, UInt8
from robustness_clips import Clip

Fault = Callable[[Clip, np.random.Generator], Clip]


# what hides the world


def overlay(share: float) -> Fault:
    """A logo with texture at a corner, static in the picture, over this share of it."""

    def put(clip: Clip, rng: np.random.Generator) -> Clip:
        height, width = clip.images.shape[1:]
        h, w = (max(8, round(size * np.sqrt(share))) for size in (height, width))
        logo, images = texture(rng, h, w), clip.images.copy()
        top, left = rng.choice((0, height - h)), rng.choice((0, width - w))
        images[:, top : top + h, left : left + w] = logo
        return replace(clip, images=images)

    return put


def timestamp(clip: Clip, rng: np.random.Generator) -> Clip:
    """A line of text in the picture whose digits count."""
    images = clip.images.copy()
    height, width = images.shape[1:]
    row = int(rng.choice((int(0.06 * height), int(0.96 * height))))
    for number, image in enumerate(images):
        text = f"CAM 01  2026-11-27 23:{number // 60:02d}:{number % 60:02d}  LIVE"
        cv2.putText(image, text, (int(0.02 * width), row), cv2.FONT_HERSHEY_SIMPLEX, width / 640, 255, 1, cv2.LINE_AA)
    return replace(clip, images=images)


def letterbox(clip: Clip, rng: np.random.Generator) -> Clip:
    """Black bars over an eighth of the height, above and below, with text in them that stays."""
    images = clip.images.copy()
    height, width = images.shape[1:]
    bar, size = height // 8, width / 640
    images[:, :bar], images[:, -bar:] = 0, 0
    words = ("VISUAL", "odometry", "24/7", "Kitchen & hall", "#4711", "REC", "two floors", "(c) nobody", "x-ray", "ISO")
    for image in images:
        for top in (0, height - bar):
            for column in range(5):
                word = words[(column + 5 * (top > 0)) % len(words)]
                place = (int(width * (0.02 + 0.2 * column)), top + bar // 2 + 3)
                cv2.putText(image, word, place, cv2.FONT_HERSHEY_SIMPLEX, 0.9 * size, 230, 1, cv2.LINE_AA)
    return replace(clip, images=images)


def mover(clip: Clip, rng: np.random.Generator) -> Clip:
    """Something of 70 % of the width and 80 % of the height that passes through the middle half of the clip."""
    images, count = clip.images.copy(), len(clip)
    height, width = images.shape[1:]
    h, w = int(0.8 * height), int(0.7 * width)
    body, top = texture(rng, h, w), height - h - int(0.05 * height)
    direction = rng.choice((-1, 1))
    for number in range(count // 4, 3 * count // 4):
        along = (number - count / 4) / (count / 2)
        left = round(width / 2 - w / 2 + direction * (along - 0.5) * (width + w))
        first, last = max(left, 0), min(left + w, width)
        if last > first:
            images[number, top : top + h, first:last] = body[:, first - left : last - left]
    return replace(clip, images=images)


def attached(clip: Clip, rng: np.random.Generator) -> Clip:
    """Half of the picture shows something that moves with the camera, and trembles by half a pixel."""
    images, margin = clip.images.copy(), 8
    height, width = images.shape[1:]
    body = texture(rng, height + 2 * margin, width + 2 * margin)
    left, right, below = np.s_[:, : width // 2], np.s_[:, width // 2 :], np.s_[height // 2 :, :]
    region = (left, right, below)[int(rng.integers(3))]
    for image in images:
        shift = np.column_stack([np.eye(2), rng.normal(0, 0.5, 2) - margin])
        image[region] = cv2.warpAffine(body, shift, (width, height))[region]
    return replace(clip, images=images)


def black(clip: Clip, rng: np.random.Generator) -> Clip:
    """Five black pictures."""
    return _spoilt(clip, 5, lambda images: np.zeros_like(images))


def covered(clip: Clip, rng: np.random.Generator) -> Clip:
    """A hand before the lens for ten pictures."""
    return _spoilt(clip, 10, lambda images: np.full_like(images, 31))


def noise_only(clip: Clip, rng: np.random.Generator) -> Clip:
    """Twenty pictures of noise and nothing else."""
    return _spoilt(clip, 20, lambda images: rng.integers(0, 256, images.shape, np.uint8))


# what the light and the sensor do


def flash(clip: Clip, rng: np.random.Generator) -> Clip:
    """Every tenth picture is far too bright."""
    images = clip.images.copy()
    images[9::10] = np.minimum(images[9::10] * 2.5 + 60.0, 255).astype(np.uint8)
    return replace(clip, images=images)


def exposure(clip: Clip, rng: np.random.Generator) -> Clip:
    """In the middle the exposure halves at once."""
    images = clip.images.copy()
    images[len(clip) // 2 :] = images[len(clip) // 2 :] // 2
    return replace(clip, images=images)


def flicker(clip: Clip, rng: np.random.Generator) -> Clip:
    """Every second picture is a third darker."""
    images = clip.images.copy()
    images[1::2] = (images[1::2] * 0.67).astype(np.uint8)
    return replace(clip, images=images)


def noise(clip: Clip, rng: np.random.Generator) -> Clip:
    """Noise with a standard deviation of 40 grey levels."""
    noisy = clip.images + 40.0 * rng.standard_normal(clip.images.shape, np.float32)
    return replace(clip, images=np.clip(noisy, 0, 255).astype(np.uint8))


def salt_and_pepper(clip: Clip, rng: np.random.Generator) -> Clip:
    """A fifth of all pixels black or white."""
    drawn, images = rng.random(clip.images.shape, np.float32), clip.images.copy()
    images[drawn < 0.1], images[drawn > 0.9] = 0, 255
    return replace(clip, images=images)


def jpeg(clip: Clip, rng: np.random.Generator) -> Clip:
    """JPEG of quality 5."""
    parts = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 5])[1] for image in clip.images]
    return replace(clip, images=np.stack([cv2.imdecode(part, cv2.IMREAD_GRAYSCALE) for part in parts]))


def rolling_shutter(clip: Clip, rng: np.random.Generator) -> Clip:
    """The rows are read out over the whole time between two pictures, by the optical flow between them."""
    images = clip.images.copy()
    height, width = images.shape[1:]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    delay = (y / (height - 1) - 0.5)[..., None]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    for number in range(len(clip) - 1):
        moved = flow.calc(clip.images[number], clip.images[number + 1], None) * delay
        images[number] = cv2.remap(
            clip.images[number], x - moved[..., 0], y - moved[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return replace(clip, images=images)


# what the camera, or the player, does


def mirrored(clip: Clip, rng: np.random.Generator) -> Clip:
    """Ten pictures in the middle are mirrored left to right; no pose is right for them."""
    return _spoilt(clip, 10, lambda images: images[:, :, ::-1])


def zoom(clip: Clip, rng: np.random.Generator) -> Clip:
    """From the middle on the picture is enlarged 1.5 times, and the camera does not say so."""
    return replace(clip, images=_about_centre(clip, 1.5))


def turned(clip: Clip, rng: np.random.Generator) -> Clip:
    """From the middle on the camera is upside down: turned by 180 degrees about its optical axis at once."""
    poses = clip.world_from_cam.copy()
    poses[len(clip) // 2 :] = poses[len(clip) // 2 :] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(clip, images=_about_centre(clip, -1.0), world_from_cam=poses)


def dropped(clip: Clip, rng: np.random.Generator) -> Clip:
    """One picture in five is missing, and six in a row in the middle."""
    middle = len(clip) // 2
    kept = (rng.random(len(clip)) > 0.2) & ~((np.arange(len(clip)) >= middle) & (np.arange(len(clip)) < middle + 6))
    rows = np.flatnonzero(kept)
    return replace(clip.take(rows), times=clip.times[rows])


def duplicated(clip: Clip, rng: np.random.Generator) -> Clip:
    """One picture in five comes twice."""
    rows = np.arange(len(clip))
    return clip.take(np.where(rng.random(len(clip)) < 0.2, np.maximum(rows - 1, 0), rows))


def reordered(clip: Clip, rng: np.random.Generator) -> Clip:
    """One pair of neighbours in ten has changed places."""
    rows = np.arange(len(clip))
    for first in range(4, len(clip) - 1, 10):
        rows[[first, first + 1]] = rows[[first + 1, first]]
    return clip.take(rows)


def frozen(clip: Clip, rng: np.random.Generator) -> Clip:
    """In the middle one picture is shown fifteen times, then the stream is where it would have been."""
    rows = np.arange(len(clip))
    middle = len(clip) // 2
    rows[middle : middle + 15] = middle
    return clip.take(rows)


def scene_cut(clip: Clip, rng: np.random.Generator) -> Clip:
    """In the middle the stream jumps to its end and goes backwards from there: another place at once."""
    middle = len(clip) // 2
    return clip.take(np.concatenate([np.arange(middle), np.arange(len(clip) - 1, middle - 1, -1)]))


FAULTS: dict[str, Fault] = {
    "none": lambda clip, rng: clip,
    **{f"overlay-{percent}": overlay(percent / 100) for percent in (5, 10, 15, 25, 40)},
    "timestamp": timestamp,
    "letterbox": letterbox,
    "mover-70": mover,
    "attached-half": attached,
    "mirrored": mirrored,
    "noise-40": noise,
    "salt-pepper-20": salt_and_pepper,
    "jpeg-5": jpeg,
    "rolling-shutter": rolling_shutter,
    "zoom": zoom,
    "turned-180": turned,
    "black": black,
    "covered": covered,
    "noise-only": noise_only,
    "flash": flash,
    "exposure": exposure,
    "flicker": flicker,
    "dropped": dropped,
    "duplicated": duplicated,
    "reordered": reordered,
    "frozen": frozen,
    "scene-cut": scene_cut,
}


def texture(rng: np.random.Generator, height: int, width: int) -> UInt8:
    """A printed surface (height, width): shapes of different grey at all sizes."""
    picture = np.full((height, width), int(rng.integers(60, 200)), np.uint8)
    for size in np.geomspace(0.5 * max(height, width), 5, 9):
        for _ in range(int(np.clip(height * width / size**2, 1, 120))):
            centre = tuple(int(each) for each in rng.integers(0, (width, height)))
            grey, half = int(rng.integers(0, 256)), max(2, int(0.5 * size * rng.uniform(0.5, 1.0)))
            corners = np.array(centre) + half * rng.uniform(-1, 1, (int(rng.integers(3, 6)), 2))
            if rng.random() < 0.3:
                cv2.circle(picture, centre, half, grey, -1, cv2.LINE_AA)
            else:
                cv2.fillPoly(picture, [np.rint(corners).astype(np.int32)], grey, cv2.LINE_AA)
    return picture


def _spoilt(clip: Clip, count: int, spoil: Callable[[UInt8], UInt8]) -> Clip:
    """Pictures in the middle that show nothing of the world."""
    rows = slice(len(clip) // 2, len(clip) // 2 + count)
    images, trackable = clip.images.copy(), clip.trackable.copy()
    images[rows], trackable[rows] = spoil(images[rows]), False
    return replace(clip, images=images, trackable=trackable)


def _about_centre(clip: Clip, scale: float) -> UInt8:
    """From the middle on the picture is scaled about the principal point; -1 turns it by 180 degrees."""
    images, camera = clip.images.copy(), clip.camera
    centre: Float64 = np.array([camera.cx, camera.cy])
    matrix = np.column_stack([scale * np.eye(2), centre - scale * centre])
    for number in range(len(clip) // 2, len(clip)):
        images[number] = cv2.warpAffine(
            clip.images[number], matrix, (camera.width, camera.height), borderMode=cv2.BORDER_REPLICATE
        )
    return images
