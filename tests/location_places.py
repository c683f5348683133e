"""Locations for tests: in memory, and on an S3 server of our own where one is installed."""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from improvo import locations
from improvo.locations import place

fsspec = pytest.importorskip("fsspec", reason="locations need the extra `remote`")

BUCKET = "improvo-test"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for what stands for locations, and no waiting between tries."""
    monkeypatch.setenv("IMPROVO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(place, "_WAITS", (0.0, 0.0))
    locations._places.clear()
    yield tmp_path / "cache"
    locations._places.clear()


@pytest.fixture
def memory() -> Iterator[str]:
    """A location in memory, empty."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield "memory://bucket/work"
    system.store.clear()


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """A location on an S3 server of our own."""
    for name in ("moto", "s3fs", "flask"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"needs an S3 server: pip install 'moto[server]' s3fs ({name} is missing)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    keys = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
    keys["AWS_ENDPOINT_URL"] = keys["AWS_ENDPOINT_URL_S3"] = f"http://127.0.0.1:{port}"
    before = {name: os.environ.get(name) for name in keys}
    os.environ.update(keys)
    try:
        ends = time.monotonic() + 120
        while time.monotonic() < ends:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        fsspec.filesystem("s3").mkdir(BUCKET)
        yield f"s3://{BUCKET}/work"
    finally:
        server.terminate()
        server.wait()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def names(url: str) -> set[str]:
    """Of the files at a location."""
    system, root = fsspec.core.url_to_fs(url)
    system.invalidate_cache()
    return {name.removeprefix(root).lstrip("/") for name in system.find(root)}


def upload(folder: Path, url: str) -> None:
    system, root = fsspec.core.url_to_fs(url)
    for path in folder.rglob("*"):
        if path.is_file():
            system.pipe_file(f"{root}/{path.relative_to(folder).as_posix()}", path.read_bytes())


def forget(cache: Path) -> None:
    """As on another machine."""
    locations._places.clear()
    shutil.rmtree(cache)
