"""The commands that train and export, where what they need is not installed."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from tests.robot.cli.invoked import tacsim


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
