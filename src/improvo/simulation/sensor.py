"""Effects of a real camera: motion blur, rolling shutter, vignetting, exposure, noise."""

from __future__ import annotations

import cv2
import numpy as np

from improvo.simulation.settings import SimulationSettings
from improvo.types import Float64, UInt8


class Sensor:
    """One camera; its exposure drifts over the sequence, its noise follows from seed and frame number."""

    def __init__(self, settings: SimulationSettings) -> None:
        self._settings = settings
        rng = np.random.default_rng([settings.seed, 1])
        self._phase = rng.uniform(0, 2 * np.pi, 3)
        y, x = np.mgrid[: settings.height, : settings.width].astype(np.float32)
        self._x, self._y = x, y
        radius = np.hypot(x - (settings.width - 1) / 2, y - (settings.height - 1) / 2)
        self._vignette = 1 - settings.vignetting * (radius / radius.max()) ** 2

    def expose(self, image: UInt8, motion: Float64, frame: int, time: float) -> UInt8:
        """The picture that the camera delivers.

        Args:
            image: (H, W, 3) at the middle of the exposure of the middle row.
            motion: (H, W, 2) image motion there, pixels per second.
            frame: its number, which seeds the noise.
            time: of the frame, seconds.
        """
        settings = self._settings
        rows = (self._y / max(settings.height - 1, 1) - 0.5) * settings.rolling_shutter
        flow = motion.astype(np.float32)
        samples = settings.blur_samples if settings.exposure_time > 0 else 1
        total = np.zeros(image.shape, np.float32)
        for offset in ((np.arange(samples) + 0.5) / samples - 0.5) * settings.exposure_time:
            # a point seen here at `offset` was at minus its motion in the perfect picture
            delay = (rows + np.float32(offset)).astype(np.float32)
            x, y = self._x - flow[..., 0] * delay, self._y - flow[..., 1] * delay
            total += cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        drift = np.sin(2 * np.pi * np.array([0.11, 0.23, 0.41]) * time + self._phase) @ np.array([0.5, 0.3, 0.2])
        gain = 1 + settings.exposure_drift * float(drift)
        signal = total / samples * (self._vignette * gain)[..., None]
        if not settings.colour:
            signal = signal @ np.array([0.299, 0.587, 0.114], np.float32)
        rng = np.random.default_rng([settings.seed, 2, frame])
        spread = settings.noise * np.sqrt(0.3 + 0.7 * np.clip(signal, 0, 255) / 128)
        noisy = signal + spread * rng.standard_normal(signal.shape, np.float32)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
