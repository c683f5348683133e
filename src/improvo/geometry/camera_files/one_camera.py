"""One camera's keys, in any of the notations of other tools, as a calibration."""

from __future__ import annotations

from typing import Any

from improvo.geometry.camera_files.calibration import MEND, Calibration, Four, four
from improvo.geometry.camera_files.distortion import model_named, normalised, usual_length
from improvo.geometry.camera_files.keys import Keys, numbers

_MATRIX = (
    *("cameramatrix", "k", "intrinsicmatrix", "intrinsicsmatrix", "mtx", "cameraintrinsicmatrix", "kmatrix"),
    *("calibrationmatrix", "matrix", "intrinsics", "intrinsic", "cameraintrinsics", "cameraintrinsic", "m"),
)
_LIST = ("intrinsics", "intrinsic", "cameraintrinsics", "cameraintrinsic")
_FX, _FY = ("fx", "fu", "flx", "focallengthx", "focalx"), ("fy", "fv", "fly", "focallengthy", "focaly")
_CX, _CY = ("cx", "cu", "u0", "ppx", "principalpointx"), ("cy", "cv", "v0", "ppy", "principalpointy")
_COEFFICIENTS = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distcoefs", "distcoef"),
    *("distortioncoeff", "distortioncoefs", "distortion", "dist", "d", "distortionparameters", "distortionparams"),
    *("distparams", "distcoefficients", "cameradistcoeffs", "coeffs", "coefficients", "kc", "disto"),
)
_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "taux", "tauy")
_TYPES_OF_SENSOR = {"camera", "rgb", "color", "colour", "mono", "monocular", "gray", "grey", "cmos", "ccd", "visual"}


def has_intrinsics(names: set[str]) -> bool:
    """Whether keys under these (normalised) names can hold a camera's intrinsics."""
    return bool(names & {*_FX, *_MATRIX, "f"})


def one_camera(keys: Keys, source: str) -> Calibration:
    """The calibration that one camera's keys say.

    Raises:
        KeyError: an intrinsic that is missing.
        ValueError: a value that cannot be, two that contradict each other, or a key that could be distortion, a model
            or a size and is not understood.
    """
    if "flx" in keys or "cameraanglex" in keys:
        keys.pass_over("aabbscale", "scale", "offset", "renderaabb", "sharpness", "up")
    size = _size(keys)
    fx, fy, cx, cy = _intrinsics(keys, size)
    if "flx" in keys:  # Nerfstudio and instant-ngp count pixels from their corner
        cx, cy = cx - 0.5, cy - 0.5
    model = _model(keys)
    distortion, model = _distortion(keys, model)
    (fx, fy, cx, cy), size = _read_out(keys, (fx, fy, cx, cy), size)
    if "scale" in keys and (keys.number("scale") or 0.0) < 100:
        keys.forget("scale")  # of the images, not of depth as in Replica's cam_params.json
    fps = keys.positive("fps", "ratehz", "framerate")
    depth_scale = keys.positive("depthscale", "depthmapfactor", "pngdepthscale", "scale")
    skew = keys.number("skew", "alphac")
    if skew is not None and skew != 0:
        raise ValueError(f"skew {skew:g} is not supported; undistort the images first")
    unread = next(keys.unread_that_matter(), None)
    if unread is not None:
        raise ValueError(
            f"`{unread}` could be distortion, a lens model or an image size, and is not understood; remove it if it "
            f"is none of these, else {MEND}"
        )
    return Calibration(source, (fx, fy, cx, cy), distortion, model, size, fps, depth_scale)


def _intrinsics(keys: Keys, size: tuple[int, int] | None) -> Four:
    for name in _MATRIX:
        if keys.any_of(name) is None:
            continue
        values = numbers(keys.take(name), keys.original(name))
        if name in _LIST and len(values) not in (9, 16):
            if len(values) != 4:
                raise ValueError(f"`{keys.original(name)}` has {len(values)} numbers, not fx, fy, cx, cy")
            found = four(values)
        else:
            found = of_matrix(values, keys.original(name))
        for aliases, said in zip((_FX, _FY, _CX, _CY), found, strict=True):
            keys.agree(dict.fromkeys(aliases, said))
        return found
    fx, fy = keys.number(*_FX), keys.number(*_FY)
    if fx is None and fy is None:
        fx = fy = keys.number("f")
    centre = [keys.number(*_CX), keys.number(*_CY)]
    if "flx" in keys:
        fy = fx if fy is None else fy
        if size is not None:
            centre = [size[axis] / 2 if value is None else value for axis, value in enumerate(centre)]
    for name, value in zip(("fx", "fy", "cx", "cy"), (fx, fy, *centre), strict=True):
        if value is None:
            raise KeyError(name)
    return float(fx or 0), float(fy or 0), float(centre[0] or 0), float(centre[1] or 0)


def of_matrix(values: tuple[float, ...], key: str) -> Four:
    """fx, fy, cx, cy of an intrinsic matrix, 3x3 or 4x4, by rows or by columns.

    Raises:
        ValueError: it is no intrinsic matrix, or has a skew.
    """
    if len(values) == 16:
        values = (*values[0:3], *values[4:7], *values[8:11])
    if len(values) != 9:
        raise ValueError(f"the camera matrix `{key}` has {len(values)} numbers, not 9")
    fx, skew, cx, zero, fy, cy, last_x, last_y, one = values
    if cx == cy == 0 and (last_x or last_y):  # by columns, as Open3D, ARKit and Matlab write it
        cx, cy, last_x, last_y, skew, zero = last_x, last_y, cx, cy, zero, skew
    if abs(last_x) + abs(last_y) + abs(zero) > 1e-9 or abs(one - 1) > 1e-9:
        raise ValueError(f"`{key}` is no intrinsic matrix: its last row must be 0 0 1")
    if abs(skew) > 1e-9 * max(1.0, abs(fx)):
        raise ValueError(f"`{key}` has a skew of {skew:g}, which is not supported; undistort the images first")
    return fx, fy, cx, cy


def _size(keys: Keys) -> tuple[int, int] | None:
    pair = keys.any_of("resolution", "imagesize", "imageresolution", "imgsize", "size", "imagedimensions", "imsize")
    if pair is not None:
        values = numbers(str(keys.take(pair)).replace("x", " "), keys.original(pair))
        if len(values) != 2:
            raise ValueError(f"`{keys.original(pair)}` is not a width and a height")
        size = _whole(values[0], values[1])
        keys.agree({"width": size[0], "height": size[1], "imagewidth": size[0], "imageheight": size[1]})
        return size
    found: tuple[int, int] | None = None
    for width_key, height_key in (
        ("width", "height"),
        ("imagewidth", "imageheight"),
        ("w", "h"),
        ("cols", "rows"),
        ("imgwidth", "imgheight"),
        ("imwidth", "imheight"),
        ("resolutionx", "resolutiony"),
        ("imagecols", "imagerows"),
        ("framewidth", "frameheight"),
    ):
        if keys.any_of(width_key) is None and keys.any_of(height_key) is None:
            continue
        width, height = keys.number(width_key), keys.number(height_key)
        if width is None or height is None:
            raise KeyError(height_key if height is None else width_key)
        if width == height == 0:  # ROS: not calibrated, or not said
            continue
        size = _whole(width, height)
        if found is not None and size != found:
            raise ValueError(f"says {found[0]}x{found[1]} and {size[0]}x{size[1]} of the images' size; leave one")
        found = size
    return found


def _whole(width: float, height: float) -> tuple[int, int]:
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise ValueError(f"an image size of {width:g}x{height:g} cannot be")
    return int(width), int(height)


def _model(keys: Keys) -> str:
    """brown, rational, modified, fisheye, fov or none as the file says it; pinhole where it says nothing."""
    said: dict[str, str] = {}
    for name in (
        *("distortionmodel", "distortiontype", "distmodel", "distortionname", "cameramodel", "modeltype", "model"),
        *("cameratype", "projectiontype", "projection", "lensmodel", "type", "distortion"),
    ):
        if keys.any_of(name) is None:
            continue
        value = keys.take(name) if name != "distortion" else _text_only(keys)
        if value is None or normalised(value) in _TYPES_OF_SENSOR or (name == "type" and not isinstance(value, str)):
            continue
        model = model_named(value, f"`{keys.original(name)}`")
        if model != "pinhole":
            said[model] = keys.original(name)
    for name in ("fisheyemodel", "isfisheye", "fisheye", "bfisheye", "usefisheye"):
        if name in keys and _truth(keys.take(name), keys.original(name)):
            said["fisheye"] = keys.original(name)
    if "fisheye" in said and "none" in said:
        del said["none"]
    if len(said) > 1:
        (first, first_key), (second, second_key) = list(said.items())[:2]
        raise ValueError(f"`{first_key}` says {first} and `{second_key}` {second}; leave the one that is true")
    return next(iter(said), "pinhole")


def _text_only(keys: Keys) -> str | None:
    """`distortion: plumb_bob` (MRPT) names the model; otherwise the key holds coefficients."""
    value = keys.look("distortion")
    return keys.take("distortion") if isinstance(value, str) and not any(c.isdigit() for c in value) else None


def _truth(value: Any, key: str) -> bool:
    text = str(value).strip().lower()
    if text in ("1", "1.0", "true", "yes"):
        return True
    if text in ("", "0", "0.0", "false", "no", "none"):
        return False
    raise ValueError(f"`{key}` is neither 0 nor 1 but {value!r}")


def _distortion(keys: Keys, model: str) -> tuple[tuple[float, ...], str]:
    """Coefficients in our order, and brown, fisheye or fov."""
    name = next((n for n in _COEFFICIENTS if keys.any_of(n) is not None and _is_list(keys, n)), None)
    values = () if name is None else numbers(keys.take(name), keys.original(name))
    if "flx" in keys and len(values) == 6:  # Nerfstudio: k1, k2, k3, k4, p1, p2
        named = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), values, strict=True))
    elif values:
        order = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("w",) if model == "fov" else _BROWN
        checked_length = usual_length(
            values, "brown" if model in ("rational", "modified", "none", "pinhole") else model
        )
        named = dict(zip(order, checked_length, strict=False))
    else:
        named = {}
    for key in (*_BROWN, "w", "omega"):
        if key in keys and key != "w":
            value = keys.number(key)
            if value is not None and key in named and named[key] != value:
                raise ValueError(f"`{keys.original(key)}` and `{keys.original(name or key)}` differ; leave one of them")
            named["w" if key == "omega" else key] = value or 0.0
    return _coefficients({key: value for key, value in named.items() if value}, set(named), model)


def _is_list(keys: Keys, name: str) -> bool:
    value = keys.look(name)
    return not isinstance(value, str) or any(c.isdigit() for c in value)


def _coefficients(values: dict[str, float], given: set[str], model: str) -> tuple[tuple[float, ...], str]:
    def at(*names: str) -> tuple[float, ...]:
        return tuple(values.get(name, 0.0) for name in names)

    def only(*names: str) -> None:
        other = next((name for name in values if name not in names), None)
        if other is not None:
            raise ValueError(f"{other} = {values[other]:g} is not supported in a {model} model; undistort the images")

    if model == "fisheye":
        only("k1", "k2", "k3", "k4")
        return at("k1", "k2", "k3", "k4"), "fisheye"
    if model == "fov":
        only("w")
        if not given:
            raise KeyError("coefficient w")
        return at("w"), "fov"
    if model == "none" and values:
        raise ValueError("says that there is no distortion, and gives coefficients; leave what is true")
    if model == "modified" and (values.get("p1") or values.get("p2")):
        raise ValueError("the modified Brown-Conrady model with p1 or p2 is not supported; undistort the images first")
    only(*_BROWN[:8])
    if values.get("k4") and model != "rational" and not {"k5", "k6"} <= given:
        raise ValueError(
            "has k4 without k5 and k6, which is either a fisheye or a polynomial that is not supported; say which by "
            "`model: fisheye` or `distortion_model: rational_polynomial`, or give --camera"
        )
    if not given and model in ("pinhole", "none"):
        return (), "brown"
    long = {"k4", "k5", "k6"} & values.keys()
    count = 8 if long or "k6" in given else 5 if "k3" in given else 4
    return (at(*_BROWN[:count]) if given else ()), "brown"


def _read_out(keys: Keys, intrinsics: Four, size: tuple[int, int] | None) -> tuple[Four, tuple[int, int] | None]:
    """ROS `roi` and `binning`: the part of the sensor that was read out, and the pixels that were joined.

    Edges of joined pixels are edges of those that they join, as where a picture is resized.
    """
    fx, fy, cx, cy = intrinsics
    x, y = keys.number("roixoffset", "xoffset") or 0.0, keys.number("roiyoffset", "yoffset") or 0.0
    width, height = keys.number("roiwidth") or 0.0, keys.number("roiheight") or 0.0
    join_x, join_y = max(keys.number("binningx") or 1.0, 1.0), max(keys.number("binningy") or 1.0, 1.0)
    keys.pass_over("roidorectify", "dorectify")
    if width and height:
        size = _whole(width, height)
    if size is not None:
        size = (int(size[0] // join_x), int(size[1] // join_y))
    centre = (cx - x + 0.5) / join_x - 0.5, (cy - y + 0.5) / join_y - 0.5
    return (fx / join_x, fy / join_y, *centre), size
