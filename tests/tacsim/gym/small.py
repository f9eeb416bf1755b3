"""Environments small enough for tests: a cube of 3 mm between gels of 8 mm, at learn, with small pictures."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import tacsim.gym.env  # registers
import tacsim.sim.reset as resets
from tacsim.control import NoTouch

SMALL = (
    *(f"sensors.{name}.model.geometry.{what}" for name in ("lower", "upper") for what in ("width=20", "height=16")),
    *(f"sensors.{name}.model.geometry.pixel_pitch=0.5 mm" for name in ("lower", "upper")),
    "canonical.rows=8", "canonical.columns=8", "canonical.pitch=1 mm", "canonical.image_scale=1",
    "scene.preset=learn", "scene.gel.size=[8 mm, 8 mm, 4 mm]", "scene.body.geometry.size=[3 mm, 3 mm, 3 mm]",
    "task.goal=2 mm", "task.steps=3",
)  # fmt: skip
VARIANTS = (
    ("scene.body.material=dough",),
    ("scene.body.geometry.size=[4 mm, 3 mm, 5 mm]", "task.goal=4 mm"),
    ("scene.friction={lower: 0.3, upper: 0.9}", "scene.gel.material.youngs_modulus=0.2 MPa", "task.steps=2"),
)
AS_WRITTEN: dict[str, Any] = {"learning": False, "features": None}  # motions settle, and all is shown
NAME = "tacsim/Squeeze-v0"
assert tacsim.gym.env


def make(**options: Any) -> Any:
    options = {"overrides": SMALL, "variants": VARIANTS, **AS_WRITTEN, **options}
    return gymnasium.make(NAME, **options).unwrapped


def make_native(number: int, mode: str = "NextStep", **options: Any) -> Any:
    options = {"overrides": SMALL, "variants": VARIANTS, **AS_WRITTEN, **options}
    return gymnasium.make_vec(NAME, number, autoreset_mode=mode, **options)


def touch_nothing_slippery(monkeypatch: pytest.MonkeyPatch) -> None:
    """No gentle contact is found where the upper friction is above 0.5."""
    found = resets.approach_force

    def some(world: Any, touch_force: float) -> Any:
        if world.scene.friction["upper"] > 0.5:
            raise NoTouch("nothing there")
        return found(world, touch_force)

    monkeypatch.setattr(resets, "approach_force", some)


def assert_equal(a: Any, b: Any, at: str = "") -> None:
    """The same structure with the same bits."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), at
        for key in a:
            assert_equal(a[key], b[key], f"{at}.{key}")
    elif isinstance(a, np.ndarray) and a.dtype != object:
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), at
    elif isinstance(a, (list, tuple, np.ndarray)):
        assert len(a) == len(b), at
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{at}[{index}]")
    else:
        assert a == b, at
