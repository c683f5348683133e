"""Chooses materials for a room: rich, plain or repeated ones in the shares that the settings ask for."""

from __future__ import annotations

import numpy as np

from improvo.simulation import pictures, textures
from improvo.simulation.builder import Material, SceneBuilder
from improvo.simulation.settings import SimulationSettings
from improvo.simulation.textures import Texture


class Palette:
    """Materials on demand; some are used again, as in a real household."""

    def __init__(self, builder: SceneBuilder, settings: SimulationSettings) -> None:
        self._builder = builder
        self._settings = settings
        self._woods = [self._of(textures.wood, tile=0.9) for _ in range(3)]
        self.dark = builder.material(None, colour=(0.08, 0.08, 0.09), shine=0.3)
        self.metal = builder.material(None, colour=(0.62, 0.63, 0.66), shine=1.0)
        self.white = builder.material(None, colour=(0.88, 0.87, 0.84), shine=0.2)
        self.skin = builder.material(None, colour=(0.82, 0.62, 0.5), shine=0.1)

    def wood(self) -> Material:
        """One of the few woods of this household."""
        return self._woods[int(self._builder.rng.integers(0, len(self._woods)))]

    def wall(self) -> Material:
        """Of a whole wall."""
        rng = self._builder.rng
        kinds = self._share(textures.PLAIN, textures.REPEATED_WALL, textures.RICH_WALL)
        return self._of(kinds[int(rng.integers(0, len(kinds)))], tile=float(rng.uniform(1.3, 2.0)), shine=0.0)

    def floor(self) -> Material:
        """Of the floor."""
        rng = self._builder.rng
        if rng.uniform() < self._settings.repeated_share:
            return self._of(textures.tiles if rng.uniform() < 0.5 else textures.checker, tile=2.4)
        kinds = (textures.planks, textures.planks, textures.stone, textures.marble)
        return self._of(kinds[int(rng.integers(0, 4))], tile=float(rng.uniform(1.8, 2.6)))

    def surface(self, tile: float = 0.6) -> Material:
        """Of a piece of furniture."""
        rng = self._builder.rng
        kinds = self._share(textures.PLAIN, textures.REPEATED, textures.RICH)
        return self._of(kinds[int(rng.integers(0, len(kinds)))], tile=tile)

    def cloth(self) -> Material:
        """Of cushions, sofas, curtains."""
        repeated = self._builder.rng.uniform() < self._settings.repeated_share
        return self._of(textures.tartan if repeated else textures.fabric, tile=0.5, shine=0.0)

    def rug(self) -> Material:
        """Of a rug, once over its whole area."""
        return self._of(textures.carpet, tile=None, shine=0.0)

    def poster(self) -> Material:
        """A framed picture."""
        return self._of(pictures.poster, tile=None)

    def books(self) -> Material:
        """Spines of a row of books."""
        return self._of(pictures.book_spines, tile=None, shine=0.0)

    def package(self) -> Material:
        """A printed box."""
        return self._of(pictures.package, tile=None)

    def page(self) -> Material:
        """Printed paper."""
        return self._of(pictures.printed_page, tile=None, shine=0.0)

    def label(self, cube: bool = False) -> Material:
        """What is wrapped around round things; glossy more often than other things."""
        shine = 1.0 if self._builder.rng.uniform() < 2 * self._settings.gloss else 0.0
        image = pictures.label(self._builder.rng)
        return self._builder.material(image, shine=shine, cube=cube)

    def shirt(self, cube: bool = True) -> Material:
        """Clothes with a print."""
        return self._builder.material(pictures.shirt(self._builder.rng), shine=0.0, cube=cube)

    def window(self) -> Material:
        """The bright view out of a window."""
        return self._builder.material(pictures.window_view(self._builder.rng), shine=0.6, emission=0.45)

    def screen(self) -> Material:
        """A monitor that is on."""
        return self._builder.material(pictures.printed_page(self._builder.rng), shine=0.8, emission=0.3)

    def plain(self, shine: float | None = None) -> Material:
        """One colour."""
        rgb = textures.colour(self._builder.rng, (0.05, 0.8), (0.3, 0.95)) / 255
        return self._builder.material(None, colour=[float(value) for value in rgb], shine=shine)

    def _share(
        self, plain: tuple[Texture, ...], repeated: tuple[Texture, ...], rich: tuple[Texture, ...]
    ) -> tuple[Texture, ...]:
        """One of three groups, in the shares of the settings."""
        draw = self._builder.rng.uniform()
        if draw < self._settings.plain_share:
            return plain
        return repeated if draw < self._settings.plain_share + self._settings.repeated_share else rich

    def _of(self, texture: Texture, tile: float | None, shine: float | None = None) -> Material:
        repeated = texture in textures.REPEATED or texture in textures.REPEATED_WALL
        return self._builder.material(texture(self._builder.rng), tile, repeated, shine=shine)


def pick(rng: np.random.Generator, values: tuple[float, float]) -> float:
    """A float between two bounds."""
    return float(rng.uniform(*values))
