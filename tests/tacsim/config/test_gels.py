"""Configuration of gels that differ from sensor to sensor: what is given, what is written, how large they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from tacsim.config import ConfigError, load_rig, load_scene
from tacsim.models.scene import Scene
from tests.tacsim.config.files import write


def test_sensor_has_separate_gel_if_scene_gives_one(folder: Path) -> None:
    text = """
extends: squeeze
gel: {material: {youngs_modulus: 0.2 MPa}}
gels:
  upper: {size: [16 mm, 24 mm, 2 mm], element_size: 0.5 mm, material: {poisson_ratio: 0.45}}
"""
    scene = load_scene(write("a.yaml", text))
    lower, upper = scene.gel_of("lower"), scene.gel_of("upper")
    assert lower == scene.gel and scene.element_size_of("lower") == 1e-3
    assert upper.size == pytest.approx((16e-3, 24e-3, 2e-3)) and scene.fitted_element_size("upper") == pytest.approx(
        0.5e-3
    )
    assert (upper.material.youngs_modulus, upper.material.poisson_ratio) == (0.2e6, 0.45)  # the first is the gel's
    assert upper.housing == lower.housing == 0.3e-3


def test_a_change_of_the_gel_reaches_a_sensor_that_does_not_say_it_otherwise(folder: Path) -> None:
    a = write("a.yaml", "extends: squeeze\ngels: {upper: {material: {density: 1100}, housing: null}}")
    changed = load_scene(a, ["gel.material.youngs_modulus=0.3 MPa", "gel.housing=0.1 mm"])
    assert changed.gel_of("upper").material.youngs_modulus == 0.3e6 and changed.gel_of("upper").housing is None
    both = load_scene("squeeze", ["gels.upper.material=silicone", "gel.material.youngs_modulus=0.3 MPa"])
    assert both.gel_of("upper").material.youngs_modulus == 0.145e6  # a material by its name says everything
    one = load_scene("squeeze", ["gels.lower.material.youngs_modulus=0.3 MPa"])
    assert one.gel_of("lower").material == one.gel.material.model_copy(update={"youngs_modulus": 0.3e6})
    assert one.gel_of("upper") == one.gel


def test_what_is_written_of_a_gel_means_the_same_again(folder: Path) -> None:
    given = "{upper: {housing: null, material: {youngs_modulus: 0.3 MPa}}, lower: {element_size: 0.5 mm}}"
    loaded = load_rig("sim", overrides=[f"scene.gels={given}"])
    again = load_rig(write("again.yaml", loaded.text))
    assert again.config == loaded.config and again.text == loaded.text
    scene = loaded.config.scene
    assert scene is not None
    for copy in (Scene.model_validate_json(scene.model_dump_json()), Scene.model_validate(scene.model_dump())):
        assert copy == scene and copy.gel_of("upper") == scene.gel_of("upper")
        softer = Scene.model_validate(copy.model_dump() | {"gel": {"material": {"poisson_ratio": 0.4}}})
        assert softer.gel_of("upper").material.poisson_ratio == 0.4 and softer.gel_of("upper").housing is None
    other = load_scene("squeeze", ["gels={upper: {housing: null}}"])
    assert other != load_scene("squeeze", ["gels={upper: {}}"])


@pytest.mark.slow
def test_gels_are_as_large_as_their_own_sensors(folder: Path) -> None:
    """Two sensors with two sizes: each in whole elements of its own; one size alone is that of both, as ever."""
    mini, digit = (
        "{extends: gelsight-mini, gel_size: [20.3 mm, 15.2 mm], gel_thickness: null}",
        "{extends: digit, gel_size: [18.8 mm, 25 mm], gel_thickness: null}",
    )
    models = [f"sensors.lower.model={mini}", f"sensors.upper.model={digit}"]
    thin = "scene.gels={upper: {size: [20 mm, 20 mm, 2 mm], element_size: 0.5 mm}}"
    loaded = load_rig("sim", overrides=[*models, thin])
    scene = loaded.config.scene
    assert scene is not None
    assert scene.gel_of("lower").size == pytest.approx((20e-3, 15e-3, 4e-3))
    assert scene.gel_of("upper").size == pytest.approx((19e-3, 25e-3, 2e-3))
    assert [note.partition(":")[0] for note in loaded.notes] == [
        "gel 20 x 15 mm in whole elements of 1 mm, 4 mm thick", "gel 19 x 25 mm in whole elements of 0.5 mm, 2 mm thick"
    ]  # fmt: skip
    assert load_rig(write("again.yaml", loaded.text)).config == loaded.config
    said = load_rig("sim", overrides=[*models, "scene.gels.upper.size=[10 mm, 10 mm, 4 mm]"])
    assert said.config.scene is not None
    assert [said.config.scene.gel_of(name).size[:2] for name in ("lower", "upper")] == [
        pytest.approx((20e-3, 15e-3)), (10e-3, 10e-3)
    ]  # fmt: skip
    assert "gel 10 x 10 mm, as given on the command line" in " ".join(said.notes)
    assert load_rig(write("said.yaml", said.text)).config == said.config
    both = load_rig("sim", overrides=[*models, "scene.gel.size=[10 mm, 10 mm, 4 mm]"]).config.scene
    assert both is not None and both.gel_of("lower").size == both.gel_of("upper").size == (10e-3, 10e-3, 4e-3)
    one = load_rig("sim", overrides=models[:1]).config.scene
    assert one is not None and not one.gels and one.gel.size == pytest.approx((20e-3, 15e-3, 4e-3))
    with pytest.raises(ConfigError, match=r"scene\.gels\.upper\.size: .*physics 'seed' has one gel for both"):
        load_rig("sim", overrides=[*models, "scene.physics=seed"])
