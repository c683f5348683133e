"""YAML, JSON, XML, INI and NPZ files as trees of keys."""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from typing import Any

from improvo.errors import InputError
from improvo.geometry.camera_files.calibration import MEND
from improvo.untrusted.arrays import read_npz
from improvo.untrusted.text import load_json, load_xml, load_yaml

_MAX_DEPTH = 64  # of elements


def parse_yaml(content: str, path: Path) -> dict[str, Any]:
    """The mapping in a YAML file, also in OpenCV's dialect; the first of several documents.

    Raises:
        InputError: not YAML, or no mapping.
    """
    tree = _yaml(content, path)
    if not isinstance(tree, dict):
        raise InputError(f"{path}: holds no `key: value` pairs; {MEND}")
    return tree


def parse_tree(content: str, path: Path) -> Any:
    """Nested mappings and lists from a text in YAML, JSON, XML or INI, told by its beginning.

    Raises:
        InputError: none of them.
    """
    start = content.lstrip()[:1]
    if start == "<":
        return _xml(content, path)
    if re.search(r"\A\s*(?:[#;].*\n\s*)*\[[A-Za-z_][\w ]*\]\s*(?:[#;].*)?\n", content):
        return _ini(content, path)
    if start in ("{", "["):
        try:
            return load_json(content)
        except ValueError as error:
            if path.suffix.lower() == ".json":
                raise InputError(f"{path}: is not valid JSON ({error}); {MEND}") from None
    lines = [line.strip() for line in content.splitlines() if line.strip() and line.strip()[0] not in "#;"]
    if lines and all(re.fullmatch(r"[A-Za-z_][\w.]*\s*=.*", line) for line in lines):  # INI without a section
        return _ini(f"[camera]\n{content}", path)
    tree = _yaml(content, path)
    if not isinstance(tree, dict | list) or (isinstance(tree, list) and not any(isinstance(i, dict) for i in tree)):
        raise InputError(f"{path}: holds no `key: value` pairs; {MEND}")
    return tree


def parse_npz(path: Path) -> dict[str, Any]:
    """The arrays of an NPZ file as lists, as OpenCV scripts save them (`mtx`, `dist`).

    Raises:
        InputError: not such a file, or it holds more than arrays.
    """
    try:
        # the corners of a calibration's pictures lie beside the camera, so large arrays are no fault
        return {name: values.tolist() for name, values in read_npz(path).items() if values.size <= 32}
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as NPZ ({str(error)[:80]}); {MEND}") from None


def _yaml(content: str, path: Path) -> Any:
    # OpenCV's FileStorage starts with "%YAML:1.0" and tags matrices, neither of which is YAML 1.1; it also takes
    # tabs, and a key without a space after its colon
    content = re.sub(r"^%YAML.*$", "", content, flags=re.MULTILINE)
    content = re.sub(r"!!(?:opencv-[\w-]+|python/tuple|float|map)", "", content).replace("\t", "  ")
    content = re.sub(r"^(\s*[A-Za-z_][\w.]*):(?=[-+.\d\[])", r"\1: ", content, flags=re.MULTILINE)
    try:
        return load_yaml(content)
    except ValueError as error:
        raise InputError(f"{path}: is not valid YAML ({error}); {MEND}") from None


def _ini(content: str, path: Path) -> dict[str, Any]:
    """Sections as mappings; ZED keeps a camera per resolution (`LEFT_CAM_HD`), MRPT one per eye."""
    parser = configparser.ConfigParser(interpolation=None, strict=False, inline_comment_prefixes=("#", ";", "//"))
    try:
        parser.read_string(content)
    except configparser.Error as error:
        raise InputError(f"{path}: is not valid INI ({' '.join(str(error).split())[:120]}); {MEND}") from None
    tree: dict[str, Any] = {name: dict(parser[name]) for name in parser.sections()}
    sizes = {
        "2k": (2208, 1242),
        "fhd": (1920, 1080),
        "fhd1200": (1920, 1200),
        "hd": (1280, 720),
        "hd1200": (1920, 1200),
        "hd1080": (1920, 1080),
        "qhdplus": (3200, 1800),
        "4k": (3840, 2160),
        "svga": (960, 600),
        "vga": (672, 376),
    }
    for name, section in list(tree.items()):
        match = re.fullmatch(r"(LEFT|RIGHT)_CAM_(\w+)", name, re.IGNORECASE)
        if match is None:
            continue
        lens = f"{match.group(1)}_DISTO"
        if not any(key in section for key in ("k1", "k2")) and lens in tree:
            section.update({key: value for key, value in tree[lens].items() if key not in section})
        if match.group(2).lower() in sizes:
            section["width"], section["height"] = sizes[match.group(2).lower()]
    return tree


def _xml(content: str, path: Path) -> Any:
    """OpenCV's FileStorage, and Metashape's camera calibration."""
    try:
        root = load_xml(content)
    except ValueError as error:
        raise InputError(f"{path}: is not valid XML ({error}); {MEND}") from None
    metashape = root if root.tag == "calibration" else root.find(".//calibration")
    if metashape is not None:
        try:
            return _metashape({child.tag: (child.text or "").strip() for child in metashape})
        except (KeyError, ValueError) as error:
            raise InputError(f"{path}: as a Metashape calibration: {error}; {MEND}") from None
    return _element(root, path)


def _element(element: Any, path: Path, depth: int = 0) -> Any:
    if depth > _MAX_DEPTH:
        raise InputError(f"{path}: is nested too deeply for a calibration; {MEND}")
    children = list(element)
    if not children:
        return (element.text or "").strip()
    return {child.tag: _element(child, path, depth + 1) for child in children}


def _metashape(values: dict[str, str]) -> dict[str, Any]:
    """Offsets of the principal point from the picture's middle, and p1 and p2 in the other order than OpenCV."""
    kind = values.pop("projection", "frame")
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise ValueError(f"projection {kind} is not supported; undistort the images first")
    width, height = int(values.pop("width")), int(values.pop("height"))
    number = {name: float(text) for name, text in values.items() if re.fullmatch(r"f|c[xy]|b\d|k\d|p\d", name)}
    if "f" not in number:
        raise ValueError("has no focal length `f`")
    focal = number.pop("f")
    for name in ("b2", "k5", "p3", "p4", *(("k4",) if kind == "frame" else ("p1", "p2"))):
        if number.pop(name, 0.0):
            raise ValueError(f"{name} is not supported; export with {name} fixed at 0, or undistort the images")
    camera = {
        "width": width,
        "height": height,
        "fx": focal + number.pop("b1", 0.0),
        "fy": focal,
        "cx": width / 2 + number.pop("cx", 0.0) - 0.5,
        "cy": height / 2 + number.pop("cy", 0.0) - 0.5,
    }
    if kind == "frame":
        order = ("k1", "k2", "p2", "p1", "k3")
        return {**camera, "distortion": [number.get(name, 0.0) for name in order]}
    return {**camera, "model": "fisheye", "distortion": [number.get(f"k{i}", 0.0) for i in (1, 2, 3, 4)]}
