"""Builds a MuJoCo model (MJCF) from materials, shapes, lights and joints, and records what each geom is."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from improvo.simulation import shapes
from improvo.simulation.shapes import Mesh
from improvo.types import UInt8

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """How a surface looks."""

    name: str
    repeated: bool = False  # the texture repeats, so its points look alike
    tile: float | None = None  # metres that one copy of the texture covers; None: once over every side


@dataclass(frozen=True)
class Node:
    """A body of the model that shapes are put into."""

    element: ET.Element
    moving: bool = False


@dataclass(frozen=True)
class Motion:
    """One joint and its position over time."""

    joint: str
    position: Callable[[float], float]  # seconds -> metres or radians


class SceneBuilder:
    """Builds one model; `rng` chooses whatever a caller leaves open."""

    def __init__(self, rng: np.random.Generator, gloss: float) -> None:
        self.rng = rng
        self.gloss = gloss
        self.assets: dict[str, bytes] = {}
        self.motions: list[Motion] = []
        self.repeated: set[str] = set()  # geoms
        self.moving: set[str] = set()  # geoms
        self.root = ET.Element("mujoco")
        self._asset = ET.SubElement(self.root, "asset")
        self.world = Node(ET.SubElement(self.root, "worldbody"))
        self._count = 0

    def material(
        self,
        image: UInt8 | None,
        tile: float | None = None,
        repeated: bool = False,
        colour: Iterable[float] = (1.0, 1.0, 1.0),
        shine: float | None = None,
        emission: float = 0.0,
        cube: bool = False,
    ) -> Material:
        """A new material.

        Args:
            image: (H, W, 3) RGB, or None for a plain colour.
            tile: metres that one copy covers; None stretches the image over every side.
            repeated: the image repeats within itself or over the surface, so its points look alike.
            colour: RGB in 0..1, multiplied with the image.
            shine: specular strength in 0..1; None draws it from the scene's gloss.
            emission: own light in 0..1.
            cube: for spheres, capsules and ellipsoids, which have no texture coordinates.
        """
        name = self._name("material")
        if shine is None:
            shine = float(self.rng.uniform(0.5, 1.0)) if self.rng.uniform() < self.gloss else 0.0
        rgba = " ".join(f"{value:.4f}" for value in (*colour, 1.0))
        attributes = {"name": name, "rgba": rgba, "specular": f"{shine:.3f}", "emission": f"{emission:.3f}"}
        attributes["shininess"] = f"{self.rng.uniform(0.25, 0.8):.3f}"
        if image is not None:
            file = f"{name}.png"
            self.assets[file] = _png(image)
            ET.SubElement(self._asset, "texture", name=name, type="cube" if cube else "2d", file=file)
            attributes["texture"] = name
        ET.SubElement(self._asset, "material", attributes)
        return Material(name, repeated, tile)

    def body(self, parent: Node, position: Vector, yaw: float = 0.0, pitch: float = 0.0, moving: bool = False) -> Node:
        """A new frame inside `parent`: turned by pitch about its y axis, then by yaw about z (radians)."""
        rotation = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        tilt = np.array([np.cos(pitch / 2), 0, np.sin(pitch / 2), 0])
        quat = _quat_product(rotation, tilt)
        element = ET.SubElement(parent.element, "body", name=self._name("body"), pos=_text(position), quat=_text(quat))
        if moving:  # it is never simulated, but the model must be one that could be
            ET.SubElement(element, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        return Node(element, moving or parent.moving)

    def joint(self, node: Node, kind: str, axis: Vector, position: Callable[[float], float]) -> None:
        """A hinge or slide of the body that follows `position` over time."""
        name = self._name("joint")
        ET.SubElement(node.element, "joint", name=name, type=kind, axis=_text(axis))
        self.motions.append(Motion(name, position))

    def box(
        self, node: Node, size: Vector, position: Vector, material: Material, yaw: float = 0.0, step: float = 0.25
    ) -> str:
        """A box with full side lengths `size`."""
        return self.mesh(node, shapes.box(size, material.tile, step), position, material, yaw)

    def lathe(
        self, node: Node, profile: list[tuple[float, float]], position: Vector, material: Material, slices: int = 20
    ) -> str:
        """A turned shape; `profile` holds (radius, height) from the bottom to the top."""
        return self.mesh(node, shapes.lathe(profile, material.tile, slices), position, material)

    def mesh(self, node: Node, mesh: Mesh, position: Vector, material: Material, yaw: float = 0.0) -> str:
        """Any mesh."""
        name = self._name("mesh")
        ET.SubElement(
            self._asset,
            "mesh",
            name=name,
            inertia="shell",
            vertex=_text(mesh.vertices.ravel()),
            normal=_text(mesh.normals.ravel()),
            texcoord=_text(mesh.texture.ravel()),
            face=" ".join(map(str, mesh.faces.ravel())),
        )
        quat = _text((np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
        return self._geom(node, material, type="mesh", mesh=name, pos=_text(position), quat=quat)

    def ellipsoid(self, node: Node, radii: Vector, position: Vector, material: Material) -> str:
        """An ellipsoid, or a ball."""
        return self._geom(node, material, type="ellipsoid", size=_text(radii), pos=_text(position))

    def capsule(self, node: Node, start: Vector, end: Vector, radius: float, material: Material) -> str:
        """A rod with round ends."""
        return self._geom(node, material, type="capsule", size=f"{radius:.5f}", fromto=_text((*start, *end)))

    def cylinder(self, node: Node, start: Vector, end: Vector, radius: float, material: Material) -> str:
        """A rod with flat ends."""
        return self._geom(node, material, type="cylinder", size=f"{radius:.5f}", fromto=_text((*start, *end)))

    def light(
        self, node: Node, position: Vector, direction: Vector, strength: float, shadow: bool, cutoff: float = 80.0
    ) -> None:
        """A lamp that shines along `direction`, within `cutoff` degrees of it."""
        warm = np.array([1.0, self.rng.uniform(0.93, 1.0), self.rng.uniform(0.82, 0.97)]) * strength
        ET.SubElement(
            node.element,
            "light",
            pos=_text(position),
            dir=_text(direction),
            diffuse=_text(warm),
            specular=_text(np.minimum(warm * 1.5, 1.0)),
            ambient="0 0 0",
            castshadow=str(shadow).lower(),
            cutoff=f"{cutoff:.2f}",
            exponent="0.5",
            attenuation="0.8 0 0.06",
        )

    def xml(self) -> str:
        """The model as MJCF."""
        return ET.tostring(self.root, encoding="unicode")

    def _geom(self, node: Node, material: Material, **attributes: str) -> str:
        name = self._name("geom")
        if material.repeated:
            self.repeated.add(name)
        if node.moving:
            self.moving.add(name)
        attributes |= {"name": name, "material": material.name, "contype": "0", "conaffinity": "0", "mass": "0.1"}
        ET.SubElement(node.element, "geom", attributes)
        return name

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{kind}{self._count}"


def _png(image: UInt8) -> bytes:
    return cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 0])[1].tobytes()


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{float(value):.6g}" for value in values)


def _quat_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of two quaternions w, x, y, z."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
