"""Files that say they are large are refused in one line before memory is taken for them (tests/bombs.py)."""

from __future__ import annotations

import bz2
import json
import os
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import pytest

from bombs import BOMBS
from fuzz_targets import targets
from improvo.errors import InputError
from improvo.sequences import open_sequence
from improvo.untrusted.decompression import decompress
from improvo.untrusted.limits import MIN_FILE_GROWTH

HERE = Path(__file__).parent
SECONDS, MEGABYTES = 30, 700  # of one file; the second leaves room for the libraries that it loads


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What came of each bomb, in a process that may have four gigabytes."""
    folder = tmp_path_factory.mktemp("bombs")
    program = f"ulimit -v 4000000; exec {sys.executable} {HERE / 'bombs.py'} {folder}"
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent / "src"), str(HERE)])}
    done = subprocess.run(["bash", "-c", program], env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return {row["name"]: row for row in map(json.loads, done.stdout.splitlines())}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits memory as POSIX does")
@pytest.mark.parametrize("name", BOMBS)
def test_a_file_that_says_it_is_large(outcomes: dict[str, dict[str, Any]], name: str) -> None:
    row = outcomes[name]
    if row["said"] == "left out":
        pytest.skip(row["foreign"])
    assert not row["foreign"]
    assert "\n" not in row["said"]
    assert row["said"] != "read" or name.startswith("sens-")  # frames of it are left out, and counted
    assert row["seconds"] < SECONDS
    assert row["megabytes"] < MEGABYTES


@pytest.mark.parametrize(
    ("make", "pack"), [(bz2.BZ2Decompressor, bz2.compress), (zlib.decompressobj, zlib.compress)], ids=["bz2", "zlib"]
)
def test_decompression_has_a_limit(make: Any, pack: Any) -> None:
    packed = pack(bytes(5000))
    assert decompress(make, packed + packed, 10_000) == bytes(10_000)
    with pytest.raises(ValueError, match="more than 9999"):
        decompress(make, packed + packed, 9_999)
    with pytest.raises(ValueError, match="cut short"):
        decompress(make, packed[:-3], 10_000)


def test_chunks_of_bags_are_unpacked_with_it() -> None:
    reader = pytest.importorskip("rosbags.rosbag1.reader")
    mcap = pytest.importorskip("rosbags.rosbag2.storage_mcap")
    from improvo.sequences.ros_topics import _bound_decompressors

    _bound_decompressors()
    _bound_decompressors()
    packed = bz2.compress(bytes(1000))
    assert reader.decompressors["bz2"](packed) == bytes(1000)
    for unpack in (reader.decompressors["bz2"], reader.decompressors["lz4"]):
        assert unpack.func is decompress
    compression = pytest.importorskip("lz4.frame")
    assert mcap.DECOMPRESSORS["lz4"](compression.compress(bytes(99)), 99) == bytes(99)


def test_a_bag_that_is_packed_as_a_file_is_unpacked_with_a_limit(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra `ros`")
    try:
        from compression import zstd
    except ImportError:
        zstd = pytest.importorskip("backports.zstd")
    packed = targets()["packed/packed.db3.zstd"].write(tmp_path)
    assert len(open_sequence(packed.parent, camera="90,91,47,36.5")) == 3
    packed.write_bytes(zstd.compress(bytes(MIN_FILE_GROWTH + 1)))
    assert packed.stat().st_size < 10_000
    with pytest.raises(InputError, match=f"unpacks to more than {MIN_FILE_GROWTH} bytes"):
        open_sequence(packed.parent, camera="90,91,47,36.5")
