"""Moving objects: people who walk, balls that roll, a lamp that swings, a drawer that opens."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from improvo.simulation.builder import Node, SceneBuilder
from improvo.simulation.furniture import Workshop
from improvo.simulation.palette import pick
from improvo.simulation.paths import FloorPath


def walker(shop: Workshop, path: FloorPath) -> None:
    """A person: trunk, head, arms and legs on hinges, walking along a path."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    scale = pick(rng, (0.92, 1.05))
    node = _on_path(builder, path, turn=True)
    shirt, trousers, hair = palette.shirt(), palette.shirt(), palette.plain(shine=0.2)
    rate = 2 * np.pi * path.speed / (1.35 * scale)
    phase = pick(rng, (0, 2 * np.pi))
    trunk = builder.body(node, (0, 0, 0), moving=True)
    builder.joint(trunk, "slide", (0, 0, 1), lambda time: 0.02 * np.sin(2 * rate * time + phase))
    builder.ellipsoid(trunk, (0.13 * scale, 0.2 * scale, 0.33 * scale), (0, 0, 1.18 * scale), shirt)
    builder.ellipsoid(trunk, (0.13 * scale, 0.17 * scale, 0.16 * scale), (0, 0, 0.92 * scale), trousers)
    builder.capsule(trunk, (0, 0, 1.42 * scale), (0, 0, 1.52 * scale), 0.05, palette.skin)
    builder.ellipsoid(trunk, (0.1, 0.08, 0.125), (0.01, 0, 1.64 * scale), palette.skin)
    builder.ellipsoid(trunk, (0.1, 0.09, 0.1), (-0.02, 0, 1.69 * scale), hair)
    builder.ellipsoid(trunk, (0.02, 0.015, 0.025), (0.11, 0, 1.62 * scale), palette.skin)
    for side in (-1, 1):
        for y in (-0.035, 0.035):
            builder.ellipsoid(trunk, (0.008, 0.012, 0.008), (0.1, y, 1.66 * scale), palette.dark)
        leg = _limb(builder, trunk, (0, side * 0.09, 0.9 * scale), 0.5, rate, phase + (side < 0) * np.pi)
        builder.capsule(leg, (0, 0, 0), (0, 0, -0.4 * scale), 0.075, trousers)
        shin = builder.body(leg, (0, 0, -0.42 * scale), moving=True)
        _bend(builder, shin, rate, phase + (side < 0) * np.pi)
        builder.capsule(shin, (0, 0, 0), (0, 0, -0.38 * scale), 0.055, trousers)
        builder.ellipsoid(shin, (0.13, 0.05, 0.04), (0.06, 0, -0.43 * scale), palette.dark)
        arm = _limb(builder, trunk, (0, side * 0.23 * scale, 1.4 * scale), 0.4, rate, phase + (side > 0) * np.pi)
        builder.capsule(arm, (0, 0, 0), (0, side * 0.03, -0.26 * scale), 0.05, shirt)
        builder.capsule(arm, (0, side * 0.03, -0.28 * scale), (0.09, side * 0.03, -0.5 * scale), 0.038, palette.skin)


def ball(shop: Workshop, path: FloorPath) -> None:
    """A printed ball that rolls along a path."""
    builder, rng = shop.builder, shop.builder.rng
    radius = pick(rng, (0.11, 0.18))
    node = _on_path(builder, path, turn=True)
    rolling = builder.body(node, (0, 0, radius), moving=True)
    builder.joint(rolling, "hinge", (0, 1, 0), lambda time: path.speed * time / radius)
    builder.ellipsoid(rolling, (radius, radius, radius), (0, 0, 0), shop.palette.label(cube=True))


def swinging_lamp(shop: Workshop, position: tuple[float, float], ceiling: float, strength: float) -> None:
    """A lamp on a cord; its light swings with it, and so do the shadows."""
    builder, palette, rng = shop.builder, shop.palette, shop.builder.rng
    node = builder.body(builder.world, (*position, ceiling), moving=True)
    cord, swing, phase = 0.75, pick(rng, (0.22, 0.38)), pick(rng, (0, 2 * np.pi))
    rate = np.sqrt(9.81 / cord)
    builder.joint(node, "hinge", (1, 0, 0), lambda time: swing * np.sin(rate * time + phase))
    builder.joint(node, "hinge", (0, 1, 0), lambda time: 0.6 * swing * np.cos(rate * time + phase))
    builder.capsule(node, (0, 0, 0), (0, 0, -cord), 0.006, palette.dark)
    shade = [(0.2, -cord - 0.2), (0.07, -cord - 0.02), (0.02, -cord)]
    builder.lathe(node, shade, (0, 0, 0), palette.label())
    glow = builder.material(None, colour=(1.0, 0.95, 0.8), emission=1.0, shine=0.0)
    builder.ellipsoid(node, (0.05, 0.05, 0.06), (0, 0, -cord - 0.13), glow)
    builder.light(node, (0, 0, -cord - 0.23), (0, 0, -1), strength, shadow=True, cutoff=62)


def drawer_motion(rng: np.random.Generator) -> Callable[[float], float]:
    """How far a drawer is open: it slides out and in without pause."""
    phase, rate, reach = pick(rng, (0, 2 * np.pi)), pick(rng, (0.9, 1.6)), pick(rng, (0.16, 0.26))
    return lambda time: reach * 0.5 * (1 + float(np.sin(rate * time + phase)))


def _on_path(builder: SceneBuilder, path: FloorPath, turn: bool) -> Node:
    node = builder.body(builder.world, (0, 0, 0), moving=True)
    builder.joint(node, "slide", (1, 0, 0), lambda time: float(path.position(time)[0]))
    builder.joint(node, "slide", (0, 1, 0), lambda time: float(path.position(time)[1]))
    if turn:
        builder.joint(node, "hinge", (0, 0, 1), lambda time: float(path.heading(time)))
    return node


def _limb(
    builder: SceneBuilder, trunk: Node, at: tuple[float, float, float], reach: float, rate: float, phase: float
) -> Node:
    node = builder.body(trunk, at, moving=True)
    builder.joint(node, "hinge", (0, 1, 0), lambda time: reach * float(np.sin(rate * time + phase)))
    return node


def _bend(builder: SceneBuilder, shin: Node, rate: float, phase: float) -> None:
    builder.joint(shin, "hinge", (0, 1, 0), lambda time: 0.45 * (1 + float(np.cos(rate * time + phase))))
