"""Notations whose keys mean something else than usual, as the usual keys."""

from __future__ import annotations

from typing import Any

from improvo.geometry.camera_files.distortion import normalised
from improvo.geometry.camera_files.keys import number, numbers


def translated(tree: Any) -> Any:
    """The tree of a tool that has its own words, in the words that are read; any other tree as it is.

    Raises:
        ValueError: a model or a value that is not supported.
    """
    if isinstance(tree, list) and len(tree) == 1 and isinstance(tree[0], dict):
        tree = tree[0]
    if not isinstance(tree, dict):
        return tree
    names = {normalised(key) for key in tree}
    for needed, translate in _TRANSLATIONS:
        if needed <= names:
            return translate({normalised(key): value for key, value in tree.items()}, tree)
    return tree


def _basalt(_: dict[str, Any], tree: dict[str, Any]) -> Any:
    """Basalt's calibration: `value0` with lists of cameras and of their resolutions."""
    content = tree["value0"]
    if not isinstance(content, dict) or not isinstance(content.get("intrinsics"), list):
        return tree
    sizes = content.get("resolution") or []
    result = {}
    for row, camera in enumerate(content["intrinsics"]):
        entry = {"model": camera.get("camera_type"), **dict(camera.get("intrinsics") or {})}
        if row < len(sizes):
            entry["resolution"] = sizes[row]
        result[f"cam{row}"] = entry
    return result


def _camodocal(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    """VINS, GVINS and camodocal: `model_type` with groups of parameters; `fisheye` there is a mask."""
    tree = {key: value for key, value in tree.items() if normalised(key) != "fisheye"}
    kind = normalised(names["modeltype"])
    projection = names.get("projectionparameters")
    if kind == "kannalabrandt" and isinstance(projection, dict):
        given = {name: number(value, name) for name, value in projection.items()}
        focal = {"fx": given.pop("mu"), "fy": given.pop("mv"), "cx": given.pop("u0"), "cy": given.pop("v0")}
        powers = {f"k{power - 1}": given.pop(f"k{power}") for power in (2, 3, 4, 5)}
        rest = {
            key: value for key, value in tree.items() if normalised(key) not in ("projectionparameters", "modeltype")
        }
        return {**rest, **focal, **powers, **given, "model": "kannala_brandt"}
    if kind in ("mei", "scaramuzza"):
        raise ValueError(
            f"model_type {names['modeltype']} (omnidirectional) is not supported; undistort the images first"
        )
    return tree


def _gyroflow(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    """Lens profiles of Gyroflow: `camera_model` and `lens_model` are names of products."""
    parameters, size = names["fisheyeparams"], names["calibdimension"]
    for key in ("inputhorizontalstretch", "inputverticalstretch"):
        if key in names and number(names[key] or 1, key) != 1:
            raise ValueError(f"`{key}` of {names[key]} is not supported; stretch the images first")
    if names.get("digitallens"):
        raise ValueError(f"digital lens {names['digitallens']!r} is not supported; undistort the images first")
    model = names.get("distortionmodel") or "opencv_fisheye"
    matrix, coefficients = parameters.get("camera_matrix"), parameters.get("distortion_coeffs")
    if normalised(model) == "opencvstandard":
        model = "brown"
    return {
        "camera_matrix": matrix,
        "distortion_coefficients": coefficients,
        "distortion_model": model,
        "resolution": [size.get("w"), size.get("h")],
        "fps": names.get("fps") or None,
    }


def _depthai(names: dict[str, Any], _: dict[str, Any]) -> Any:
    """OAK cameras: pairs of socket and camera; `cameraType` 0 is perspective, 1 fisheye."""
    result = {}
    entries = names["cameradata"]
    for socket, camera in entries if isinstance(entries, list) else entries.items():
        kind = camera.get("cameraType", 0)
        coefficients = list(camera.get("distortionCoeff", ()))
        fisheye = kind in (1, "1", "Fisheye")
        result[f"cam{socket}"] = {
            "camera_matrix": camera.get("intrinsicMatrix"),
            "distortion_coefficients": coefficients[:4] if fisheye and not any(coefficients[4:]) else coefficients,
            "distortion_model": "fisheye" if fisheye else "rational_polynomial",
            "resolution": [camera.get("width"), camera.get("height")],
        }
    return result


def _matlab(names: dict[str, Any], _: dict[str, Any]) -> Any:
    """Matlab's cameraParameters: pixels count from 1, sizes are rows and columns, the old matrix is by columns."""
    matrix = numbers(names.get("k", names.get("intrinsicmatrix")), "IntrinsicMatrix")
    radial, tangential = (
        numbers(names["radialdistortion"], "RadialDistortion"),
        numbers(names.get("tangentialdistortion", [0, 0]), "TangentialDistortion"),
    )
    if len(matrix) != 9 or len(radial) not in (2, 3) or len(tangential) != 2:
        raise ValueError("is no cameraParameters of Matlab: IntrinsicMatrix, RadialDistortion or TangentialDistortion")
    if matrix[2] == matrix[5] == 0:
        matrix = tuple(matrix[3 * column + row] for row in range(3) for column in range(3))
    fx, skew, cx, _zero, fy, cy = matrix[:6]
    matlab: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx - 1, "cy": cy - 1, "skew": skew}
    matlab["distortion"] = [*radial[:2], *tangential, *radial[2:]]
    size = numbers(names.get("imagesize"), "ImageSize")
    if len(size) == 2:
        matlab["resolution"] = [size[1], size[0]]
    return matlab


def _vikit(_: dict[str, Any], tree: dict[str, Any]) -> Any:
    """SVO and FAST-LIVO: `cam_model`, `cam_fx`, and `cam_d0` ... `cam_d3` in OpenCV's order."""
    own = {normalised(key).removeprefix("cam"): value for key, value in tree.items()}
    values = [own.pop(f"d{number}") for number in range(4) if f"d{number}" in own]
    if normalised(own.get("model", "pinhole")) == "atan":
        return {**own, "omega": values[0] if values else None}
    return {**own, **({"distortion": values} if values else {})}


def _mast3r(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    """MASt3R-SLAM: `calibration` holds fx, fy, cx, cy and the distortion in one list."""
    values = numbers(names["calibration"], "calibration")
    rest = {key: value for key, value in tree.items() if normalised(key) != "calibration"}
    return {**rest, "intrinsics": list(values[:4]), "distortion": list(values[4:])}


def _is_mast3r(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    return _mast3r(names, tree) if isinstance(names["calibration"], list) else tree


def _meshroom(names: dict[str, Any], _: dict[str, Any]) -> Any:
    raise ValueError("Meshroom's cameras.sfm is not read; export the scene as COLMAP and give its cameras.txt")


def _stereo(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    """OpenCV's stereo samples: M1 and D1 of the left camera, M2 and D2 of the right."""
    result = {}
    for side in ("1", "2"):
        own = {"m": "camera_matrix", "d": "distortion_coefficients", "k": "camera_matrix"}
        result[side] = {
            own[key[0]]: value for key, value in names.items() if key in (f"m{side}", f"d{side}", f"k{side}")
        }
    shared = {key: value for key, value in tree.items() if normalised(key) not in ("m1", "m2", "d1", "d2", "k1", "k2")}
    return {**{key: value for key, value in shared.items() if not isinstance(value, dict)}, **result}


def _is_stereo(names: dict[str, Any], tree: dict[str, Any]) -> Any:
    value = names.get("m1", names.get("k1"))
    return _stereo(names, tree) if isinstance(value, dict | list) else tree


_TRANSLATIONS = (
    ({"value0"}, _basalt),
    ({"modeltype", "projectionparameters"}, _camodocal),
    ({"fisheyeparams", "calibdimension"}, _gyroflow),
    ({"cameradata"}, _depthai),
    ({"radialdistortion", "imagesize"}, _matlab),
    ({"sfmdataversion"}, _meshroom),
    ({"camfx", "camfy"}, _vikit),
    ({"calibration"}, _is_mast3r),
    ({"m1", "d1"}, _is_stereo),
    ({"k1", "d1"}, _is_stereo),
)
