"""From what a user gives as --camera, or what lies in a recording's folder, to a calibration."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from improvo.errors import InputError
from improvo.geometry.camera_files import colmap
from improvo.geometry.camera_files.calibration import MEND, Calibration, from_numbers
from improvo.geometry.camera_files.containers import parse_npz, parse_tree
from improvo.geometry.camera_files.plain_text import from_plain_text, is_plain
from improvo.geometry.camera_files.tree import cameras
from improvo.geometry.text_files import read_text
from improvo.untrusted.paths import check_is_file, check_path, is_file

IN_FOLDERS = ("camera.yaml", "camera.yml", "camera.json", "camera.txt")
_UNSAFE = (".pkl", ".pickle", ".npy", ".mat", ".m", ".py", ".sfm")


def load_calibration(text: str, camera: str | None = None) -> Calibration:
    """A calibration from `fx,fy,cx,cy[,...]` or from a file in any notation that docs/cameras.md lists.

    Args:
        text: numbers, or the path of a file, with `#NAME` to choose one of several cameras in it; or of a folder with
            COLMAP's cameras or a `camera.yaml`.
        camera: which camera of a file with several (`cam0`, COLMAP's id, `LEFT_CAM_HD`); None is the first.

    Raises:
        InputError: no such file, not a calibration, a value that cannot be, or a key that could be distortion, a model
            or a size and is not understood.
    """
    if re.fullmatch(r"[\s\d.,;eE+-]+", text) and re.search(r"[,;\s]", text.strip()) and not os.path.isfile(text):
        return from_numbers(text)
    path = check_path(Path(text))
    if not path.exists() and "#" in text:
        name, _, camera = text.rpartition("#")
        path = Path(name)
    if path.is_dir():
        path = _in_folder(path)
    if not path.is_file():
        raise InputError(f"--camera {text}: no such file; {MEND}")
    with _one_line(str(path)):
        return _read(path, camera)


def camera_of(content: dict[str, Any], source: str) -> Calibration:
    """The calibration that one camera's keys say, in any notation: a `camera_info`, a frame of `transforms.json`.

    Args:
        content: the keys and values.
        source: the file, for messages.

    Raises:
        InputError: as `load_calibration`.
    """
    with _one_line(source):
        return cameras(content, source, None)


def folder_calibration(folder: Path, names: tuple[str, ...] = IN_FOLDERS) -> Calibration | None:
    """The calibration that lies in a recording's folder, None without one.

    Raises:
        InputError: it lies there and cannot be used.
    """
    for name in names:
        if is_file(folder / name):
            return load_calibration(str(folder / name))
    return None


def _read(path: Path, camera: str | None) -> Calibration:
    source = str(path)
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return colmap.from_binary(_bytes(path), source, camera)
    if suffix == ".npz":
        return cameras(parse_npz(path), source, camera)
    if suffix in _UNSAFE:
        raise ValueError(f"a {suffix} file is not read; {MEND}")
    content = read_text(path, "a calibration", MEND)
    if is_plain(content):
        return from_plain_text(content, source, camera)
    if suffix == ".txt" and ":" not in content and "=" not in content and "<" not in content:
        return from_plain_text(content, source, camera)
    return cameras(parse_tree(content, path), source, camera)


@contextmanager
def _one_line(source: str) -> Iterator[None]:
    """Errors of reading as one line that names the file."""
    try:
        yield
    except KeyError as error:
        raise InputError(f"{source}: has no {error.args[0]}; {MEND}") from None
    except (ValueError, TypeError, IndexError, AttributeError, ArithmeticError, RecursionError) as error:
        reason = " ".join(str(error).split())
        if re.search(r"no number but|invalid literal|could not convert|object|attribute|index", reason):
            reason = f"a value is not what it should be ({reason})"
        raise InputError(f"{source}: {reason}" + ("" if ";" in reason else f"; {MEND}")) from None


def _in_folder(folder: Path) -> Path:
    """The calibration in a folder: improvo's, or COLMAP's of a model."""
    for place in (folder, folder / "sparse" / "0", folder / "sparse", folder / "0"):
        for name in ("cameras.bin", "cameras.txt", *IN_FOLDERS):
            if (place / name).is_file():
                return place / name
    raise InputError(
        f"--camera {folder}: is a folder without cameras.bin, cameras.txt, camera.yaml or a file with the name of the "
        "recording (NAME.yaml); give the calibration file"
    )


def _bytes(path: Path) -> bytes:
    try:
        return check_is_file(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
