"""Camera calibrations, from every notation people have them in.

Understood: the project's own `camera.yaml` (which is also what `improvo calibrate` writes), OpenCV's FileStorage YAML,
ROS `camera_info`, Kalibr's camchain, EuRoC's `sensor.yaml`, COLMAP's `cameras.txt`, and
`fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]`. COLMAP counts pixels from their corner; its principal point is moved by half a pixel.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from improvo.errors import InputError
from improvo.geometry.camera import Camera

_MEND = "expected fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] or a calibration file (improvo, OpenCV, ROS, Kalibr, EuRoC, COLMAP)"

# the names that other tools have for our distortion models
MODEL_NAMES = {
    "": "brown",
    "none": "brown",
    "pinhole": "brown",
    "brown": "brown",
    "brown_conrady": "brown",
    "brown-conrady": "brown",
    "plumb_bob": "brown",
    "radtan": "brown",
    "radial-tangential": "brown",
    "rational_polynomial": "brown",
    "opencv": "brown",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala-brandt": "fisheye",
    "opencv_fisheye": "fisheye",
    "fov": "fov",
}


@dataclass(frozen=True)
class Calibration:
    """What a calibration says about the raw images, and the numbers that files keep beside it."""

    source: str  # the file, or "--camera"
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy, pixels; centre of the top-left pixel = (0, 0)
    distortion: tuple[float, ...] = ()
    distortion_model: str = "brown"
    size: tuple[int, int] | None = None  # width, height; None where the notation does not say
    fps: float | None = None
    depth_scale: float | None = None  # depth value / depth_scale = metres

    def camera(self, width: int, height: int) -> Camera:
        """The camera of raw images of this size.

        Raises:
            InputError: the calibration was made for another image size, or has impossible numbers.
        """
        if self.size is not None and self.size != (width, height):
            same_shape = self.size[0] * height == self.size[1] * width
            hint = (
                "the shape is the same, so give --camera with the calibration scaled to the images' size"
                if same_shape
                else "give --camera with the calibration of these images"
            )
            own = f"{self.size[0]}x{self.size[1]}"
            raise InputError(f"{self.source}: calibrated for {own} but the images are {width}x{height}; {hint}")
        try:
            return Camera(width, height, *self.intrinsics, self.distortion, self.distortion_model)
        except InputError as error:
            raise InputError(f"{self.source}: {error}") from None


def from_field_of_view(fov: float, width: int, height: int) -> Calibration:
    """A pinhole with this horizontal field of view in degrees, principal point in the middle.

    Raises:
        InputError: an angle that no pinhole has.
    """
    if not 1.0 <= fov < 179.0:
        raise InputError(f"--fov {fov:g}: must be between 1 and 179 degrees")
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    return Calibration("--fov", (focal, focal, (width - 1) / 2, (height - 1) / 2), size=(width, height))


def load_calibration(text: str, camera: str | None = None) -> Calibration:
    """A calibration from `fx,fy,cx,cy[,...]` or from a file in any of the notations above.

    Args:
        text: numbers, or the path of a file, with `#NAME` to choose one of several cameras in it.
        camera: which camera of a file with several (`cam0`, COLMAP's id); None is the first.

    Raises:
        InputError: no such file, not a calibration, or numbers that cannot be.
    """
    if re.fullmatch(r"[\s\d.,eE+-]+", text) and "," in text:
        return _from_numbers(text)
    path = Path(text)
    if not path.is_file() and "#" in text:
        name, _, camera = text.rpartition("#")
        path = Path(name)
    if not path.is_file():
        raise InputError(f"--camera {text}: no such file; {_MEND}")
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a calibration ({error}); {_MEND}") from None
    if path.suffix.lower() == ".txt":
        return _from_colmap(content, path, camera)
    return _from_mapping(parse_yaml(content, path), path, camera)


def folder_calibration(folder: Path, names: tuple[str, ...] = ("camera.yaml", "camera.yml")) -> Calibration | None:
    """The calibration that lies in a recording's folder, None without one."""
    for name in names:
        if (folder / name).is_file():
            return load_calibration(str(folder / name))
    return None


def calibration_yaml(camera: Camera, fps: float | None = None, depth_scale: float | None = None) -> str:
    """`camera.yaml` as `load_calibration` reads it, numbers exact."""
    model = "pinhole" if camera.distortion_model == "brown" else camera.distortion_model
    lines = [f"model: {model}", f"width: {camera.width}", f"height: {camera.height}"]
    lines += [f"{name}: {float(getattr(camera, name))!r}" for name in ("fx", "fy", "cx", "cy")]
    lines.append(f"distortion: [{', '.join(repr(float(value)) for value in camera.distortion)}]")
    lines += [f"fps: {fps!r}"] if fps is not None else []
    lines += [f"depth_scale: {depth_scale!r}"] if depth_scale is not None else []
    return "\n".join(lines) + "\n"


def _from_numbers(text: str) -> Calibration:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--camera {text}: not all are numbers; {_MEND}") from None
    if len(numbers) not in (4, 8, 9, 12):
        raise InputError(f"--camera {text}: {len(numbers)} numbers; {_MEND}")
    return _checked(Calibration("--camera", _four(numbers[:4]), tuple(numbers[4:])))


def parse_yaml(content: str, path: Path) -> dict[str, Any]:
    """The mapping in a YAML file, also in OpenCV's dialect.

    Raises:
        InputError: not YAML, or no mapping.
    """
    import yaml

    # OpenCV's FileStorage starts with "%YAML:1.0" and tags matrices, neither of which is YAML 1.1
    content = re.sub(r"^%YAML:.*$", "", content, flags=re.MULTILINE).replace("!!opencv-matrix", "")
    try:
        mapping = yaml.safe_load(content)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: is not valid YAML ({' '.join(str(error).split())[:120]}); {_MEND}") from None
    if not isinstance(mapping, dict):
        raise InputError(f"{path}: holds no `key: value` pairs; {_MEND}")
    return mapping


def _from_mapping(mapping: dict[str, Any], path: Path, camera: str | None) -> Calibration:
    chain = {key: value for key, value in mapping.items() if re.fullmatch(r"cam\d+", str(key))}
    if chain:
        chosen = camera or next(iter(chain))
        if chosen not in chain or not isinstance(chain[chosen], dict):
            raise InputError(f"{path}: has no camera `{chosen}`; it has {', '.join(chain)}")
        mapping = chain[chosen]
    try:
        return _checked(_interpret(mapping, str(path)))
    except KeyError as error:
        raise InputError(f"{path}: has no {error.args[0]}; {_MEND}") from None
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: a value is not what it should be ({error}); {_MEND}") from None


def _interpret(mapping: dict[str, Any], source: str) -> Calibration:
    if "camera_matrix" in mapping or "K" in mapping or "k" in mapping:
        matrix = _numbers(mapping.get("camera_matrix", mapping.get("K", mapping.get("k"))))
        if len(matrix) != 9:
            raise ValueError(f"the camera matrix has {len(matrix)} numbers, not 9")
        intrinsics = (matrix[0], matrix[4], matrix[2], matrix[5])
        keys = ("distortion_coefficients", "D", "d", "distortion")
        distortion = _numbers(next((mapping[key] for key in keys if key in mapping), ()))
        model = mapping.get("distortion_model", "")
    elif "intrinsics" in mapping:
        camera_model = str(mapping.get("camera_model", "pinhole")).lower()
        if camera_model != "pinhole":
            raise ValueError(f"camera_model {camera_model} is not supported; known: pinhole")
        intrinsics = _four(_numbers(mapping["intrinsics"]))
        distortion = _numbers(mapping.get("distortion_coeffs", mapping.get("distortion_coefficients", ())))
        model = mapping.get("distortion_model", "")
    else:
        intrinsics = (float(mapping["fx"]), float(mapping["fy"]), float(mapping["cx"]), float(mapping["cy"]))
        distortion = _numbers(mapping.get("distortion", ()))
        model = mapping.get("distortion_model", mapping.get("model", ""))
    return Calibration(
        source,
        intrinsics,
        usual_length(distortion, _model(model)),
        _model(model),
        _size(mapping),
        _optional(mapping, "fps", "rate_hz"),
        _optional(mapping, "depth_scale"),
    )


def _from_colmap(content: str, path: Path, camera: str | None) -> Calibration:
    rows = [line.split() for line in content.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    rows = [row for row in rows if camera is None or row[0] == camera]
    if not rows or len(rows[0]) < 5:
        raise InputError(f"{path}: has no COLMAP camera row (CAMERA_ID MODEL WIDTH HEIGHT PARAMS...); {_MEND}")
    _, model, width, height, *parameters = rows[0]
    try:
        return colmap_calibration(str(path), model, (int(width), int(height)), [float(value) for value in parameters])
    except ValueError as error:
        raise InputError(f"{path}: {error}; {_MEND}") from None


def colmap_calibration(source: str, model: str, size: tuple[int, int], parameters: list[float]) -> Calibration:
    """A camera of COLMAP as a calibration.

    Args:
        source: the file, for messages.
        model: COLMAP's name of the camera model.
        size: width and height of the images.
        parameters: in COLMAP's order; its principal point counts from the corner of the top-left pixel.

    Raises:
        ValueError: an unknown model or another number of parameters.
        InputError: numbers that cannot be.
    """
    (fx, fy, cx, cy), distortion, name = _colmap_parameters(model, parameters)
    return _checked(Calibration(source, (fx, fy, cx - 0.5, cy - 0.5), distortion, name, size))


def _colmap_parameters(model: str, p: list[float]) -> tuple[tuple[float, float, float, float], tuple[float, ...], str]:
    """COLMAP's parameter lists (its documentation, "Camera Models"), as intrinsics, distortion and our model name."""
    counts = {
        "SIMPLE_PINHOLE": 3,
        "PINHOLE": 4,
        "SIMPLE_RADIAL": 4,
        "RADIAL": 5,
        "OPENCV": 8,
        "FULL_OPENCV": 12,
        "OPENCV_FISHEYE": 8,
        "SIMPLE_RADIAL_FISHEYE": 4,
        "RADIAL_FISHEYE": 5,
        "FOV": 5,
    }
    if model not in counts:
        raise ValueError(f"COLMAP model {model} is not supported; known: {', '.join(counts)}")
    if len(p) != counts[model]:
        raise ValueError(f"COLMAP model {model} has {counts[model]} parameters, not {len(p)}")
    if model.startswith(("SIMPLE_", "RADIAL")):
        k1, k2 = (*p[3:], 0.0, 0.0)[:2]
        name = "fisheye" if model.endswith("FISHEYE") else "brown"
        return (p[0], p[0], p[1], p[2]), (k1, k2, 0.0, 0.0) if len(p) > 3 else (), name
    return _four(p[:4]), tuple(p[4:]), {"OPENCV_FISHEYE": "fisheye", "FOV": "fov"}.get(model, "brown")


def _checked(calibration: Calibration) -> Calibration:
    """The calibration, after a camera could be made of it: errors are then found on reading."""
    calibration.camera(*(calibration.size or (1, 1)))
    return calibration


def _numbers(value: Any) -> tuple[float, ...]:
    """A flat list of numbers from a list, nested lists, or a {rows, cols, data} matrix."""
    if value is None:
        return ()
    if isinstance(value, dict):
        value = value["data"]
    flat: list[float] = []
    for item in value:
        flat += _numbers(item) if isinstance(item, list | tuple) else [float(item)]
    return tuple(flat)


def _four(values: list[float] | tuple[float, ...]) -> tuple[float, float, float, float]:
    fx, fy, cx, cy = values
    return fx, fy, cx, cy


def usual_length(distortion: tuple[float, ...], model: str) -> tuple[float, ...]:
    """Brown coefficients without zeros beyond the eighth, and with zeros up to the fourth."""
    if model != "brown":
        return distortion
    if any(distortion[8:]):
        raise ValueError("thin prism or tilt coefficients are not supported")
    while len(distortion) not in (0, 4, 5, 8):
        distortion = distortion[:8] if len(distortion) > 8 else (*distortion, 0.0)
    return distortion


def _model(name: Any) -> str:
    model = MODEL_NAMES.get(str(name or "").strip().lower())
    if model is None:
        raise ValueError(f"distortion model {name!r} is not supported; known: brown, fisheye, fov")
    return model


def _size(mapping: dict[str, Any]) -> tuple[int, int] | None:
    if "resolution" in mapping:
        width, height = mapping["resolution"]
        return int(width), int(height)
    for width_key, height_key in (("width", "height"), ("image_width", "image_height")):
        if width_key in mapping:
            return int(mapping[width_key]), int(mapping[height_key])
    return None


def _optional(mapping: dict[str, Any], *keys: str) -> float | None:
    """The first of these keys as a positive number, None without any."""
    for key in keys:
        if mapping.get(key) is not None:
            value = float(mapping[key])
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{key} {value:g} is not positive")
            return value
    return None
