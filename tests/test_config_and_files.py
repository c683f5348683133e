"""Settings refuse what they do not know; files are whole or absent."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from improvo import config, files
from improvo.cli.main import main
from improvo.cli.options import add_config_arguments, add_sequence_arguments, settings_from
from improvo.depth.run_settings import DenseRunSettings
from improvo.errors import ConfigError, OutputError
from improvo.files import (
    MARKER,
    check_output_file,
    check_output_folder,
    make_output_folder,
    write_json,
    write_text,
    written_atomically,
)
from improvo.odometry.scale.settings import scale_settings
from improvo.sequences.settings import InfoSettings


@dataclass(frozen=True)
class Inner:
    width: float = 1.5
    names: tuple[str, ...] = ("a",)


@dataclass(frozen=True)
class Outer:
    count: int = 3
    label: str | None = None
    inner: Inner = field(default_factory=Inner)


def test_defaults_then_file_then_overrides(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text("count: 5\ninner:\n  width: 2\n")
    settings = config.load(Outer, path, ["inner.width=4", "inner.names=[x, y]", "label=home"])
    assert settings == Outer(5, "home", Inner(4.0, ("x", "y")))
    assert config.load(Outer, None, ["inner.width=3e-4"]).inner.width == 3e-4


def test_a_section_given_in_part_keeps_the_defaults_of_its_place() -> None:
    @dataclass(frozen=True)
    class Special:
        inner: Inner = field(default_factory=lambda: Inner(width=9.0))

    assert config.load(Special, None, ["inner.names=[z]"]) == Special(Inner(9.0, ("z",)))


def test_what_is_printed_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    settings = Outer(7, "there", Inner(0.25, ("p", "q")))
    path.write_text(config.to_yaml(settings))
    assert config.load(Outer, path) == settings


WORDS = (
    " ".join(["my recordings of the summer"] * 20),
    "été " * 40,
    "a\nb",
    "a\n...\n",
    'it\'s "so" \\ : # {',
    "\udc80",
    "",
    "1e5",
    "null",
)


@pytest.mark.parametrize("value", [*WORDS, list(WORDS), [0.25] * 60, 0.1, True, None, [["a\nb", 1]]])
def test_a_value_of_any_length_is_one_line_and_read_back(value: object) -> None:
    line = config.yaml_line(value)
    assert len(line.splitlines()) == 1
    assert config.load_yaml(line) == value


@pytest.mark.parametrize("word", WORDS[:-3])
def test_a_flag_gives_its_setting_the_word_that_was_typed(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A long path with spaces was cut off at its first 80 letters, and one with accents was refused."""
    parser = argparse.ArgumentParser()
    add_sequence_arguments(parser)
    add_config_arguments(parser)
    assert settings_from(InfoSettings, parser.parse_args(["--mask", word])).sequence.mask == word
    assert main(["config", "info", "--set", f"sequence.mask={config.yaml_line(word)}"]) == 0
    printed = tmp_path / "info.yaml"
    printed.write_text(capsys.readouterr().out, encoding="utf-8")
    assert config.load(InfoSettings, printed).sequence.mask == word
    scale = config.load(DenseRunSettings, None, scale_settings([["truth", word]]))
    assert scale.scale.reference == word


def test_settings_under_their_former_names_are_read(tmp_path: Path) -> None:
    from improvo.odometry.run_settings import RunSettings
    from improvo.odometry.settings import OdometrySettings

    path = tmp_path / "settings.yaml"
    path.write_text(
        "odometry:\n  initialisation: paper\n  trust:\n    least_stability: 0.25\n  matching:\n    max_stray: 0.1\n"
    )
    odometry = config.load(RunSettings, path, ["odometry.matching.max_stray=0.2"]).odometry
    assert (odometry.mode, odometry.ransac_gate.least_stability) == ("paper", 0.25)
    assert odometry.matching.flow_outlier_limit == 0.2
    assert config.load(RunSettings, path, ["odometry.mode=robust"]).odometry.mode == "robust"
    assert config.from_dict(OdometrySettings, {"initialisation": "paper"}).mode == "paper"


@pytest.mark.parametrize("name", ["health.rounds", "start.min_matches", "solver.max_iterations", "window.max_error"])
def test_a_setting_that_is_none_any_more_is_named_in_one_line(name: str) -> None:
    from improvo.odometry.run_settings import RunSettings

    with pytest.raises(ConfigError, match="leave it out") as raised:
        config.load(RunSettings, None, [f"odometry.{name}=3"])
    assert name.split(".")[0] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_every_former_name_leads_to_a_setting() -> None:
    from improvo.improvement.settings import ImproveSettings
    from improvo.odometry.settings import OdometrySettings
    from improvo.stability.settings import LabelSettings
    from improvo.training.settings import PairSettings

    every = {"odometry": OdometrySettings(), "labels": LabelSettings(), "improve": ImproveSettings()}
    every |= {"pairs": PairSettings()}
    now = {name: config.to_dict(settings) for name, settings in every.items()}
    now |= {name: value for name, value in now["odometry"].items() if isinstance(value, dict)}
    for section, names in config.FORMER_NAMES.items():
        for former, present in names.items():
            assert present in now[section]
            assert former not in now[section]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("inner.widht=2", "inner.width"),
        ("cuont=2", "count"),
        ("count=many", "many"),
        ("count=2.5", "2.5"),
        ("count=true", "True"),
        ("inner=3", "inner"),
        ("count", "section.name=value"),
        ("count.more=1", "count"),
    ],
)
def test_mistakes_are_named(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        config.load(Outer, None, [override])


def test_a_file_that_is_no_settings_file_is_named(tmp_path: Path) -> None:
    for text in ("- a list\n", "key: [unclosed\n"):
        (tmp_path / "bad.yaml").write_text(text)
        with pytest.raises(ConfigError, match=r"bad\.yaml"):
            config.load(Outer, tmp_path / "bad.yaml")
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        config.load(Outer, tmp_path / "none.yaml")


def test_a_failed_write_leaves_the_old_file_and_no_temporary(tmp_path: Path) -> None:
    path = tmp_path / "result.txt"
    write_text(path, "old")

    def fail_half_way() -> None:
        with written_atomically(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["result.txt"]


@pytest.mark.parametrize("name", ["厨" * 80 + ".txt", "\udcff" * 100 + ".txt", "a" * 251 + ".txt"])
def test_a_name_as_long_as_the_system_takes_is_written(tmp_path: Path, name: str) -> None:
    write_text(tmp_path / name, "here")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert files._TEMPORARY.fullmatch(files.temporary_name(name, ".txt"))  # is cleared where its process was killed


def test_json_never_holds_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", {"a": float("nan")})
    assert not list(tmp_path.iterdir())


def test_our_own_folder_may_be_written_again_and_no_other(tmp_path: Path) -> None:
    ours = tmp_path / "ours"
    make_output_folder(ours, "run")
    make_output_folder(ours, "run")
    assert (ours / MARKER).exists()
    with pytest.raises(OutputError, match="improvo run"):
        check_output_folder(ours, "label")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        check_output_folder(tmp_path / "file", "run")


def test_a_file_that_cannot_be_written_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("x")
    check_output_file(tmp_path / "new" / "camera.yaml")
    check_output_file(tmp_path / "file")
    assert not (tmp_path / "new").exists()
    for path, said in (
        (tmp_path, "is a folder"),
        (Path(), "is a folder"),
        (tmp_path / "file" / "camera.yaml", "is a file, not a folder"),
        (tmp_path / ("x" * 300), "too long"),
    ):
        with pytest.raises(OutputError, match=said):
            check_output_file(path)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(OutputError, match="no permission"):
        check_output_file(tmp_path / "camera.yaml")


@pytest.mark.parametrize(
    "words",
    [["calibrate", "demo", "-o", "package.yaml"], ["truth", "demo", "-o", "package.txt"]],
)
def test_what_is_written_beside_a_file_does_not_replace_what_is_of_others(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if words[0] == "truth":
        pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[truth]'")
    monkeypatch.chdir(tmp_path)
    Path("package.json").write_text("{}")
    assert main(words) == 2
    assert "package.json: exists, and would be replaced, too" in capsys.readouterr().err
    assert Path("package.json").read_text() == "{}"


def test_calibrate_looks_at_its_output_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from improvo.cli.main import main

    assert main(["calibrate", str(tmp_path / "missing.mp4"), "-o", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
