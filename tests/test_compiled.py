"""Kernels whose machine code cannot be kept on disk, or is damaged there, are compiled again."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numba
import pytest

from improvo.compiled import compiled


def doubled(number):  # type: ignore[no-untyped-def]
    return 2 * number


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert compiled(doubled)(3) == 6
    assert len(list(tmp_path.rglob("*.nb?"))) == 2  # the index, and the code
    return tmp_path


@pytest.mark.parametrize("pattern", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize("content", [b"", b"\x80\x04garbage", None], ids=["empty", "garbage", "cut"])
def test_damaged_machine_code_is_compiled_again(cache: Path, pattern: str, content: bytes | None) -> None:
    (file,) = cache.rglob(pattern)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    assert compiled(doubled)(3) == 6
    again = compiled(doubled)
    assert again(3) == 6
    assert sum(again.stats.cache_hits.values()) == 1


def test_a_full_disk_of_the_cache_does_not_stop_the_work(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = compiled(doubled)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(kernel._cache._cache_file, "save", full)
    assert kernel(4.5) == 9.0
