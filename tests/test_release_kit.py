"""What a release consists of agrees with itself."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import improvo

ROOT = Path(__file__).parents[1]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def recipe(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "recipes" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_version_is_the_same_everywhere() -> None:
    assert f'\nversion = "{improvo.__version__}"\n' in PROJECT
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == improvo.__version__
    assert f"\n## {improvo.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()


def test_links_of_the_readme_work_away_from_the_repository() -> None:
    release = recipe("release")
    text = release.with_absolute_links(
        "![a](docs/a.jpg) [b](LICENSE) [c](https://x.org) [d](#e)", "https://h/o/r", "v1"
    )
    assert text == (
        "![a](https://h/o/r/raw/v1/docs/a.jpg) [b](https://h/o/r/blob/v1/LICENSE) [c](https://x.org) [d](#e)"
    )
    readme = release.with_absolute_links((ROOT / "README.md").read_text(), "https://h/o/r", "v1")
    assert re.findall(r"\]\((?!https?://|#)", readme) == []
    for target in re.findall(r"\]\(https://h/o/r/(?:raw|blob)/v1/([^)#]+)", readme):
        assert (ROOT / target).exists(), target
    assert 'Source = "https://h/o/r"' in release.with_urls(PROJECT, "https://h/o/r")


def test_the_lock_file_has_every_dependency_by_its_hash_and_names_no_server() -> None:
    lock = (ROOT / "requirements-dev.txt").read_text()
    assert "://" not in lock
    locked = {name.lower() for name in re.findall(r"^([\w.-]+)==", lock, re.MULTILINE)}
    assert lock.count("--hash=sha256:") >= len(locked)
    start = PROJECT.index("dependencies = [")
    base = PROJECT[start : PROJECT.index("\n]", start)]
    dev = re.search(r"^dev = \[(.+)\]$", PROJECT, re.MULTILINE)
    assert dev is not None
    needed = re.findall(r'"([A-Za-z][\w-]*)', base + dev[1])
    assert len(needed) > 20
    assert [name for name in needed if name.lower() not in locked] == []


def test_hosted_checks_run_on_every_python_that_is_claimed() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    matrix = jobs["install"]["strategy"]["matrix"]
    claimed = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', PROJECT)
    assert matrix["python"] == claimed
    if sys.version_info >= (3, 11):  # which the recipe needs
        assert list(recipe("wheels").PYTHONS) == claimed
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_forms_and_workflows_are_well_formed(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    if path.parent.name == "ISSUE_TEMPLATE" and path.name != "config.yml":
        assert {"name", "description", "body"} <= content.keys()
        assert all(part["type"] in ("textarea", "input", "markdown") for part in content["body"])


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "workflows").iterdir()), ids=lambda path: path.name)
def test_actions_are_pinned_by_their_commit(path: Path) -> None:
    used = re.findall(r"uses: *(.+)", path.read_text())
    assert len(used) > 1
    assert [each for each in used if not re.fullmatch(r"[\w/-]+@[0-9a-f]{40}  # v\d+(\.\d+)+", each)] == []


@pytest.mark.parametrize(
    ("licence", "verdict"),
    [
        ("MIT License", True),
        ("Apache-2.0", True),
        ("BSD-3-Clause AND MIT", True),
        ("GNU Lesser General Public License v3 (LGPLv3); MIT", True),
        ("GPL-3.0-only", False),
        ("GNU Affero General Public License v3", False),
        ("MIT OR GPL-2.0-or-later", True),
        ("CC BY-NC 4.0", False),
        ("for non-commercial research only", False),
        ("unknown", False),
    ],
)
def test_licences_that_may_be_depended_on(licence: str, verdict: bool) -> None:
    assert recipe("licences").may_depend_on(licence) == verdict


@pytest.mark.skipif(sys.version_info < (3, 11), reason="needs tomllib, of Python 3.11")
def test_dependencies_that_have_wheels_but_not_together_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wheels = recipe("wheels")
    monkeypatch.setattr(wheels, "resolved", lambda requirements, platform, python: "no: a" if requirements[1:] else "")
    monkeypatch.setattr("sys.argv", ["wheels", "--each", "--python", "3.12"])
    with pytest.raises(SystemExit) as end:
        wheels.main()
    assert end.value.code == 1
    assert "no: a (together)" in capsys.readouterr().out
