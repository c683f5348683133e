"""The command line as a whole: one table, help with defaults, presets, manners, and nothing made before a look."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from improvo import config, terminal
from improvo.cli.commands import COMMANDS, leaves, settings_class
from improvo.cli.flags import comments
from improvo.cli.main import main
from improvo.depth.run_settings import DenseRunSettings
from improvo.files import make_output_folder
from improvo.simulation import bundled_sequence

ALL = [words for words, _ in leaves()]
WITH_PAPER = [["run"], ["label"], ["improve"], ["evaluate", "pose"], ["evaluate", "vo"]]
WITH_PAPER += [["train", stage] for stage in ("shapes", "homographies", "odometry")]


@functools.cache
def help_of(words: tuple[str, ...]) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit) as end:
        main([*words, "--help"])
    assert end.value.code == 0
    return text.getvalue()


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_help_of_every_command(words: tuple[str, ...]) -> None:
    text = " ".join(help_of(words).split())
    assert f"usage: improvo {' '.join(words)}" in text
    assert "(default: None)" not in text
    assert not re.search(r"\(default: [^)]*\)[^-]{0,3}\(default", text)
    assert "--quiet" in text


def test_help_loads_nothing_heavy_and_lists_every_command() -> None:
    program = (
        "import atexit, sys; from improvo.cli.main import main; "
        "atexit.register(lambda: print(*sorted(sys.modules), file=sys.stderr)); main(['--help'])"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(shown.stderr.split())
    assert "argparse" in loaded
    assert not loaded & {"numpy", "cv2", "numba", "pyarrow", "yaml", "torch", "openvino"}  # help is there at once
    assert all(f"\n    {verb}" in shown.stdout for verb in COMMANDS)
    for verb, command in COMMANDS.items():
        assert all(f"\n    {part}" in help_of((verb,)) for part in command.parts), verb


@pytest.mark.parametrize("words", WITH_PAPER, ids=" ".join)
def test_paper_is_a_preset_of_every_step_of_the_paper(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "--preset {paper}" in help_of(tuple(words))
    assert main(["config", "-".join(words), "--preset", "paper"]) == 0
    paper = yaml.safe_load(capsys.readouterr().out)
    assert main(["config", "-".join(words)]) == 0
    assert paper != yaml.safe_load(capsys.readouterr().out)
    for section in ("odometry",):
        if section in paper:
            assert "paper" in paper[section].values()


def test_flags_settings_and_files_go_over_a_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.yaml").write_text("labels: {min_observations: 7}\n")
    words = ["--preset", "paper", "--config", str(tmp_path / "c.yaml"), "--set", "odometry.seed=3"]
    assert main(["config", "run", *words]) == 0
    settings = yaml.safe_load(capsys.readouterr().out)
    assert settings["labels"]["min_observations"] == 7
    assert settings["labels"]["quality"]["enabled"] is False
    assert settings["odometry"]["seed"] == 3
    assert main(["config", "run", "--preset", "papyrus"]) == 2
    assert "choose paper" in capsys.readouterr().err


@pytest.mark.parametrize("words", [words for words, leaf in leaves() if leaf.settings], ids=" ".join)
def test_printed_settings_are_the_defaults_with_their_meaning(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "-".join(words)]) == 0
    file = tmp_path / "settings.yaml"
    file.write_text(capsys.readouterr().out)
    cls = settings_class(dict(leaves())[words].settings)
    assert config.load(cls, file) == cls()
    assert "#" in file.read_text()


def test_comments_of_fields_are_their_help() -> None:
    from improvo.training.settings import OptimiserSettings

    found = comments(OptimiserSettings)
    assert set(found) == {field.name for field in dataclasses.fields(OptimiserSettings)}
    assert found["clip_norm"] == "largest L2 norm of the gradient"
    assert found["precision"] == "auto | float32 | bfloat16"


@pytest.mark.parametrize(
    "words", [words for words in ALL if words not in (("demo",), ("config",), ("completion",))], ids=" ".join
)
def test_nothing_is_made_where_the_input_is_missing(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    needed = {
        ("train", "shapes"): 0,
        ("evaluate", "trajectory"): 2,
        ("evaluate", "stability"): 2,
        ("weights", "calibrate"): 2,
        ("simulate",): 0,
    }
    inputs = [f"missing{i}" for i in range(needed.get(words, 1))]
    output = ["-o", "new/out" if words[0] not in ("weights", "export") else "out"]
    if words[0] == "show" or words in (("report",), ("info",)):
        output = []
    if words == ("weights", "show"):
        output = []
    if words in (("export", "features"), ("weights", "export")):
        output += ["--layout", "hloc" if words[0] == "export" else "original"]
    if words == ("simulate",):
        output += ["--size", "huge"]
    if words[:1] == ("train",):
        output += ["--from", "nobody.safetensors"]
    assert main([*words, *inputs, *output]) == 2
    message = capsys.readouterr().err.strip().splitlines()
    assert len(message) == 1
    assert message[0].startswith("improvo: ")
    assert list(tmp_path.iterdir()) == []


def test_json_is_all_that_is_printed(finished_run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["run", str(bundled_sequence()), "-o", str(tmp_path / "out"), "--frontend", "orb", "--max-frames", "12"]
    assert main([*words, "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["frames"]["processed"] == 12
    assert main([*words, "--quiet"]) == 0
    shown = capsys.readouterr()
    assert shown.out + shown.err == ""
    assert main(words) == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines()[-1].startswith("next: ")
    assert "\r" not in shown.err
    assert "\x1b" not in shown.out + shown.err  # no colours, with or without NO_COLOR


def test_commands_that_end_in_figures_print_them_as_json(
    finished_run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = str(finished_run / "trajectory.txt")
    assert main(["evaluate", "trajectory", str(finished_run), truth, "-o", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["protocol"] == "trajectory"
    assert main(["evaluate", "trajectory", str(finished_run), str(finished_run), "--json"]) == 0  # one run by another
    found = json.loads(capsys.readouterr().out)
    assert found["ate_percent"] == pytest.approx(0, abs=1e-9)
    assert "is a run, no ground truth" in found["notes"][0]
    room = str(tmp_path / "room")
    assert main(["simulate", "-o", room, "--frames", "2", "--size", "64x48", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) | {"fov": 62.0} == {
        "folders": [room], "frames": 2, "width": 64, "height": 48, "fps": 30.0, "fov": 62.0, "seed": 0,
    }  # fmt: skip
    monkeypatch.chdir(tmp_path)
    make_output_folder(tmp_path / "demo", "demo")  # as `improvo demo -o demo` does; it is no recording
    assert main(["info", "demo"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "next: `improvo run demo -o out`"
    assert main(["evaluate", "trajectory", str(finished_run), truth, "--quiet"]) == 0
    assert "Absolute trajectory" in capsys.readouterr().out
    for words, command in leaves():
        assert ("--json" in help_of(words)) == command.figures


def test_progress_is_a_line_now_and_then_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "INTERVAL", 0.0)
    with terminal.progress("label", "frame", 4) as shown:
        shown.advance()  # the time until here is that of loading, and tells nothing
        shown.advance(2)
        shown.note("no pose yet")
        shown.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "label: 1 of 4 frames (25 %)"
    assert lines[1].startswith("label: 3 of 4 frames (75 %), ")
    assert lines[1].endswith("left")
    assert lines[2].endswith("; no pose yet")
    with terminal.quiet(), terminal.progress("label", "frame", 4) as shown:
        shown.advance(4)
    assert capsys.readouterr().err == ""


def test_the_stages_of_a_second_recording_begin_anew(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "INTERVAL", 0.0)
    with terminal.stages("step") as told:
        for _ in ("attic", "hall"):
            for done in (1, 2, 3):
                told("keypoints", done, 3)
            told("adjusting", 2, 2)
    said = [line.partition(" step")[0] for line in capsys.readouterr().err.splitlines()]
    assert said == [*("keypoints: 1 of 3", "keypoints: 2 of 3", "keypoints: 3 of 3", "adjusting: 2 of 2")] * 2


def test_settings_of_a_network_reach_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", str(bundled_sequence()), "-o", str(tmp_path / "out"), "--max-frames", "4"]
    network = ["--frontend", "superpoint-small", "--precision", "float32", "--threshold", "0.02"]
    assert main([*words, *network, "--set", "frontend.network.threads=1"]) == 0
    configuration = json.loads((tmp_path / "out" / "run.json").read_text())["configuration"]
    assert configuration["frontend"]["network"]["precision"] == "float32"
    assert configuration["frontend"]["network"]["threshold"] == 0.02
    assert config.from_dict(DenseRunSettings, configuration).frontend.network.threads == 1
    assert main([*words, "--frontend", "orb", "--precision", "float32"]) == 2
    assert "not a network" in capsys.readouterr().err


def test_a_run_without_any_pose_says_so_and_ends_with_status_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", str(bundled_sequence()), "-o", str(tmp_path / "out"), "--frontend", "orb", "--max-frames", "3"]
    assert main(words) == 3
    *_, why, last = capsys.readouterr().out.splitlines()
    assert why.startswith("no frame has a pose: ")
    assert last.startswith("next: `improvo info ")
    assert (tmp_path / "out" / "run.json").is_file()


@pytest.mark.parametrize(
    "words",
    [["run", "demo", "--frontend"], ["label", "demo", "--frontend"], ["improve", "demo", "--frontend"]],
    ids=lambda words: words[0],
)
def test_an_unknown_frontend_is_refused_before_any_work(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").write_text("no video at all")  # what is wrong with the recording would be found later
    for name, message in (("nobody", "unknown; choose among"), ("absent.safetensors", "no such weights file")):
        assert main([*words, name, "-o", "out"]) == 2
        shown = capsys.readouterr()
        assert message in shown.err
        assert len(shown.err.splitlines()) == 1
        assert shown.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


def test_one_is_singular() -> None:
    assert [terminal.counted(count, "frame") for count in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_know_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab", reason="needs shtab: pip install 'improvo[completion]'")
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for words, _ in leaves():
        assert all(word in script for word in words), words
    assert "loop" in script


def test_bash_completes_commands_options_and_choices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab", reason="needs shtab: pip install 'improvo[completion]'")
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "improvo.bash"
    script.write_text(capsys.readouterr().out)
    for line, expected in (
        (["improvo", "evalu"], "evaluate"),
        (["improvo", "export", "feat"], "features"),
        (["improvo", "run", "x", "--front"], "--frontend"),
        (["improvo", "weights", "export", "superpoint", "--layout", ""], "original"),
    ):
        words = " ".join(f"'{word}'" for word in line)
        program = (
            f"source {script}; COMP_WORDS=({words}); COMP_CWORD={len(line) - 1}; "
            "$(complete -p improvo | sed 's/.*-F \\([^ ]*\\).*/\\1/'); echo \"${COMPREPLY[@]}\""
        )
        found = subprocess.run([bash, "-c", program], capture_output=True, text=True, check=True).stdout.split()
        assert expected in found, (line, found)


def test_waiting_threads_give_the_processor_back_unless_the_user_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for given, policy in ((None, "PASSIVE"), ("ACTIVE", "ACTIVE")):
        monkeypatch.setenv("OMP_WAIT_POLICY", given or "")
        if given is None:
            monkeypatch.delenv("OMP_WAIT_POLICY")
        with pytest.raises(SystemExit):
            main(["--version"])
        assert os.environ["OMP_WAIT_POLICY"] == policy
