"""Files on which a parser once failed, read again; and a few seeds of the fuzzer for each parser."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from fuzz_targets import EXPECTED, Target, targets
from mutations import mutated

CORPUS = Path(__file__).parent / "corpus"
TARGETS = targets()
SEEDS = 6


def read_damaged(target: Target, path: Path, content: bytes) -> None:
    """It is read, or refused in one line."""
    path.write_bytes(content)
    said = ""
    try:
        target.read(path)
    except EXPECTED as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize("file", sorted(CORPUS.glob("*--*")), ids=lambda file: file.name)
def test_a_file_that_once_failed(tmp_path: Path, file: Path) -> None:
    target = TARGETS[file.name.rpartition("--")[0].replace("+", "/")]
    read_damaged(target, target.write(tmp_path), file.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_a_valid_example_and_a_few_damaged_ones(tmp_path: Path, name: str) -> None:
    target = TARGETS[name]
    path = target.write(tmp_path)
    content = path.read_bytes()
    target.read(path)
    for seed in range(SEEDS):
        read_damaged(target, path, mutated(content, random.Random(seed), target.text))


def test_damage_depends_on_the_seed_alone() -> None:
    content = bytes(range(200))
    assert mutated(content, random.Random(3), False) == mutated(content, random.Random(3), False)
    assert len({mutated(content, random.Random(seed), False) for seed in range(50)}) > 40
