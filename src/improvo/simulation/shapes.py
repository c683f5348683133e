"""Meshes with texture coordinates: subdivided boxes (lights are shaded per vertex) and lathed profiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.geometry.alignment import path_lengths
from improvo.types import Float64, Int64


@dataclass(frozen=True)
class Mesh:
    """Triangles with one normal and one texture coordinate per vertex."""

    vertices: Float64  # (V, 3) metres
    normals: Float64  # (V, 3)
    texture: Float64  # (V, 2)
    faces: Int64  # (F, 3)


def box(size: tuple[float, float, float], tile: float | None, step: float = 0.25) -> Mesh:
    """A box around the origin.

    Args:
        size: full side lengths.
        tile: edge length of the area that one copy of the texture covers; None stretches it over every side.
        step: edge length of the largest facet.
    """
    parts = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            # u runs right and v runs down for somebody who looks at the side from outside
            normal = np.zeros(3)
            normal[axis] = sign
            if axis == 2:
                u, v = np.array([1.0, 0, 0]), np.array([0, -sign, 0])
            else:
                v = np.array([0, 0, -1.0])
                u = np.cross(v, normal)
            parts.append(_side(np.asarray(size), normal, u, v, tile, step))
    return _join(parts)


def lathe(profile: list[tuple[float, float]], tile: float | None = None, slices: int = 20) -> Mesh:
    """A surface of revolution about z.

    Args:
        profile: (radius, height) from the bottom to the top.
        tile: as in `box`; None wraps the texture once around.
        slices: around the axis.
    """
    points = np.asarray(profile, np.float64)
    angles = np.linspace(0, 2 * np.pi, slices + 1)
    lengths = path_lengths(points)
    around = 2 * np.pi * points[:, 0].max()
    parts = []
    for row in range(len(points) - 1):
        (r0, z0), (r1, z1) = points[row], points[row + 1]
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        lower = np.column_stack([r0 * ring, np.full(len(angles), z0)])
        upper = np.column_stack([r1 * ring, np.full(len(angles), z1)])
        slope = np.array([z1 - z0, r0 - r1])
        slope /= max(float(np.linalg.norm(slope)), 1e-9)
        normals = np.column_stack([slope[0] * ring, np.full(len(angles), slope[1])])
        u = angles / (2 * np.pi) if tile is None else angles / (2 * np.pi) * around / tile
        scale = lengths[-1] if tile is None else tile
        texture = np.concatenate(
            [np.column_stack([u, np.full(len(u), 1 - length / scale)]) for length in lengths[row : row + 2]]
        )
        n = len(angles)
        index = np.arange(n - 1)
        faces = np.concatenate(
            [np.column_stack([index, index + 1, index + n]), np.column_stack([index + 1, index + 1 + n, index + n])]
        )
        parts.append(Mesh(np.concatenate([lower, upper]), np.concatenate([normals, normals]), texture, faces))
    return _join(parts)


def _side(size: Float64, normal: Float64, u: Float64, v: Float64, tile: float | None, step: float) -> Mesh:
    """One subdivided side of a box."""
    width, height = float(abs(size @ u)), float(abs(size @ v))
    columns, rows = max(1, round(width / step)), max(1, round(height / step))
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    s, t = s.ravel()[:, None], t.ravel()[:, None]
    centre = normal * float(abs(size @ normal)) / 2
    vertices = centre + (s - 0.5) * width * u + (t - 0.5) * height * v
    texture = np.hstack([s, t]) if tile is None else np.hstack([s * width / tile, t * height / tile])
    i = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    # v points down, so this order is counter-clockwise from outside
    faces = np.concatenate(
        [np.column_stack([i, i + columns + 1, i + 1]), np.column_stack([i + 1, i + columns + 1, i + columns + 2])]
    )
    return Mesh(vertices, np.tile(normal, (len(vertices), 1)), texture, faces)


def _join(parts: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])[:-1]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.texture for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
    )
