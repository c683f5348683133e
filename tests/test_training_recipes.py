"""The recipes start: what they import exists, and their settings are read."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo import config
from improvo.training.held_settings import HeldSettings
from improvo.training.settings import OdometryTrainingSettings

RECIPES = Path(__file__).parents[1] / "recipes"


def recipe(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"recipe_{name}", RECIPES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up the types of their fields
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.py")))
def test_a_recipe_imports_and_explains_itself(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name in ("release", "wheels") and sys.version_info < (3, 11):
        pytest.skip("needs tomllib, of Python 3.11")
    module = recipe(name)
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 0
    assert f"recipes/{name}.py" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["stability-head", "superpoint-vo"])
def test_settings_of_a_recipe_are_read(name: str) -> None:
    settings = config.load(OdometryTrainingSettings, RECIPES / f"{name}.yaml")
    assert settings != OdometryTrainingSettings()


@pytest.mark.parametrize("tiny", [False, True])
def test_every_job_of_the_plan_has_settings(tiny: bool) -> None:
    import argparse

    plan: dict[str, Any] = yaml.safe_load((RECIPES / "gpu-plan.yaml").read_text())
    for job in plan["jobs"]:
        settings = recipe("gpu_train").settings_of(job, plan, argparse.Namespace(tiny=tiny, compile=True))
        assert isinstance(settings, HeldSettings)
        assert settings.compile
        assert settings.views.width == (64 if tiny else 320)
