"""Procedural textures: every picture in a room is drawn from a random generator, as (H, W, 3) uint8 RGB."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from improvo.types import Float32, UInt8

Texture = Callable[[np.random.Generator], UInt8]
SIZE = 512


def colour(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> Float32:
    """A random RGB colour (3,) in 0..255."""
    red, green, blue = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))
    return rgb(255 * red, 255 * green, 255 * blue)


def rgb(red: float, green: float, blue: float) -> Float32:
    """A colour (3,) in 0..255."""
    return np.array([red, green, blue], np.float32)


def cloud(rng: np.random.Generator, octaves: int = 6, size: int = SIZE, first: int = 2, aspect: int = 1) -> Float32:
    """Tileable value noise (size, size) in 0..1; `aspect` stretches it along x."""
    total = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        cells = first * 2**octave
        if cells * aspect > size:
            break
        grid = rng.uniform(-1, 1, (cells * aspect, cells)).astype(np.float32)
        total += 0.55**octave * (_periodic_cubic(cells * aspect, size) @ grid @ _periodic_cubic(cells, size).T)
    total -= total.min()
    return np.asarray(total / max(float(total.max()), 1e-6), np.float32)


@cache
def _periodic_cubic(cells: int, size: int) -> Float32:
    """Weights (size, cells) of Catmull-Rom interpolation of a periodic signal."""
    place = np.arange(size) * cells / size
    whole = np.floor(place).astype(int)
    t = place - whole
    weights = np.zeros((size, cells), np.float32)
    taps = (
        0.5 * (-(t**3) + 2 * t**2 - t),
        0.5 * (3 * t**3 - 5 * t**2 + 2),
        0.5 * (-3 * t**3 + 4 * t**2 + t),
        0.5 * (t**3 - t**2),
    )
    for offset, weight in zip((-1, 0, 1, 2), taps, strict=True):
        np.add.at(weights, (np.arange(size), (whole + offset) % cells), weight)
    return weights


def blend(amount: Float32, low: Float32, high: Float32) -> UInt8:
    """Colour (H, W, 3) between two colours, by an amount (H, W) in 0..1."""
    mixed = low + (high - low) * amount[..., None]
    return np.clip(mixed, 0, 255).astype(np.uint8)


def shade(image: UInt8, amount: Float32) -> UInt8:
    """The image times an amount (H, W)."""
    return np.clip(image * amount[..., None], 0, 255).astype(np.uint8)


def plain(rng: np.random.Generator) -> UInt8:
    """One colour, with hardly visible unevenness."""
    base = colour(rng, (0.02, 0.35), (0.6, 0.95))
    return blend(cloud(rng, 3), base * 0.985, base * 1.015)


def plaster(rng: np.random.Generator) -> UInt8:
    """Rough painted wall with stains and scratches."""
    base = colour(rng, (0.05, 0.3), (0.65, 0.9))
    amount = 0.5 * cloud(rng, 8, first=4) + 0.5 * cloud(rng, 3)
    image = blend(amount, base * 0.8, base * 1.08)
    for _ in range(25):
        start = rng.integers(0, SIZE, 2)
        end = start + rng.integers(-40, 40, 2)
        cv2.line(image, start.tolist(), end.tolist(), (base * rng.uniform(0.6, 1.1)).tolist(), 1, cv2.LINE_AA)
    return image


def wood(rng: np.random.Generator) -> UInt8:
    """Grain along x with knots."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32) / SIZE
    bend = cloud(rng, 3) * 0.14 + 0.04 * cloud(rng, 5, first=4)
    for _ in range(rng.integers(1, 4)):
        centre = rng.uniform(0.1, 0.9, 2)
        distance = np.hypot((x - centre[0]) * 0.5, y - centre[1])
        bend += 0.12 * np.exp(-((distance / 0.05) ** 2)).astype(np.float32)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * rng.uniform(7, 13) * (y + bend))
    fine = cloud(rng, 6, first=4, aspect=8)
    hue = rgb(rng.uniform(110, 190), rng.uniform(70, 120), rng.uniform(30, 75))
    return blend((0.4 * rings + 0.6 * fine).astype(np.float32), hue * 0.72, hue * 1.25)


def planks(rng: np.random.Generator) -> UInt8:
    """A wooden floor: boards of different wood, staggered."""
    source = np.concatenate([wood(rng), wood(rng)], axis=1)
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    height = SIZE // 8
    for row in range(8):
        x = -int(rng.integers(0, 170))
        while x < SIZE:
            length = int(rng.integers(180, 330))
            y0, x0 = rng.integers(0, SIZE - height), rng.integers(0, 2 * SIZE - length)
            board = source[y0 : y0 + height, x0 : x0 + length] * rng.uniform(0.75, 1.15)
            left, right = max(x, 0), min(x + length, SIZE)
            image[row * height : (row + 1) * height, left:right] = np.clip(board[:, left - x : right - x], 0, 255)
            cv2.line(image, (x, row * height), (x, (row + 1) * height), (40, 25, 15), 2)
            x += length
        cv2.line(image, (0, row * height), (SIZE, row * height), (40, 25, 15), 2)
    return image


def bricks(rng: np.random.Generator) -> UInt8:
    """A brick wall; every brick has its own shade."""
    mortar = blend(cloud(rng, 7, first=4), rgb(150, 145, 138), rgb(190, 185, 178))
    base = rgb(rng.uniform(120, 190), rng.uniform(60, 100), rng.uniform(45, 80))
    rough = cloud(rng, 8, first=8)
    image = mortar
    for row in range(8):
        for column in range(-1, 5):
            x, y = column * 128 + (row % 2) * 64 + 3, row * 64 + 3
            inside = (slice(y, y + 58), slice(max(x, 0), max(min(x + 122, SIZE), 0)))
            image[inside] = blend(rough[inside], base * rng.uniform(0.6, 0.95), base * rng.uniform(0.95, 1.25))
    return image


def wallpaper(rng: np.random.Generator) -> UInt8:
    """A printed motif, repeated exactly."""
    ground, ink = colour(rng, (0.05, 0.3), (0.75, 0.95)), colour(rng, (0.2, 0.7), (0.35, 0.7))
    tile = np.full((64, 64, 3), ground, np.float32).astype(np.uint8)
    kind = rng.integers(0, 3)
    if kind == 0:
        for angle in np.arange(6) * 60 + rng.uniform(0, 60):
            cv2.ellipse(tile, (32, 32), (20, 6), angle, 0, 360, ink.tolist(), -1, cv2.LINE_AA)
        cv2.circle(tile, (32, 32), 6, ground.tolist(), -1, cv2.LINE_AA)
    elif kind == 1:
        cv2.rectangle(tile, (10, 0), (22, 63), ink.tolist(), -1)
        cv2.rectangle(tile, (40, 0), (44, 63), (ink * 0.7).tolist(), -1)
    else:
        points = np.array([[32, 6], [56, 32], [32, 58], [8, 32]])
        cv2.polylines(tile, [points], True, ink.tolist(), 4, cv2.LINE_AA)
        cv2.circle(tile, (32, 32), 8, ink.tolist(), -1, cv2.LINE_AA)
    return np.tile(tile, (8, 8, 1))


def tiles(rng: np.random.Generator) -> UInt8:
    """Bathroom tiles: all alike."""
    base = colour(rng, (0.02, 0.35), (0.65, 0.9))
    tile = np.full((64, 64, 3), base * 0.55, np.float32)
    tile[3:61, 3:61] = base
    tile[3:61, 3:6] = base * 1.06
    return np.tile(np.clip(tile, 0, 255).astype(np.uint8), (8, 8, 1))


def checker(rng: np.random.Generator) -> UInt8:
    """Two colours in squares."""
    one, two = colour(rng, (0.0, 0.5), (0.15, 0.4)), colour(rng, (0.0, 0.4), (0.75, 0.95))
    squares = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((64, 64))).astype(np.float32)
    return blend(squares, one, two)


def fabric(rng: np.random.Generator) -> UInt8:
    """Woven cloth with irregular threads and creases."""
    base = colour(rng, (0.15, 0.7), (0.35, 0.8))
    threads = rng.uniform(0.85, 1.1, (SIZE // 4, 1)) * rng.uniform(0.85, 1.1, (1, SIZE // 4))
    weave = cv2.resize(threads.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    image = np.full((SIZE, SIZE, 3), base, np.float32) * weave[..., None] * (0.7 + 0.5 * cloud(rng, 5))[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def tartan(rng: np.random.Generator) -> UInt8:
    """Crossing stripes, repeated four times."""
    base = colour(rng, (0.3, 0.8), (0.3, 0.7))
    period = np.tile(base, (128, 1))
    for _ in range(4):
        start, width = rng.integers(0, 110), rng.integers(4, 18)
        period[start : start + width] = colour(rng, (0.2, 0.8), (0.3, 0.95))
    cloth = 0.5 * (period[None, :, :] + period[:, None, :])
    return np.tile(np.clip(cloth, 0, 255).astype(np.uint8), (4, 4, 1))


def carpet(rng: np.random.Generator) -> UInt8:
    """A rug: border, medallions and speckled pile, nothing twice."""
    base, ink = colour(rng, (0.3, 0.7), (0.3, 0.6)), colour(rng, (0.2, 0.6), (0.6, 0.95))
    image = np.full((SIZE, SIZE, 3), base, np.float32).astype(np.uint8)
    for inset, width in ((12, 8), (34, 3), (48, 14)):
        line = ink * rng.uniform(0.5, 1.0)
        cv2.rectangle(image, (inset, inset), (SIZE - inset, SIZE - inset), line.tolist(), width)
    for _ in range(60):
        centre, axes = rng.integers(80, SIZE - 80, 2), rng.integers(6, 46, 2)
        tone = colour(rng, (0.2, 0.8), (0.25, 0.95))
        cv2.ellipse(
            image,
            centre.tolist(),
            axes.tolist(),
            rng.uniform(0, 180),
            0,
            360,
            tone.tolist(),
            int(rng.choice([-1, 3])),
            cv2.LINE_AA,
        )
    return shade(image, 0.75 + 0.5 * rng.uniform(size=(SIZE, SIZE)).astype(np.float32))


def marble(rng: np.random.Generator) -> UInt8:
    """Veins of noise."""
    veins = np.abs(cloud(rng, 7, first=2) - 0.5) * 2
    base = colour(rng, (0.02, 0.2), (0.75, 0.95))
    return blend(np.clip(veins * 2.2, 0, 1) * 0.8 + 0.2 * cloud(rng, 8, first=8), base * 0.35, base * 1.03)


def stone(rng: np.random.Generator) -> UInt8:
    """Speckled terrazzo."""
    base = colour(rng, (0.03, 0.25), (0.5, 0.8))
    image = blend(cloud(rng, 7, first=8), base * 0.85, base * 1.1)
    for _ in range(700):
        centre, axes = rng.integers(0, SIZE, 2), rng.integers(2, 9, 2)
        tone = base * rng.uniform(0.4, 1.4)
        cv2.ellipse(image, centre.tolist(), axes.tolist(), rng.uniform(0, 180), 0, 360, tone.tolist(), -1, cv2.LINE_AA)
    return image


PLAIN: tuple[Texture, ...] = (plain,)
REPEATED_WALL: tuple[Texture, ...] = (wallpaper, tiles)
REPEATED: tuple[Texture, ...] = (checker, tartan, tiles, wallpaper)
RICH_WALL: tuple[Texture, ...] = (plaster, bricks, plaster, stone)
RICH: tuple[Texture, ...] = (wood, wood, marble, fabric, stone, carpet)
