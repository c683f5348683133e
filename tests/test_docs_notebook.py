"""The notebook runs from its first cell to its last, and what it prints makes sense."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "tour.ipynb"


def test_the_tour_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], len({cell["id"] for cell in notebook["cells"]})) == (4, len(notebook["cells"]))
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert not cell["outputs"], "keep the notebook without outputs"
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    said = capsys.readouterr().out
    tracked = re.search(r"(\d+) of 60 frames have a pose", said)
    assert tracked is not None
    assert int(tracked[1]) > 50
    error = re.search(r"error of the positions: ([\d.]+) %", said)
    assert error is not None
    assert float(error[1]) < 2.0
    assert re.search(r"'stable': [1-9]\d+, 'unstable': [1-9]", said)
    assert (tmp_path / "tour" / "run.json").is_file()
