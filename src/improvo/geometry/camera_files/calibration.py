"""What a calibration says about the images it was made for."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files.distortion import usual_length

MEND = "give fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] or a calibration file that docs/cameras.md lists"
_RELATIVE = 0.02  # focal lengths below this share of the picture are not in pixels
_MAX_ASPECT = 4.0  # between fx and fy; more is a slip, such as a decimal comma

Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class Calibration:
    """What a calibration says about the raw images, and the numbers that files keep beside it."""

    source: str  # the file, or "--camera"
    intrinsics: Four  # fx, fy, cx, cy, pixels; centre of the top-left pixel = (0, 0)
    distortion: tuple[float, ...] = ()
    distortion_model: str = "brown"
    size: tuple[int, int] | None = None  # width, height; None where the notation does not say
    fps: float | None = None
    depth_scale: float | None = None  # depth value / depth_scale = metres
    alternatives: tuple[Calibration, ...] = ()  # of the same file, for other image sizes

    def camera(self, width: int, height: int) -> Camera:
        """The camera of raw images of this size.

        Raises:
            InputError: the calibration was made for another image size, or has impossible numbers.
        """
        chosen = self
        if self.size is not None and self.size != (width, height):
            fitting = next((other for other in self.alternatives if other.size == (width, height)), None)
            if fitting is None:
                own = f"{self.size[0]}x{self.size[1]}"
                mend = _size_hint(self.size, (width, height))
                raise InputError(f"{self.source}: calibrated for {own} but the images are {width}x{height}; {mend}")
            chosen = fitting
        try:
            camera = Camera(width, height, *chosen.intrinsics, chosen.distortion, chosen.distortion_model)
        except InputError as error:
            raise InputError(f"{chosen.source}: {error}") from None
        if max(camera.fx, camera.fy) < _RELATIVE * max(width, height):
            raise InputError(
                f"{chosen.source}: focal lengths {camera.fx:g} and {camera.fy:g} for images of {width}x{height} are no "
                "pixels; if they are relative to the picture, multiply them by its sides, and if they are in "
                "millimetres, by its width over that of the sensor"
            )
        if not 1 / _MAX_ASPECT <= camera.fx / camera.fy <= _MAX_ASPECT:
            raise InputError(
                f"{chosen.source}: fx {camera.fx:g} and fy {camera.fy:g} are too different for one lens; check their "
                "order, and write decimal points, not commas"
            )
        return camera


def checked(calibration: Calibration) -> Calibration:
    """The calibration, after a camera could be made of it: errors are then found on reading."""
    calibration.camera(*(calibration.size or (1, 1)))
    return calibration


def from_field_of_view(fov: float, width: int, height: int) -> Calibration:
    """A pinhole with this horizontal field of view in degrees, principal point in the middle.

    Raises:
        InputError: an angle that no pinhole has, or that no lens has across so narrow a picture.
    """
    check_field_of_view(fov, "--fov")
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    if focal < _RELATIVE * max(width, height):
        raise InputError(
            f"pictures of {width}x{height} are too narrow for a field of view of {fov:g} degrees across their width, "
            "as --fov has it; give the camera itself by --camera fx,fy,cx,cy"
        )
    return Calibration("--fov", (focal, focal, (width - 1) / 2, (height - 1) / 2), size=(width, height))


def check_field_of_view(degrees: float, flag: str) -> None:
    """Refuse an angle that no pinhole camera has, or that is in radians.

    Raises:
        InputError: it is outside of 4 to 179 degrees. (4 degrees are a lens of 500 mm before 35 mm film.)
    """
    if not 4.0 <= degrees < 179.0:
        radians = f" (if it is in radians: {math.degrees(degrees):.1f} degrees)" if 0.1 <= degrees <= math.pi else ""
        raise InputError(f"{flag} {degrees:g}: must be between 4 and 179 degrees{radians}")


def from_numbers(text: str) -> Calibration:
    """A calibration from `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]` as it stands after --camera.

    Raises:
        InputError: not these numbers.
    """
    parts = text.split()
    if len(parts) > 1 and "," in text and all(re.fullmatch(r"[+-]?\d*,?\d+", part) for part in parts):
        text = text.replace(",", ".")  # decimal commas
    try:
        numbers = [float(part) for part in re.split(r"[\s,;]+", text.strip().strip(","))]
    except ValueError:
        raise InputError(f"--camera {text}: not all are numbers; {MEND}") from None
    if len(numbers) not in (4, 8, 9, 12):
        raise InputError(f"--camera {text}: {len(numbers)} numbers; {MEND}")
    return checked(Calibration("--camera", four(numbers[:4]), usual_length(tuple(numbers[4:]), "brown")))


def calibration_yaml(camera: Camera, fps: float | None = None, depth_scale: float | None = None) -> str:
    """`camera.yaml` as `load_calibration` reads it, numbers exact.

    Args:
        camera: of the raw images.
        fps: frames per second of a recording without time stamps.
        depth_scale: depth value / depth_scale = metres.
    """
    model = "pinhole" if camera.distortion_model == "brown" else camera.distortion_model
    lines = [f"model: {model}", f"width: {camera.width}", f"height: {camera.height}"]
    lines += [f"{name}: {float(getattr(camera, name))!r}" for name in ("fx", "fy", "cx", "cy")]
    lines.append(f"distortion: [{', '.join(repr(float(value)) for value in camera.distortion)}]")
    lines += [f"fps: {fps!r}"] if fps is not None else []
    lines += [f"depth_scale: {depth_scale!r}"] if depth_scale is not None else []
    return "\n".join(lines) + "\n"


def four(values: list[float] | tuple[float, ...]) -> Four:
    """Exactly fx, fy, cx, cy.

    Raises:
        ValueError: another count.
    """
    if len(values) != 4:
        raise ValueError(f"has {len(values)} numbers, not fx, fy, cx, cy")
    fx, fy, cx, cy = values
    return fx, fy, cx, cy


def _size_hint(own: tuple[int, int], images: tuple[int, int]) -> str:
    """What a difference of sizes may come from, and the mend."""
    if own == images[::-1]:
        return "the pictures are turned by a quarter; turn them back, or give --camera with the calibration turned too"
    if (2 * own[0], own[1]) == images:
        return "twice as wide is left and right side by side; cut out the half that the calibration is of"
    if own[0] * images[1] == own[1] * images[0]:
        return "the shape is the same, so give --camera with the calibration scaled to the images' size"
    return "give --camera with the calibration of these images"
