"""The cards of the shipped policies are of the files that are shipped, and of the ranges in them."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import pytest

from robot.deploy.onnx_policy import read_policy_spec
from tacsim.config import config_root

PAGE = (Path(__file__).resolve().parents[2] / "docs/policies.md").read_text(encoding="utf-8")
CARDS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
SHIPPED = sorted((config_root() / "policies").glob("*.onnx"))


def between(low: float, high: float) -> str:
    """A range in words; one value of what was never drawn."""
    return f"{low:.3g}" if low == high else f"{round(low, 2):g} to {round(high, 2):g}"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_each_shipped_policy_has_its_card(path: Path) -> None:
    card, spec = CARDS[path.stem], read_policy_spec(path)
    assert f"SHA-256 `{sha256(path.read_bytes()).hexdigest()}`" in card
    assert f"| Trained on | {spec.trained['steps']:,} control steps, " in card
    assert f"{spec.trained['training']['randomise']['draws']:,} " in card
    assert f"period of {1e3 * spec.period:g} ms" in card
    assert spec.range is not None
    scene = spec.range.scene
    if "body.material.yield_stress" in scene and path.stem != "reposition":  # there it is that of the scene
        low, high = scene["body.material.yield_stress"]
        assert f"yield stress {1e-3 * low:g} to {1e-3 * high:g} kPa" in card
    if "object.mass" in scene:
        low, high = scene["object.mass"]
        assert f"{between(1e3 * low, 1e3 * high)} g" in card
    low, high = scene["gel.material.youngs_modulus"]
    assert f"gels {between(1e-6 * low, 1e-6 * high)} MPa" in card
    assert all(f"| {row} |" in card for row in ("Does", "Observes", "Range", "Success", "Limits"))


def test_no_card_is_of_a_policy_that_is_not_shipped() -> None:
    assert {name for name in CARDS if "SHA-256" in CARDS[name]} == {path.stem for path in SHIPPED}
