"""What differs between the cells of the studies of transfer, and only that."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import transfer, transfer_held
from tacsim.config import load_model, load_rig
from tacsim.gym.features import FeatureEncoder
from tacsim.models.policy import Training


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With what `tacsim identify` writes; not below the current folder."""
    found = tmp_path / "study"
    for kind, text in (("gel", "{youngs_modulus: 0.17 MPa, poisson_ratio: 0.48}"),
                       ("body", "{youngs_modulus: 0.25 MPa, yield_stress: 15 kPa}")):  # fmt: skip
        (found / f"my-{kind}").mkdir(parents=True)
        (found / f"my-{kind}/material.yaml").write_text(text)
    (found / "my-body/scene.yaml").write_text("{extends: squeeze, friction: {lower: 0.5, upper: 0.7}}")
    return found


@pytest.mark.parametrize("sight", transfer.VIEWS)
def test_cells_differ_in_their_materials_alone(sight: str, folder: Path) -> None:
    guessed, identified, drawn = (transfer.training(sight, each, folder) for each in transfer.MATERIALS)
    assert guessed.randomise is not None and drawn.randomise is not None
    assert guessed.randomise == identified.randomise
    assert {key for key in drawn.randomise.values if key not in guessed.randomise.values} >= {
        "scene.body.material.yield_stress", "scene.gel.material.youngs_modulus", "scene.friction.lower"
    }  # fmt: skip
    assert not any("material" in key or "light" in key for key in guessed.randomise.values)
    assert guessed.features == identified.features == drawn.features
    assert ("picture" in drawn.features.maps) == (sight == "raw")
    scene = load_rig(identified.rig, task=identified.task, overrides=identified.overrides).config.scene
    assert scene is not None and scene.body is not None
    assert (scene.gel.material.youngs_modulus, scene.body.material.youngs_modulus) == (0.17e6, 0.25e6)
    assert scene.friction == {"lower": 0.5, "upper": 0.7}
    usual = load_rig(guessed.rig, task=guessed.task, overrides=guessed.overrides).config.scene
    assert usual is not None and usual.gel.material.youngs_modulus == 0.145e6


@pytest.mark.parametrize("task", transfer_held.HeldTask)
def test_policies_of_a_held_object_differ_in_what_they_see_alone(task: transfer_held.HeldTask) -> None:
    found = {name: transfer_held.training(name, task.value) for name in transfer_held.POLICIES}
    flow, shipped = found["flow"], load_model(Training, task.value).features
    assert {each.task for each in found.values()} == {task.value}
    assert all(each.randomise == flow.randomise and each.environments == flow.environments for each in found.values())
    assert {each.dagger.rounds for each in found.values()} == {transfer_held.ROUNDS}
    assert {name for name, each in found.items() if each.features.flow} == {"flow"}
    assert [found[name].features.maps for name in found] == [(), (), ("image",), ()]
    assert found["blind"].features.sensors == ()
    of_hand = set(found["blind"].features.touch)
    for each in found.values():
        config = load_rig(each.rig, task=each.task, overrides=each.overrides).config
        FeatureEncoder(each.features, config.canonical)  # the maps fit
        assert config.motion == "flowing"
        assert of_hand <= set(each.features.touch) and each.features.frames == shipped.frames
    # together they see all that the shipped student sees
    assert set(shipped.touch) <= set(flow.features.touch) | set(found["depth"].features.touch)
    assert not (set(flow.features.touch) & set(found["depth"].features.touch)) - of_hand
