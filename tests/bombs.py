"""Small files that say they are large: each is refused, or read, in little time and memory.

Run as a program: `bombs.py NAME FOLDER` makes one of them in the folder, reads it, and prints as JSON what came of it.
"""

from __future__ import annotations

import json
import resource
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from improvo import config
from improvo.continuation import SettingsRecord
from improvo.errors import ImprovoError
from improvo.evaluation.frontends.exported import _read_hdf5, _read_npz
from improvo.frontend.importing import read_public_file
from improvo.geometry.camera_files import load_calibration
from improvo.odometry.run_settings import RunSettings
from improvo.sequences import open_sequence
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import read_image
from improvo.stability.tables import read_tracks, tracks_schema

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghij", "bcdefghijk", strict=True)
)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(*sizes: tuple[int, int], extra: bytes = b"") -> bytes:
    """A PNG with a header for each size."""
    headers = b"".join(chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)) for size in sizes)
    return b"\x89PNG\r\n\x1a\n" + headers + extra + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")


def tiff(width: int, height: int) -> bytes:
    """A TIFF of one strip."""
    entries = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
    entries += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 64)]
    directory = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<I", 8) + directory + bytes(68)


def jpeg(width: int, height: int) -> bytes:
    """The frame header of a JPEG, and little more."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + bytes([1, 0x22, 0, 2, 0x11, 0, 3, 0x11, 0])
    parts = b"\xff\xc0" + struct.pack(">H", 2 + len(frame)) + frame
    return b"\xff\xd8" + parts + b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00" + bytes(50) + b"\xff\xd9"


def bitmap(width: int, height: int) -> bytes:
    """The headers of a BMP."""
    return b"BM" + struct.pack("<IHHI", 100, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, *[0] * 6)


def _picture(suffix: str, content: bytes) -> Callable[[Path], Any]:
    def read(folder: Path) -> None:
        (folder / f"x{suffix}").write_bytes(content)
        read_image(folder / f"x{suffix}")

    return read


def _sens(folder: Path, sparse: bool) -> None:
    """Depth of 16,384² from a few bytes, or three gigabytes of colour that are a hole in the file."""
    import sequence_encoders as encoders
    from fuzz_targets import scene

    path = encoders.write_sens(folder / "s.sens", scene())
    data = bytearray(path.read_bytes())
    first = data.index(struct.pack("<fQ", 1000.0, 3)) + 12
    if sparse:
        data[first + 80 : first + 96] = struct.pack("<2Q", 3 << 30, 0)
        path.write_bytes(data[: first + 96])
        with path.open("r+b") as file:
            file.truncate(first + 96 + (3 << 30))
    else:
        data[first - 12 - 8 : first - 12] = struct.pack("<2I", 16384, 16384)
        path.write_bytes(data)
    sequence = open_sequence(path)
    assert sequence.depth(0) is None
    list(sequence)


def _record3d(folder: Path) -> None:
    with zipfile.ZipFile(folder / "x.r3d", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("metadata", '{"a":[' + "[]," * 8_000_000 + "[]]}")
        file.writestr("rgbd/0.jpg", b"")
    open_sequence(folder / "x.r3d")


def _npz(folder: Path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (40000, 40000), }".ljust(117) + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    with zipfile.ZipFile(folder / "x.npz", "w") as file:
        file.writestr("keypoints.npy", array)
    _read_npz(folder / "x.npz")


def _deflated_npz(folder: Path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (200000000,), }".ljust(117) + b"\n"
    with (
        zipfile.ZipFile(folder / "x.npz", "w", zipfile.ZIP_DEFLATED) as file,
        file.open("keypoints.npy", "w") as stream,
    ):
        stream.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for _ in range(800):
            stream.write(bytes(1_000_000))
    _read_npz(folder / "x.npz")


def _hdf5(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "x.h5", "w") as file:
        file.create_dataset("a/keypoints", (10**6, 10**6), "f4", chunks=(1000, 1000))
    _read_hdf5(str(folder / "x.h5"), "a")


def _torch(folder: Path) -> None:
    import torch

    torch.save({"conv1a.weight": torch.zeros(1).expand(50_000, 50_000)}, folder / "x.pth")
    read_public_file(folder / "x.pth")


def _table(folder: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = tracks_schema()
    columns = [pa.array(np.zeros(2_000_000), pa.float64()).cast(field.type) for field in schema]
    pq.write_table(pa.table(columns, schema), folder / "tracks.parquet", compression="zstd")
    read_tracks(folder / "tracks.parquet")


def _text(name: str, content: str, read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def made(folder: Path) -> None:
        (folder / name).write_text(content)
        read(folder / name)

    return made


def _camera(path: Path) -> None:
    load_calibration(str(path))


def _settings(path: Path) -> None:
    config.load(RunSettings, path)


ENTITIES = "<!DOCTYPE x [<!ENTITY a 'xxxxxxxxxx'>" + "".join(
    f"<!ENTITY {b} '{f'&{a};' * 10}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
BOMBS: dict[str, Callable[[Path], Any]] = {
    "png": _picture(".png", png((30_000, 30_000))),
    "png-two-headers": _picture(".png", png((8, 8), (60_000, 60_000))),
    "png-of-an-animation": _picture(
        ".png",
        png(
            (8, 8),
            extra=chunk(b"acTL", struct.pack(">II", 2, 0))
            + chunk(b"fcTL", struct.pack(">IIIIIHHBB", 0, 60_000, 60_000, 0, 0, 1, 1, 0, 0)),
        ),
    ),
    "png-with-a-lying-chunk": _picture(
        ".png", png((8, 8), extra=struct.pack(">I4s", 0xFFFFFFF0, b"iCCP") + bytes(300))
    ),
    "jpeg": _picture(".jpg", jpeg(65_000, 65_000)),
    "tiff": _picture(".tif", tiff(60_000, 60_000)),
    "bmp": _picture(".bmp", bitmap(60_000, 60_000)),
    "pgm": _picture(".pgm", b"P5 60000 60000 255\n" + bytes(99)),
    "jp2": _picture(
        ".jp2", b"\xff\x4f\xff\x51" + struct.pack(">HH8I", 47, 0, *[60_000] * 2, 0, 0, *[60_000] * 2, 0, 0)
    ),
    "webp": _picture(".webp", b"RIFF\x40\0\0\0WEBPVP8X\x0a\0\0\0" + bytes(4) + b"\xff" * 6 + bytes(40)),
    "sens-depth": lambda folder: _sens(folder, sparse=False),
    "sens-hole": lambda folder: _sens(folder, sparse=True),
    "record3d": _record3d,
    "npz": _npz,
    "npz-deflated": _deflated_npz,
    "hdf5": _hdf5,
    "torch": _torch,
    "table": _table,
    "yaml-camera": _text("c.yaml", LAUGHS, _camera),
    "yaml-nested": _text("c.yaml", "a: " + "[" * 100_000, _camera),
    "yaml-itself": _text("c.yaml", "a: &a [*a]\n", _camera),
    "yaml-merged": _text("c.yaml", LAUGHS.replace("[", "{k: [").replace("]", "]}") + "z: {<<: *k}\n", _camera),
    "yaml-settings": _text("s.yaml", LAUGHS, _settings),
    "yaml-record": _text("s.yaml", LAUGHS, lambda path: SettingsRecord(path, RunSettings).difference({})),
    "json-camera": _text("c.json", "[" * 1_000_000, _camera),
    "xml-camera": _text("c.xml", f"<?xml version='1.0'?>{ENTITIES}]><x>&i;</x>", _camera),
    "xml-nested": _text("c.xml", "<a>" * 3000 + "</a>" * 3000, _camera),
}


def main(folder: Path) -> None:
    """Each bomb in turn; one line of JSON for each."""
    for name, bomb in BOMBS.items():
        (folder / name).mkdir()
        started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            bomb(folder / name)
            said, foreign = "read", ""
        except (ImprovoError, UnreadableFrameError) as error:
            said, foreign = str(error), ""
        except ImportError as error:
            said, foreign = "left out", str(error)
        except BaseException as error:
            said, foreign = "", f"{type(error).__name__}: {error}"
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
        row = {
            "name": name,
            "said": said,
            "foreign": foreign,
            "seconds": time.monotonic() - started,
            "megabytes": grown,
        }
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
