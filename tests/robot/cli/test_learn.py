"""The commands that train and export, where what they need is not installed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from tests.robot.cli.invoked import plain_text, tacsim


@pytest.mark.parametrize("words", [("train", "squeeze"), ("export", "policy", "runs/x", "--out", "x.onnx")])
def test_train_without_extra_names_it(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec

    def find(name: str, *rest: Any) -> Any:
        return None if name == "torch" else there(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", find)
    result = tacsim(*words)
    assert result.exit_code == 2
    assert "needs torch" in result.stderr
    assert "pip install 'tacsim[train]'" in result.stderr


def test_tensorboard_without_its_package_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    there = importlib.util.find_spec

    def find(name: str, *rest: Any) -> Any:
        return None if name == "tensorboard" else there(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", find)
    result = tacsim("train", "squeeze", "--algorithm", "ppo", "--tensorboard", "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert "needs tensorboard, which is not installed: pip install tensorboard" in plain_text(result.stderr)
    assert not (tmp_path / "run").exists()


def test_tensorboard_of_dagger_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: name or there(name, *rest))
    result = tacsim("train", "squeeze", "--tensorboard", "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert "dagger writes no log for TensorBoard" in plain_text(result.stderr)
    assert not (tmp_path / "run").exists()
