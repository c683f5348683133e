"""Pictures for rooms: posters, printed pages, book spines, window views; (H, W, 3) uint8 RGB from a generator."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.simulation.textures import SIZE, blend, carpet, cloud, colour, rgb
from improvo.types import UInt8

_LETTERS = np.array(list("ABCDEFGHIJKLMNOPRSTUVWXYZabcdefghijklmnoprstuvwxyz0123456789"))
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def word(rng: np.random.Generator, least: int = 2, most: int = 9) -> str:
    """Random letters."""
    return "".join(rng.choice(_LETTERS, int(rng.integers(least, most + 1))))


def abstract(rng: np.random.Generator) -> UInt8:
    """A poster of overlapping shapes."""
    low, high = colour(rng, (0.1, 0.7), (0.2, 0.6)), colour(rng, (0.1, 0.7), (0.6, 1.0))
    image = blend(cloud(rng, 5), low, high)
    for _ in range(int(rng.integers(18, 40))):
        tone = colour(rng, (0.1, 1.0), (0.05, 1.0)).tolist()
        kind, centre, reach = rng.integers(0, 4), rng.integers(0, SIZE, 2), int(rng.integers(15, 110))
        if kind == 0:
            cv2.circle(image, centre.tolist(), reach, tone, -1, cv2.LINE_AA)
        elif kind == 1:
            corners = centre + rng.integers(-reach, reach + 1, (int(rng.integers(3, 6)), 2))
            cv2.fillPoly(image, [corners], tone, cv2.LINE_AA)
        elif kind == 2:
            end = centre + rng.integers(-2 * reach, 2 * reach + 1, 2)
            cv2.line(image, centre.tolist(), end.tolist(), tone, int(rng.integers(2, 12)), cv2.LINE_AA)
        else:
            cv2.circle(image, centre.tolist(), reach, tone, int(rng.integers(2, 10)), cv2.LINE_AA)
    return image


def landscape(rng: np.random.Generator) -> UInt8:
    """Sky, ridges of hills, trees."""
    sky_low, sky_high = colour(rng, (0.1, 0.5), (0.8, 1.0)), colour(rng, (0.3, 0.7), (0.6, 0.9))
    y = np.linspace(1, 0, SIZE, dtype=np.float32)[:, None] * np.ones((1, SIZE), np.float32)
    image = blend(np.clip(y + 0.3 * cloud(rng, 6) - 0.15, 0, 1), sky_low, sky_high)
    rows = np.arange(SIZE)[:, None]
    for ridge in range(5):
        profile = cloud(rng, 7)[0] * 130 + 180 + 62 * ridge
        tone = rgb(40, 90, 50) * rng.uniform(0.6, 1.3, 3).astype(np.float32) + (4 - ridge) * 18
        rough = blend(cloud(rng, 8, first=8), tone * 0.6, tone * 1.2)
        image = np.where((rows > profile[None, :])[..., None], rough, image)
        for _ in range(9 * (ridge > 1)):
            x = int(rng.integers(0, SIZE))
            foot, height = int(profile[x]) + 8, int(rng.integers(15, 30 + 14 * ridge))
            crown = np.array([[x - height // 4, foot], [x + height // 4, foot], [x, foot - height]])
            cv2.fillPoly(image, [crown], (tone * rng.uniform(0.3, 0.7)).tolist(), cv2.LINE_AA)
    return np.ascontiguousarray(image)


def printed_page(rng: np.random.Generator) -> UInt8:
    """A headline, columns of text-like lines and a figure."""
    paper, ink = colour(rng, (0.0, 0.15), (0.85, 1.0)), colour(rng, (0.0, 0.8), (0.05, 0.35))
    image = np.full((SIZE, SIZE, 3), paper, np.float32).astype(np.uint8)
    font = int(rng.choice(_FONTS))
    cv2.putText(image, word(rng, 4, 8), (24, 84), font, 2.6, ink.tolist(), 6, cv2.LINE_AA)
    columns = int(rng.integers(1, 3))
    width = (SIZE - 60) // columns
    for column in range(columns):
        x0 = 28 + column * (width + 8)
        for y in range(128, SIZE - 20, 22):
            line = " ".join(word(rng) for _ in range(12))[: int(width / 10.5)]
            cv2.putText(image, line, (x0, y), font, 0.52, ink.tolist(), 1, cv2.LINE_AA)
    x, y = int(rng.integers(40, 250)), int(rng.integers(150, 300))
    figure = cv2.resize(abstract(rng), (190, 150), interpolation=cv2.INTER_AREA)
    image[y : y + 150, x : x + 190] = figure
    return image


def mosaic(rng: np.random.Generator) -> UInt8:
    """A poster of random coloured cells."""
    from scipy.spatial import cKDTree

    seeds = rng.uniform(0, SIZE, (90, 2)).astype(np.float32)
    y, x = np.mgrid[:SIZE:2, :SIZE:2].astype(np.float32)
    _, cells = cKDTree(seeds).query(np.stack([x.ravel(), y.ravel()], axis=1))
    nearest = cv2.resize(cells.reshape(x.shape).astype(np.uint8), (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
    palette = np.array([colour(rng, (0.1, 0.9), (0.2, 1.0)) for _ in seeds])
    edges = cv2.morphologyEx(nearest, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    image = palette[nearest].astype(np.uint8)
    image[edges] = 20
    return image


def poster(rng: np.random.Generator) -> UInt8:
    """One of the kinds above, in a frame with a margin."""
    picture = (abstract, landscape, printed_page, mosaic, abstract)[rng.integers(0, 5)](rng)
    margin = int(rng.integers(8, 40))
    image = cv2.copyMakeBorder(picture, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(245, 242, 235))
    image = cv2.copyMakeBorder(
        image, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=colour(rng, (0, 0.5), (0.05, 0.5)).tolist()
    )
    return cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)


def book_spines(rng: np.random.Generator) -> UInt8:
    """A row of books seen from the back, each with bands and a title."""
    image = np.full((SIZE, SIZE, 3), 18, np.uint8)
    x = 0
    while x < SIZE:
        width, top = int(rng.integers(24, 62)), int(rng.integers(0, 110))
        tone = colour(rng, (0.15, 0.95), (0.2, 0.9))
        ink = colour(rng, (0.0, 0.3), (0.85, 1.0)) if tone.mean() < 120 else colour(rng, (0.0, 0.6), (0.05, 0.25))
        cv2.rectangle(image, (x, top), (x + width - 3, SIZE), tone.tolist(), -1)
        title = np.zeros((width, SIZE, 3), np.uint8) + tone.astype(np.uint8)
        scale = width / 46
        cv2.putText(
            title,
            f"{word(rng, 5, 9)} {word(rng)}",
            (40, int(width * 0.66)),
            int(rng.choice(_FONTS)),
            scale,
            ink.tolist(),
            2,
            cv2.LINE_AA,
        )
        upright = cv2.rotate(title, cv2.ROTATE_90_CLOCKWISE)[: SIZE - top, 2 : min(width - 5, SIZE - x)]
        image[top:, x + 2 : x + 2 + upright.shape[1]] = upright
        for band in rng.integers(top + 10, SIZE - 10, 2):
            cv2.line(image, (x, int(band)), (x + width - 4, int(band)), ink.tolist(), 4)
        x += width
    return image


def package(rng: np.random.Generator) -> UInt8:
    """The printed side of a box."""
    image = abstract(rng) if rng.uniform() < 0.5 else mosaic(rng)
    band = colour(rng, (0.0, 0.9), (0.7, 1.0))
    top = int(rng.integers(60, 300))
    cv2.rectangle(image, (0, top), (SIZE, top + 120), band.tolist(), -1)
    cv2.putText(image, word(rng, 4, 7), (30, top + 90), cv2.FONT_HERSHEY_DUPLEX, 3.0, (25, 25, 30), 8, cv2.LINE_AA)
    return image


def label(rng: np.random.Generator) -> UInt8:
    """What is wrapped around bottles, cups and vases."""
    return package(rng) if rng.uniform() < 0.6 else carpet(rng)


def window_view(rng: np.random.Generator) -> UInt8:
    """Bright houses and sky behind a glass pane."""
    image = landscape(rng).astype(np.float32)
    for _ in range(7):
        x, width, top = rng.integers(0, SIZE - 40), rng.integers(50, 130), rng.integers(180, 380)
        image[top:, x : x + width] = colour(rng, (0.05, 0.4), (0.5, 0.9))
        for wy in range(int(top) + 14, SIZE - 14, 34):
            for wx in range(int(x) + 10, int(x + width) - 14, 26):
                image[wy : wy + 18, wx : wx + 13] = rng.uniform(40, 130)
    return np.clip(image * 0.6 + 105, 0, 255).astype(np.uint8)


def shirt(rng: np.random.Generator) -> UInt8:
    """Clothes of the people: a print on cloth."""
    image = cv2.addWeighted(abstract(rng), 0.7, carpet(rng), 0.3, 0)
    return np.asarray(image, np.uint8)
