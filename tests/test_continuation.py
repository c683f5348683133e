"""Work goes on only under the settings that it was begun with; what no result depends on may differ."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml

from improvo import config
from improvo.continuation import SettingsRecord, first_difference
from improvo.errors import ConfigError, InputError

SETTINGS = {"frontend": {"name": "orb", "max_keypoints": 500}, "optimiser": {"seed": 0, "threads": 2}}


@pytest.fixture
def record(tmp_path: Path) -> SettingsRecord:
    record = SettingsRecord(tmp_path / "out" / "settings.yaml", free=["optimiser.threads"])
    record.path.parent.mkdir()
    record.check(SETTINGS, "nothing is recorded yet")
    record.write(SETTINGS)
    return record


def test_the_same_settings_go_on(record: SettingsRecord) -> None:
    record.check({**SETTINGS}, "")
    assert record.difference(SETTINGS) == ""
    assert record.read() == SETTINGS


def test_a_file_counts_by_what_is_in_it_but_in_records_that_do_not_say(tmp_path: Path) -> None:
    record = SettingsRecord(tmp_path / "settings.yaml", contents={"sequence.camera": "camera_content"})
    record.write({"sequence": {"camera": "a.yaml"}, "camera_content": "sha256:1"})
    assert record.difference({"sequence": {"camera": "b.yaml"}, "camera_content": "sha256:1"}) == ""
    changed = {"sequence": {"camera": "a.yaml"}, "camera_content": "sha256:2"}
    assert record.difference(changed) == "camera_content=sha256:1, now sha256:2"
    record.write({"sequence": {"camera": "a.yaml"}})  # of an earlier version
    assert record.difference(changed) == ""
    assert record.difference({**changed, "sequence": {"camera": "b.yaml"}}) == "sequence.camera=a.yaml, now b.yaml"


def test_another_setting_is_refused_and_named_with_the_mend(record: SettingsRecord) -> None:
    other = {**SETTINGS, "frontend": {"name": "orb", "max_keypoints": 600}}
    with pytest.raises(ConfigError, match=r"out: was begun with frontend\.max_keypoints=500, now 600; try again$"):
        record.check(other, "try again")
    with pytest.raises(ConfigError, match=r"frontend=.*, now None"):
        record.check({"optimiser": SETTINGS["optimiser"]}, "")


def test_of_a_list_of_words_it_is_told_what_is_missing_or_new(tmp_path: Path) -> None:
    record = SettingsRecord(tmp_path / "settings.yaml")
    long = [f"/videos/of/a/long/name/{i:04d}.mp4" for i in range(5)]
    record.write({"sequences": long, "gaps": [1, 2]})
    for now, words in (
        (long[:-1], f"with sequences {long[-1]}; mend"),
        ([*long, "/b.mp4"], "without sequences /b.mp4; mend"),
        (long[::-1], "with sequences in another order; mend"),
    ):
        with pytest.raises(ConfigError) as raised:
            record.check({"sequences": now, "gaps": [1, 2]}, "mend")
        assert str(raised.value) == f"{tmp_path}: was begun {words}"
    with pytest.raises(ConfigError, match=r"was begun with gaps=\[1, 2\], now \[1, 3\]; mend"):
        record.check({"sequences": long, "gaps": [1, 3]}, "mend")


def test_free_settings_may_differ(record: SettingsRecord) -> None:
    record.check({**SETTINGS, "optimiser": {"seed": 0, "threads": 8}}, "")
    record.check({**SETTINGS, "optimiser": {"seed": 0}}, "")
    assert record.difference({**SETTINGS, "optimiser": {"seed": 1}}) == "optimiser.seed=0, now 1"


@dataclass(frozen=True)
class Optimiser:
    rate: float = 0.1


@dataclass(frozen=True)
class ImproveSettings:
    optimiser: Optimiser = field(default_factory=Optimiser)


def test_a_setting_that_came_later_counts_as_having_its_default(record: SettingsRecord) -> None:
    with_default = SettingsRecord(record.path, ImproveSettings, ["optimiser.threads"])
    now = {**SETTINGS, "optimiser": {"seed": 0, "rate": 0.1}}
    assert record.difference(now) == "optimiser.rate=None, now 0.1"
    assert with_default.difference(now) == ""
    assert with_default.difference({**SETTINGS, "optimiser": {"seed": 0, "rate": 0.2}}) == "optimiser.rate=0.1, now 0.2"


def test_former_names_are_the_present_ones(record: SettingsRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(config.FORMER_NAMES, "frontend", {"max_keypoints": "most_keypoints"})
    now = {**SETTINGS, "frontend": {"name": "orb", "most_keypoints": 500}}
    record.check(now, "")
    monkeypatch.setitem(config.FORMER_NAMES, "improve", {"frontend": "network"})  # of a whole section of one class
    of_improve = SettingsRecord(record.path, ImproveSettings)
    assert of_improve.read()["network"] == SETTINGS["frontend"]
    record.write(now)
    assert yaml.safe_load(record.path.read_text())["frontend"] == now["frontend"]


def test_a_list_in_json_is_a_record_too(tmp_path: Path) -> None:
    record = SettingsRecord(tmp_path / "labels.json")
    record.write([["room", 40]])
    assert record.difference([["room", 40]]) == ""
    assert record.difference([["room", 41]])


def test_a_damaged_record_is_named(record: SettingsRecord) -> None:
    record.path.write_text("key: [unclosed")
    with pytest.raises(InputError, match=r"settings\.yaml: is damaged"):
        record.check(SETTINGS, "")


def test_long_values_are_cut_in_messages() -> None:
    words = first_difference({"sequences": ["a" * 100]}, {"sequences": []})
    assert words.startswith("sequences=['aaa")
    assert len(words) < 90
