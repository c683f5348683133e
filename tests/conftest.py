"""Fixtures that several test files share."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real sequences beside the project; tests that need it skip where it is absent."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip("needs the real sequences in ../shared/data, which are not part of the project")
    return folder


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a real `improvo run` over 30 pictures of a textured room; not to be written to."""
    from rendered_walk import write_walk

    from improvo.cli.main import main

    folder = tmp_path_factory.mktemp("finished")
    walk = write_walk(folder / "walk", frames=30)
    assert main(["run", str(walk), "-o", str(folder / "out"), "--frontend", "orb", "--max-keypoints", "400"]) == 0
    return folder / "out"


@pytest.fixture(scope="session")
def long_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `finished_run`, of 230 frames: the recorder writes its tables in more than one part. Not to be written to."""
    from rendered_walk import write_walk

    from improvo.cli.main import main

    folder = tmp_path_factory.mktemp("long")
    pictures = sorted(write_walk(folder / "walk", frames=24).glob("*.png"))
    there_and_back = [*pictures, *reversed(pictures)] * 5
    long = folder / "long"
    long.mkdir()
    for i, path in enumerate(there_and_back[:230]):
        (long / f"{i:06d}.png").symlink_to(path)
    (long / "camera.yaml").write_bytes((folder / "walk" / "camera.yaml").read_bytes())
    assert main(["run", str(long), "-o", str(folder / "out"), "--frontend", "orb", "--max-keypoints", "150"]) == 0
    return folder / "out"
