"""Pieces of furniture and what stands on them, in a frame with x along the wall, y into the room, z up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from improvo.simulation.builder import Node, SceneBuilder
from improvo.simulation.palette import Palette, pick


@dataclass(frozen=True)
class Workshop:
    """What every maker of furniture needs."""

    builder: SceneBuilder
    palette: Palette
    drawer: Callable[[float], float] | None = None  # how far a drawer is open over time


Maker = Callable[[Workshop, Node, float], None]  # workshop, body on the floor at the wall, width


def bookshelf(shop: Workshop, node: Node, width: float) -> None:
    """Sides, boards, rows of books and things between them."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    wood, height, depth = palette.wood(), pick(rng, (1.5, 2.1)), 0.3
    for side in (-1, 1):
        builder.box(node, (0.025, depth, height), (side * (width / 2 - 0.0125), depth / 2, height / 2), wood)
    builder.box(node, (width, 0.01, height), (0, 0.005, height / 2), wood)
    boards = int(rng.integers(4, 6))
    gap = (height - 0.03) / boards
    for row in range(boards + 1):
        z = 0.015 + row * gap
        builder.box(node, (width, depth, 0.025), (0, depth / 2, z), wood)
        if row == boards:
            break
        if rng.uniform() < 0.75:
            length, tall = (width - 0.06) * pick(rng, (0.5, 1.0)), gap * pick(rng, (0.6, 0.85))
            x = -(width - 0.06 - length) / 2 * float(rng.choice([-1, 1]))
            builder.box(node, (length, 0.2, tall), (x, depth / 2 - 0.02, z + 0.0125 + tall / 2), palette.books())
        else:
            for x in np.arange(-width / 2 + 0.15, width / 2 - 0.1, 0.22):
                thing(shop, node, (float(x), depth / 2, z + 0.0125), most=gap * 0.75)


def desk(shop: Workshop, node: Node, width: float) -> None:
    """Table with a screen, papers, a mug, and a chair."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    height, depth = 0.74, 0.6
    table(shop, node, (width, depth), height, (0.0, depth / 2))
    screen = builder.body(node, (pick(rng, (-0.15, 0.15)) * width, 0.16, height), pick(rng, (-0.2, 0.2)))
    builder.box(screen, (0.24, 0.16, 0.015), (0, 0, 0.0075), palette.dark)
    builder.cylinder(screen, (0, 0, 0), (0, 0, 0.16), 0.02, palette.dark)
    builder.box(screen, (0.56, 0.03, 0.34), (0, 0, 0.32), palette.dark)
    builder.box(screen, (0.53, 0.004, 0.31), (0, 0.016, 0.32), palette.screen())
    builder.box(node, (0.42, 0.14, 0.02), (0, 0.42, height + 0.01), palette.dark)
    for x in (-0.38, 0.36):
        thing(shop, node, (x * width, pick(rng, (0.2, 0.45)), height))
    builder.box(node, (0.21, 0.297, 0.004), (0.2 * width, 0.4, height + 0.002), palette.page(), pick(rng, (-0.6, 0.6)))
    chair(shop, builder.body(node, (pick(rng, (-0.2, 0.2)), depth + 0.05, 0), pick(rng, (-0.5, 0.5))))


def sofa(shop: Workshop, node: Node, width: float) -> None:
    """Seat, back, arms, cushions."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    cloth = palette.cloth()
    builder.box(node, (width, 0.8, 0.38), (0, 0.42, 0.2), cloth)
    builder.box(node, (width, 0.2, 0.8), (0, 0.11, 0.4), cloth)
    for side in (-1, 1):
        builder.box(node, (0.16, 0.8, 0.58), (side * (width / 2 - 0.08), 0.42, 0.29), cloth)
    for x in np.arange(-width / 2 + 0.4, width / 2 - 0.2, pick(rng, (0.45, 0.8))):
        cushion = builder.body(node, (float(x), 0.3, 0.56), pick(rng, (-0.2, 0.2)))
        builder.ellipsoid(cushion, (0.2, 0.07, 0.17), (0, 0, 0), palette.shirt())
        builder.box(cushion, (0.34, 0.09, 0.3), (0, 0, 0), palette.cloth(), step=0.1)


def cabinet(shop: Workshop, node: Node, width: float) -> None:
    """Drawers with handles and things on top; one drawer may move."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    material, front, height, depth = palette.surface(), palette.surface(), pick(rng, (0.75, 1.1)), 0.42
    builder.box(node, (width, depth, height), (0, depth / 2, height / 2), material)
    rows = 3
    moving = int(rng.integers(0, 2)) + 1 if shop.drawer else -1
    for row in range(rows):
        for column in (-0.25, 0.25):
            face = builder.body(node, (column * width, depth, (row + 0.5) * height / rows), moving=False)
            if row == moving and column > 0 and shop.drawer:
                face = builder.body(node, (column * width, depth, (row + 0.5) * height / rows), moving=True)
                builder.joint(face, "slide", (0, 1, 0), shop.drawer)
                builder.box(face, (width * 0.44, 0.34, height / rows * 0.6), (0, -0.16, 0), palette.wood())
            builder.box(face, (width * 0.48, 0.02, height / rows * 0.92), (0, 0.01, 0), front)
            builder.capsule(face, (-0.05, 0.04, 0), (0.05, 0.04, 0), 0.009, palette.metal)
    for x in np.arange(-width / 2 + 0.12, width / 2 - 0.05, 0.24):
        thing(shop, node, (float(x), depth / 2 + pick(rng, (-0.06, 0.06)), height))


def plant(shop: Workshop, node: Node, width: float) -> None:
    """A pot with leaves."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    builder.lathe(
        node, [(0.0, 0.0), (0.12, 0.0), (0.17, 0.32), (0.15, 0.32), (0.0, 0.28)], (0, 0.25, 0), palette.label()
    )
    stem = pick(rng, (0.6, 1.1))
    builder.capsule(node, (0, 0.25, 0.25), (0.03, 0.25, stem), 0.015, palette.wood())
    greens = [(pick(rng, (0.1, 0.3)), pick(rng, (0.35, 0.6)), 0.15) for _ in range(3)]
    leaves = [builder.material(None, colour=green, shine=0.4) for green in greens]
    for index in range(26):
        angle, reach, z = pick(rng, (0, 2 * np.pi)), pick(rng, (0.06, 0.24)), pick(rng, (0.5, 1.0)) * (stem + 0.25)
        at = (reach * float(np.cos(angle)), 0.27 + reach * float(np.sin(angle)), z)
        leaf = builder.body(node, at, angle, pick(rng, (-0.9, 0.7)))
        builder.ellipsoid(leaf, (0.13, 0.045, 0.006), (0, 0, 0), leaves[index % 3])


def boxes(shop: Workshop, node: Node, width: float) -> None:
    """A stack of packages."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    z, size = 0.0, min(width, 0.55)
    for _ in range(int(rng.integers(2, 4))):
        height = pick(rng, (0.22, 0.4))
        at = (pick(rng, (-0.04, 0.04)), 0.3 + pick(rng, (-0.02, 0.04)), z + height / 2)
        builder.box(node, (size, size * 0.8, height), at, palette.package(), pick(rng, (-0.25, 0.25)))
        z, size = z + height, size * pick(rng, (0.7, 0.95))


def table(shop: Workshop, node: Node, size: tuple[float, float], height: float, centre: tuple[float, float]) -> None:
    """A board on four legs."""
    builder, palette = shop.builder, shop.palette
    wood, (x, y) = palette.wood(), centre
    builder.box(node, (*size, 0.035), (x, y, height - 0.0175), palette.surface(0.8), step=0.08)
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            leg = (x + side_x * (size[0] / 2 - 0.04), y + side_y * (size[1] / 2 - 0.04), (height - 0.035) / 2)
            builder.box(node, (0.05, 0.05, height - 0.035), leg, wood)


def chair(shop: Workshop, node: Node) -> None:
    """A chair that looks to -y."""
    builder, palette = shop.builder, shop.palette
    wood, seat = palette.wood(), palette.cloth()
    builder.box(node, (0.42, 0.42, 0.05), (0, 0, 0.45), seat)
    for x in (-0.18, 0.18):
        builder.cylinder(node, (x, -0.18, 0), (x, -0.18, 0.43), 0.018, wood)
        builder.cylinder(node, (x, 0.18, 0), (x, 0.21, 0.92), 0.018, wood)
    for z in (0.62, 0.74, 0.86):
        builder.box(node, (0.36, 0.02, 0.06), (0, 0.2, z), wood)


def thing(shop: Workshop, node: Node, position: tuple[float, float, float], most: float = 0.3) -> None:
    """One of the small things that lie around; `position` is the spot it stands on."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    x, y, z = position
    kind = int(rng.integers(0, 7))
    if kind == 0:
        size = (pick(rng, (0.08, 0.18)), pick(rng, (0.05, 0.14)), min(pick(rng, (0.12, 0.26)), most))
        builder.box(node, size, (x, y, z + size[2] / 2), palette.package(), pick(rng, (-0.8, 0.8)))
    elif kind == 1:
        height, radius = min(pick(rng, (0.16, 0.3)), most), pick(rng, (0.03, 0.05))
        neck = [(radius, 0), (radius, 0.55), (0.35 * radius, 0.72), (0.3 * radius, 1.0), (0.0, 1.0)]
        builder.lathe(node, [(0.0, 0.0), *((r, h * height) for r, h in neck)], position, palette.label())
    elif kind == 2:
        mug = [(0.0, 0.0), (0.038, 0.0), (0.042, 0.095), (0.036, 0.095), (0.034, 0.02), (0.0, 0.02)]
        builder.lathe(node, mug, position, palette.label())
    elif kind == 3:
        radius = min(pick(rng, (0.04, 0.09)), most / 2)
        builder.ellipsoid(node, (radius, radius, radius), (x, y, z + radius), palette.label(cube=True))
    elif kind == 4:
        tall = 0.0
        for _ in range(int(rng.integers(2, 5))):
            thick = pick(rng, (0.02, 0.04))
            if tall + thick > most:
                break
            at = (x, y, z + tall + thick / 2)
            builder.box(node, (0.2, 0.15, thick), at, palette.package(), pick(rng, (-0.5, 0.5)))
            tall += thick
    elif kind == 5:
        frame = builder.body(node, (x, y, z), pick(rng, (-0.5, 0.5)))
        height = min(0.22, most)
        builder.box(frame, (0.16, 0.015, height), (0, 0, height / 2), palette.poster())
    else:
        radii = (pick(rng, (0.04, 0.07)), pick(rng, (0.04, 0.07)), min(pick(rng, (0.06, 0.12)), most / 2))
        builder.ellipsoid(node, radii, (x, y, z + radii[2]), palette.label(cube=True))


WALL_PIECES: tuple[tuple[Maker, tuple[float, float], float], ...] = (  # maker, range of widths, depth
    (bookshelf, (0.8, 1.3), 0.32),
    (desk, (1.1, 1.5), 1.0),
    (sofa, (1.5, 2.0), 0.85),
    (cabinet, (0.8, 1.2), 0.5),
    (plant, (0.6, 0.7), 0.55),
    (boxes, (0.5, 0.65), 0.65),
)
