"""Scenes with a rigid object: what they say, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from tacsim.config import load_scene
from tacsim.models.scene import Scene
from tacsim.physics.world import make_world


def test_the_shipped_scene_has_an_object_and_nothing_else_to_press() -> None:
    scene = load_scene("hold")
    assert scene.object is not None
    assert scene.body is None
    assert scene.indenter is None
    assert scene.sensors == ("left", "right")
    assert scene.gravity[2] < 0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"object": {}}, "here are body and object"),
        ({"body": None}, "here are none of them"),
        ({"body": None, "object": {}, "indenter": {}}, "here are indenter and object"),
        ({"body": None, "object": {"mass": 0}}, "mass"),
        ({"body": None, "object": {"mass": -1}}, "mass"),
        ({"body": None, "object": {"mass": math.nan}}, "mass"),
        ({"body": None, "object": {"friction": 6}}, "friction"),
        ({"body": None, "object": {"pedestal": -0.01}}, "pedestal"),
        ({"body": None, "object": {}, "timestep": 0.0}, "timestep"),
        ({"body": None, "object": {}, "physics": "seed"}, "physics 'seed' has no rigid object"),
        ({"body": None, "object": {}, "gels": {"lower": {}}}, "both pads have the same gel"),
        ({"body": None, "object": {}, "element_size": 1e-3}, "gels that hold an object have the preset's"),
        ({"fixtures": {"wall": {}}}, "only an object meets them"),
    ],
)
def test_what_is_no_scene_of_an_object_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Scene.model_validate(values)


def test_only_mujoco_moves_an_object() -> None:
    with pytest.raises(ValueError, match="'hold' has a rigid object, which only MuJoCo moves"):
        make_world(load_scene("hold"))
