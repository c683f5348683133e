"""Files of a later improvo are refused in a clear word, those of earlier ones are read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import InputError, OutputError
from improvo.files import MARKER, check_output_folder, make_output_folder
from improvo.formats import FORMAT, check_format
from improvo.frontend.weights_files import load_weights, save_weights
from improvo.improvement.validation import GapScores, Validation, read_validation, write_validation
from improvo.labeling.labeled import read_labels
from improvo.odometry.run.run_folder import RunFolder
from labeled_scene import write_labeled_scene
from network_examples import random_weights

LATER = f"{int(FORMAT.partition('.')[0]) + 1}.0"
LATER_WORDS = (
    r"was written by a later improvo \(format 2\.0, this one reads up to 1\.\d\); pip install --upgrade improvo"
)


@pytest.mark.parametrize("found", [None, "0.3", FORMAT, "1.999"])
def test_earlier_and_slightly_later_formats_are_read(found: str | None) -> None:
    check_format(found, Path("x"))


@pytest.mark.parametrize("found", ["", "2", "x.y", "1.0.0", 1, 1.0, [], "9" * 5000 + ".0", "\N{SUPERSCRIPT TWO}.0"])
def test_what_is_no_version_is_damage(found: object) -> None:
    with pytest.raises(InputError, match="is damaged") as raised:
        check_format(found, Path("x"))
    assert "\n" not in str(raised.value)


def set_format(file: Path, value: str | None) -> None:
    content = json.loads(file.read_text())
    content.pop("format", None)
    file.write_text(json.dumps(content if value is None else {**content, "format": value}))


def test_an_output_folder(tmp_path: Path) -> None:
    make_output_folder(tmp_path / "out", "run")
    marker = tmp_path / "out" / MARKER
    assert json.loads(marker.read_text())["format"] == FORMAT
    set_format(marker, LATER)
    before = marker.read_bytes()
    with pytest.raises(OutputError, match=LATER_WORDS):
        check_output_folder(tmp_path / "out", "run")
    with pytest.raises(OutputError, match=LATER_WORDS):
        make_output_folder(tmp_path / "out", "run")
    assert marker.read_bytes() == before
    set_format(marker, None)
    make_output_folder(tmp_path / "out", "run")


def test_a_run(finished_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in (MARKER, "run.json"):
        (folder / name).write_bytes((finished_run / name).read_bytes())
    assert RunFolder(folder).report["format"] == FORMAT
    for name in (MARKER, "run.json"):
        set_format(folder / name, None)
    assert RunFolder(folder).frames == 30
    for name in ("run.json", MARKER):
        set_format(folder / name, LATER)
        with pytest.raises(InputError, match=LATER_WORDS):
            RunFolder(folder)
        set_format(folder / name, None)


def test_the_command_line_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_output_folder(tmp_path / "out", "run")
    set_format(tmp_path / "out" / MARKER, LATER)
    assert main(["show", "map", str(tmp_path / "out")]) == 2
    assert "was written by a later improvo" in capsys.readouterr().err


def test_a_label_store(tmp_path: Path) -> None:
    store = write_labeled_scene(tmp_path / "labels")
    set_format(store / MARKER, None)
    assert len(read_labels(store)) == 1
    set_format(store / MARKER, LATER)
    with pytest.raises(InputError, match=LATER_WORDS):
        read_labels(store)


def test_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = random_weights()
    path = tmp_path / "w.safetensors"
    for written in (FORMAT, "1.7"):
        monkeypatch.setattr("improvo.frontend.weights_files.FORMAT", written)
        save_weights(path, weights.tensors, weights.card)
        assert load_weights(path).card == weights.card
    first = path.read_bytes()
    save_weights(path, weights.tensors, weights.card)
    assert path.read_bytes() == first
    monkeypatch.setattr("improvo.frontend.weights_files.FORMAT", LATER)
    save_weights(path, weights.tensors, weights.card)
    with pytest.raises(InputError, match=LATER_WORDS):
        load_weights(path)


def test_a_validation(tmp_path: Path) -> None:
    scores = GapScores("room", 0, 30, 1.0, [[0, 30]], [50], {"right_8px": [0.5]})
    labels, seconds = {"stable": 3, "unstable": 1, "ignore": 2}, {"label": 1.0, "evaluate": 2.0}
    path = tmp_path / "judgement.json"
    write_validation(path, Validation(9, 9, 1, 3.0, 0.9, 0.4, labels, (scores,), seconds=seconds))
    set_format(path, None)
    assert read_validation(path).scores == (scores,)
    set_format(path, LATER)
    with pytest.raises(InputError, match=LATER_WORDS):
        read_validation(path)
    write_validation(path, Validation(9, 0, 0, 0.0, 0.0, float("nan"), labels, (scores,), seconds=seconds))
    untracked = read_validation(path)
    assert untracked.tracked == 0
    assert np.isnan(untracked.error)


def test_a_checkpoint(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from training_examples import tiny_trainer

    tiny_trainer(tmp_path).run(progress=False)
    path = tmp_path / "checkpoint.pt"
    state = torch.load(path, weights_only=True)
    assert state.pop("format") == FORMAT
    torch.save(state, path)
    assert tiny_trainer(tmp_path).resume()
    torch.save({**state, "format": LATER}, path)
    with pytest.raises(InputError, match=LATER_WORDS):
        tiny_trainer(tmp_path).resume()
