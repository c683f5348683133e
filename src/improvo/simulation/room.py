"""A furnished room: shell, windows, door, furniture along the walls, a table, posters, rugs, lamps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from improvo.simulation.builder import Node
from improvo.simulation.furniture import WALL_PIECES, Maker, Workshop, bookshelf, chair, plant, table, thing
from improvo.simulation.palette import pick
from improvo.simulation.settings import SimulationSettings

Rectangle = tuple[float, float, float, float]  # x and y from, x and y to


@dataclass
class Floor:
    """Where one can walk: the room centred on the origin, and what stands in the way."""

    width: float
    length: float
    obstacles: list[Rectangle] = field(default_factory=list)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance (...) of floor points (..., 2) from walls and furniture; negative inside."""
        half = np.array([self.width, self.length]) / 2
        least = (half - np.abs(points)).min(axis=-1)
        for x0, y0, x1, y1 in self.obstacles:
            x = np.maximum(x0 - points[..., 0], points[..., 0] - x1)
            y = np.maximum(y0 - points[..., 1], points[..., 1] - y1)
            outside = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
            least = np.minimum(least, outside + np.minimum(np.maximum(x, y), 0))
        return np.asarray(least)


@dataclass(frozen=True)
class Wall:
    """One wall; its frame has x along the wall, y into the room."""

    node: Node
    length: float
    yaw: float
    foot: tuple[float, float]  # middle of its foot, in the world

    def to_world(self, x: float, y: float) -> np.ndarray:
        """Floor position (2,) of a point of the wall's frame."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([self.foot[0] + c * x - s * y, self.foot[1] + s * x + c * y])

    def footprint(self, x: float, width: float, depth: float) -> Rectangle:
        """The rectangle on the floor of a piece of furniture centred on x."""
        corners = np.array([self.to_world(x - width / 2, 0), self.to_world(x + width / 2, depth)])
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)


def furnish(shop: Workshop, settings: SimulationSettings) -> Floor:
    """Build the whole room into the shop's builder, and say where one can walk."""
    builder, rng = shop.builder, shop.builder.rng
    short, long = min(settings.room_size), max(settings.room_size)
    floor = Floor(pick(rng, (short, 0.5 * (short + long))), pick(rng, (0.5 * (short + long), long)))
    height = settings.room_height
    _shell(shop, floor, height)
    walls = _walls(shop, floor, height)
    taken: list[list[tuple[float, float, float]]] = [[] for _ in walls]  # from, to, height of what stands there
    order = rng.permutation(4)
    _door(shop, walls[order[0]], taken[order[0]])
    for index in order[1 : 1 + int(rng.integers(1, 3))]:
        _window(shop, walls[index], taken[index])
    _furniture(shop, settings, floor, walls, taken)
    _posters(shop, settings.posters, walls, taken)
    _middle(shop, settings, floor)
    for _ in range(int(rng.integers(1, 3))):
        size = (pick(rng, (1.2, 1.8)), pick(rng, (1.6, 2.6)), 0.012)
        at = (pick(rng, (-0.5, 0.5)), pick(rng, (-1.0, 1.0)), 0.006 + 0.004 * rng.uniform())
        builder.box(builder.world, size, at, shop.palette.rug(), pick(rng, (-0.4, 0.4)))
    return floor


def _shell(shop: Workshop, floor: Floor, height: float) -> None:
    builder = shop.builder
    builder.box(builder.world, (floor.width, floor.length, 0.1), (0, 0, -0.05), shop.palette.floor(), step=0.2)
    builder.box(builder.world, (floor.width, floor.length, 0.1), (0, 0, height + 0.05), shop.palette.white, step=0.5)


def _walls(shop: Workshop, floor: Floor, height: float) -> list[Wall]:
    builder, walls = shop.builder, []
    shared = shop.palette.wall()
    for side in range(4):
        yaw = side * np.pi / 2
        length, distance = (floor.width, floor.length) if side % 2 == 0 else (floor.length, floor.width)
        foot = (float(np.sin(yaw) * distance / 2), float(-np.cos(yaw) * distance / 2))
        node = builder.body(builder.world, (*foot, 0.0), yaw)
        material = shared if builder.rng.uniform() < 0.5 else shop.palette.wall()
        builder.box(node, (length, 0.1, height), (0, -0.05, height / 2), material, step=0.2)
        builder.box(node, (length, 0.016, 0.09), (0, 0.008, 0.045), shop.palette.white)
        builder.box(node, (length, 0.03, 0.06), (0, 0.015, height - 0.03), shop.palette.white)
        walls.append(Wall(node, length, yaw, foot))
    return walls


def _door(shop: Workshop, wall: Wall, taken: list[tuple[float, float, float]]) -> None:
    builder, palette = shop.builder, shop.palette
    x = pick(builder.rng, (-0.3, 0.3)) * wall.length
    builder.box(wall.node, (0.88, 0.04, 2.02), (x, 0.02, 1.01), palette.wood())
    for side in (-0.48, 0.48):
        builder.box(wall.node, (0.08, 0.06, 2.1), (x + side, 0.03, 1.05), palette.white)
    builder.box(wall.node, (1.04, 0.06, 0.08), (x, 0.03, 2.06), palette.white)
    for z in (0.55, 1.45):
        builder.box(wall.node, (0.62, 0.012, 0.7), (x, 0.044, z), palette.wood())
    builder.capsule(wall.node, (x + 0.3, 0.09, 1.02), (x + 0.4, 0.09, 1.02), 0.012, palette.metal)
    taken.append((x - 0.6, x + 0.6, 2.2))


def _window(shop: Workshop, wall: Wall, taken: list[tuple[float, float, float]]) -> None:
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    width, height, z = pick(rng, (0.9, 1.6)), pick(rng, (1.0, 1.3)), 1.55
    for _ in range(20):
        x = pick(rng, (-0.5, 0.5)) * (wall.length - width - 0.4)
        if all(x + width / 2 < a or x - width / 2 > b for a, b, _ in taken):
            break
    else:
        return
    builder.box(wall.node, (width, 0.02, height), (x, 0.01, z), palette.window())
    for dx in (-0.5, 0.0, 0.5):
        builder.box(wall.node, (0.06, 0.06, height + 0.06), (x + dx * width, 0.03, z), palette.white)
    for dz in (-0.5, 0.5):
        builder.box(wall.node, (width + 0.06, 0.06, 0.06), (x, 0.03, z + dz * height), palette.white)
    builder.box(wall.node, (width + 0.2, 0.18, 0.03), (x, 0.09, z - height / 2 - 0.05), palette.white)
    for side in (-1, 1):
        curtain = (x + side * (width / 2 + 0.16), 0.06, z - 0.05)
        builder.box(wall.node, (0.26, 0.05, height + 0.5), curtain, palette.cloth())
    # kept free for tall furniture; low pieces may stand below
    taken.append((x - width / 2 - 0.3, x + width / 2 + 0.3, -(z - height / 2)))


def _furniture(
    shop: Workshop,
    settings: SimulationSettings,
    floor: Floor,
    walls: list[Wall],
    taken: list[list[tuple[float, float, float]]],
) -> None:
    rng = shop.builder.rng
    tall = {bookshelf, plant}
    pieces = [WALL_PIECES[0], WALL_PIECES[1], WALL_PIECES[3]]
    pieces += [WALL_PIECES[int(rng.integers(0, len(WALL_PIECES)))] for _ in range(max(0, settings.furniture - 3))]
    for index, (maker, widths, depth) in enumerate(pieces[: settings.furniture]):
        width = pick(rng, widths)
        for attempt in range(40):
            number = (index + attempt) % 4 if attempt < 4 else int(rng.integers(0, 4))
            wall = walls[number]
            x = pick(rng, (-0.5, 0.5)) * (wall.length - width - 0.1)
            place = wall.footprint(x, width, depth)
            free = all(
                x + width / 2 + 0.05 < a or x - width / 2 - 0.05 > b or (h < 0 and maker not in tall)
                for a, b, h in taken[number]
            )
            if free and not any(_overlap(place, other, 0.05) for other in floor.obstacles):
                _place(shop, maker, wall, x, width)
                floor.obstacles.append(place)
                taken[number].append((x - width / 2, x + width / 2, 1.3 if maker not in tall else 2.1))
                break


def _place(shop: Workshop, maker: Maker, wall: Wall, x: float, width: float) -> None:
    maker(shop, shop.builder.body(wall.node, (x, 0.03, 0.0)), width)


def _posters(shop: Workshop, count: int, walls: list[Wall], taken: list[list[tuple[float, float, float]]]) -> None:
    builder, rng = shop.builder, shop.builder.rng
    for number in range(count):
        wall, occupied = walls[number % 4], taken[number % 4]
        for _ in range(30):
            width, height = pick(rng, (0.35, 0.85)), pick(rng, (0.4, 0.9))
            x, z = pick(rng, (-0.5, 0.5)) * (wall.length - width - 0.2), pick(rng, (1.45, 1.75))
            low = z - height / 2
            if all(x + width / 2 + 0.04 < a or x - width / 2 - 0.04 > b or 0 < h < low for a, b, h in occupied):
                builder.box(wall.node, (width, 0.025, height), (x, 0.0125, z), shop.palette.poster(), step=0.1)
                occupied.append((x - width / 2, x + width / 2, 3.0))
                break


def _middle(shop: Workshop, settings: SimulationSettings, floor: Floor) -> None:
    """A table with chairs and things, away from the walls."""
    builder, rng = shop.builder, shop.builder.rng
    size = (pick(rng, (0.6, 0.8)), pick(rng, (0.9, 1.3)))
    centre = (
        pick(rng, (0.05, 0.18)) * floor.width * float(rng.choice([-1, 1])),
        pick(rng, (-0.15, 0.15)) * floor.length,
    )
    node = builder.body(builder.world, (*centre, 0.0), 0.0)
    table(shop, node, size, 0.74, (0.0, 0.0))
    for _ in range(settings.clutter // 2):
        x, y = (rng.uniform(-0.5, 0.5, 2) * (np.asarray(size) - 0.16)).tolist()
        thing(shop, node, (x, y, 0.74), most=0.28)
    side = float(rng.choice([-1, 1]))
    seat = builder.body(
        node, (side * (size[0] / 2 + 0.2), pick(rng, (-0.2, 0.2)), 0), -side * np.pi / 2 + pick(rng, (-0.4, 0.4))
    )
    chair(shop, seat)
    half = (size[0] / 2 + 0.05, size[1] / 2 + 0.05)
    reach = (half[0] + 0.4 * (side < 0), half[0] + 0.4 * (side > 0))
    floor.obstacles.append((centre[0] - reach[0], centre[1] - half[1], centre[0] + reach[1], centre[1] + half[1]))


def _overlap(a: Rectangle, b: Rectangle, margin: float) -> bool:
    return a[0] - margin < b[2] and b[0] - margin < a[2] and a[1] - margin < b[3] and b[1] - margin < a[3]
