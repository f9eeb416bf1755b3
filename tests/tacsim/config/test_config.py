"""Configuration: shipped files, references, overrides, the resolved text. Error texts: test_errors.py."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

# Subnormal numbers are left out: once Taichi runs in a process it flushes them to zero.
from hypothesis import given
from hypothesis import strategies as st

from tacsim.config import (
    KINDS,
    ConfigError,
    config_root,
    json_schema,
    load_model,
    load_rig,
    load_scene,
    load_sensor,
    shipped_names,
)
from tacsim.config.document import LoadState, _Loader, dump_yaml, node_as_json, parse_text
from tacsim.config.load import load_task
from tacsim.models.hardware import UrArmConfig
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.rig import ReplaySensorConfig, SimSensorConfig
from tacsim.models.scene import Box, Cylinder, Sphere
from tacsim.models.task import RepositionConfig, SqueezeConfig
from tests.tacsim.config.files import write

# Shipped files


@pytest.mark.parametrize("rig", shipped_names("rig"))
@pytest.mark.parametrize("task", [None, *shipped_names("task")])
def test_every_shipped_rig_loads_with_every_task_and_its_text_loads_back(
    rig: str, task: str | None, folder: Path
) -> None:
    loaded = load_rig(rig, task=task)
    again = load_rig(write("resolved.yaml", loaded.text))
    assert again.config == loaded.config
    assert again.text == loaded.text
    assert again.sources == (folder / "resolved.yaml",)


@pytest.mark.parametrize("name", shipped_names("scene"))
def test_every_shipped_scene_loads(name: str) -> None:
    assert load_scene(name).name == name


@pytest.mark.parametrize("name", shipped_names("sensor"))
def test_every_shipped_sensor_loads(name: str) -> None:
    assert load_sensor(name).name == name


@pytest.mark.parametrize("name", ["digit", "gelsight-mini", "gelsight-wedge", "9dtact"])
def test_sensors_that_exist_have_a_gel_of_their_own_and_name_their_public_sources(name: str) -> None:
    sensor = load_sensor(name)
    assert "github.com" in sensor.source and "`tacsim calibrate sensor`" in sensor.source
    assert "licence" in sensor.source or "GPL" in sensor.source
    assert sensor.gel_size is not None and sensor.gel_thickness is not None
    sides = (sensor.geometry.width, sensor.geometry.height)
    shown = [side * sensor.geometry.pixel_pitch for side in sides]
    assert all(10e-3 < side <= own for side, own in zip(shown, sensor.gel_size, strict=True))  # a finger's gel [m]


@pytest.mark.parametrize("name", shipped_names("material"))
def test_every_shipped_material_loads_and_names_its_source(name: str) -> None:
    source = load_model(GelMaterial, name).source if name == "silicone" else load_model(BodyMaterial, name).source
    assert "guess" in source.lower()


def test_values_of_the_shipped_files() -> None:
    clay = load_model(BodyMaterial, "modelling-clay")
    assert (clay.youngs_modulus, clay.poisson_ratio, clay.yield_stress) == (0.5e6, 0.45, 30e3)
    assert clay.elastic_limit == pytest.approx(0.071, abs=5e-4)
    assert load_model(BodyMaterial, "seed").elastic_limit == 0.024
    gel = load_model(GelMaterial, "silicone")
    assert (gel.youngs_modulus, gel.poisson_ratio) == (0.145e6, 0.48)
    assert load_scene("squeeze").body is not None
    assert load_scene("reposition").friction == {"lower": 0.3, "upper": 1.0}
    assert load_scene("reposition").body == load_scene("squeeze").body
    press = load_scene("press")
    assert press.body is None
    assert press.indenter is not None
    assert press.indenter.geometry == Sphere(radius=4e-3)
    assert load_sensor("ideal").markers is None
    assert load_sensor("ideal-markers").markers is not None
    assert load_sensor("ideal-markers").lighting == load_sensor("ideal").lighting
    assert load_task("squeeze").goal == 7e-3
    assert load_task("reposition").goal == (2e-3, 2e-3)


# References


def test_sources_are_the_files_read_in_order() -> None:
    root = config_root()
    expected = ("rigs/sim", "tasks/squeeze", "scenes/squeeze", "materials/silicone", "materials/modelling-clay")
    assert load_rig("sim").sources == (*(root / f"{name}.yaml" for name in expected), root / "sensors/ideal.yaml")


def test_a_reference_may_be_a_path_below_the_files_own_folder(folder: Path) -> None:
    write("lab/scenes/mine.yaml", "body: {material: clays/blue.yaml}")
    write("lab/scenes/clays/blue.yaml", "extends: dough\nyield_stress: 7 kPa")
    write("lab/rig.yaml", "extends: sim\nscene: scenes/mine.yaml")
    scene = load_rig("lab/rig.yaml").config.scene
    assert scene is not None
    assert scene.body is not None
    assert (scene.body.material.yield_stress, scene.body.material.youngs_modulus) == (7e3, 0.1e6)


@pytest.mark.parametrize(
    "reference", ["../secret.yaml", "lab/../../secret.yaml", "/etc/secret.yaml", "link.yaml", "sub/../../secret.yaml"]
)
def test_no_reference_leads_out_of_the_folder(folder: Path, reference: str) -> None:
    write("secret.yaml", "name: secret")
    write("lab/rig.yaml", f"extends: sim\nscene: {reference}")
    (folder / "lab/link.yaml").symlink_to(folder / "secret.yaml")
    with pytest.raises(ConfigError, match=r"lab/rig.yaml:2: scene: .* leads outside; allowed: files below") as caught:
        load_rig("lab/rig.yaml")
    assert "secret'" not in str(caught.value)


def test_extends_merges_mappings_and_replaces_everything_else(folder: Path) -> None:
    write("a.yaml", "extends: squeeze\nfriction: {upper: 1}\nbody: {geometry: {shape: sphere}, material: dough}")
    scene = load_scene("a.yaml")
    assert scene.friction == {"lower": 0.6, "upper": 1.0}
    assert scene.body is not None
    assert scene.body.geometry == Sphere()  # the box's size went with the box
    assert scene.body.material == load_model(
        BodyMaterial, "dough"
    )  # a reference replaces, clay's numbers do not shine through


def test_extends_inside_a_merged_mapping_starts_from_its_own_base(folder: Path) -> None:
    write("a.yaml", "extends: squeeze\nbody: {material: {extends: dough, poisson_ratio: 0.4}}")
    body = load_scene("a.yaml").body
    assert body is not None
    assert (body.material.yield_stress, body.material.poisson_ratio) == (5e3, 0.4)


def test_a_file_may_be_just_another_name(folder: Path) -> None:
    assert load_scene(write("mine.yaml", "press")) == load_scene("press")


def test_source_of_a_recording_is_no_reference(folder: Path) -> None:
    rig = load_rig("replay", overrides=["sensors.finger.source=../data/run.mcap", "arms.gripper.source=a/b.csv"])
    finger = rig.config.sensors["finger"]
    assert isinstance(finger, ReplaySensorConfig)
    assert finger.source == "../data/run.mcap"


# Overrides and the effective scene


def scene_of(*overrides: str, task: str | None = None, rig: str = "sim"):
    return load_rig(rig, task=task, overrides=overrides).config.scene


def test_overrides_reach_into_referenced_files() -> None:
    assert scene_of('scene.body.material.youngs_modulus="0.2 MPa"').body.material.youngs_modulus == 0.2e6
    assert scene_of("scene.body.material.youngs_modulus=0.2 MPa").body.material.yield_stress == 30e3


def test_overrides_apply_in_the_order_given() -> None:
    into, whole = "scene.body.material.youngs_modulus=1 MPa", "scene.body.material=dough"
    assert scene_of(whole, into).body.material.youngs_modulus == 1e6
    assert scene_of(into, whole).body.material.youngs_modulus == 0.1e6


def test_overrides_replace_references() -> None:
    assert scene_of("scene=reposition") == load_scene("reposition")
    assert scene_of("scene={extends: reposition, preset: standard}").friction["upper"] == 1.0


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("task.steps=12", 12),
        ("task.steps=1e2", 100),
        ("scene=squeeze", "squeeze"),
        ("scene.body.geometry.size=[1 mm, 2e-3, 3e-2]", (1e-3, 2e-3, 3e-2)),
        ("scene.body.geometry.size.1=4 mm", (10e-3, 4e-3, 10e-3)),
        ("scene.gel.housing=null", None),
        ("scene.gel.housing=", None),
        ("scene.name=no", "no"),
        ("scene.name='1e5'", "1e5"),
        ("scene.name=a=b", "a=b"),
    ],
)
def test_values_are_yaml(override: str, value: object) -> None:
    rig = load_rig("sim", overrides=[override]).config
    assert rig.scene is not None
    assert rig.task is not None
    assert rig.scene.body is not None
    assert isinstance(rig.scene.body.geometry, Box)
    where = override.partition("=")[0].removesuffix(".1")
    found = {
        "task.steps": rig.task.steps,
        "scene": rig.scene.name,
        "scene.body.geometry.size": rig.scene.body.geometry.size,
        "scene.gel.housing": rig.scene.gel.housing,
        "scene.name": rig.scene.name,
    }
    assert found[where] == value


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("scene.body.geometry.size=[1 mm, 2e-3, 3]", "write a unit, such as '3 mm'"),
        ("scene.body.geometry.size.1=4", "would be 4 m"),
        ("scene.gel.housing=0.5", "would be 0.5 m"),
        ("sensors.upper.model.geometry.pixel_pitch=0.2", "would be 0.2 m"),
    ],
)
def test_a_length_without_unit_that_cannot_be_metres_is_refused(override: str, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_rig("sim", overrides=[override])


def test_the_tasks_scene_is_the_rigs_unless_it_has_its_own(folder: Path) -> None:
    assert scene_of() == load_scene("squeeze")
    assert scene_of(task="reposition") == load_scene("reposition")
    assert scene_of("scene.preset=standard", "task=reposition") == load_scene("reposition", ["preset=standard"])
    assert scene_of("scene=null") == load_scene("squeeze")
    assert scene_of("task.scene.preset=standard").preset == "standard"
    write("own.yaml", "extends: sim\nscene: press")
    assert scene_of(rig="own.yaml", task="reposition") == load_scene("press")
    with pytest.raises(ConfigError, match=r"--set task.scene.preset=draft: task.scene.preset: .* write scene.preset"):
        scene_of("task.scene.preset=draft", rig="own.yaml")


def test_only_a_rig_that_simulates_has_a_scene() -> None:
    assert scene_of(rig="replay") is None
    assert scene_of(rig="replay", task="squeeze") is None
    with pytest.raises(ConfigError, match=r"--set scene.preset=standard: scene: no arm and no sensor .* driver 'sim'"):
        scene_of("scene.preset=standard", rig="replay")
    with pytest.raises(ConfigError, match=r"rigs/sim.yaml:4: scene: is missing"):
        scene_of("task=null")


def test_overrides_create_what_is_absent_from_its_defaults(folder: Path) -> None:
    upper = load_rig("sim", overrides=["sensors.upper.model.markers.rows=5"]).config.sensors["upper"]
    assert isinstance(upper, SimSensorConfig)
    assert upper.model.markers is not None
    assert (upper.model.markers.rows, upper.model.markers.columns) == (5, 11)
    write("bare.yaml", "name: bare")
    assert load_scene("bare.yaml", ["friction.upper=1"]).friction == {"lower": 0.6, "upper": 1.0}
    body = load_scene("bare.yaml", ["body.geometry.size.2=5 mm"]).body
    assert body is not None
    assert body.geometry == Box(size=(10e-3, 10e-3, 5e-3))
    indenter = load_scene("bare.yaml", ["body=null", "indenter.friction=1"]).indenter
    assert indenter is not None
    assert indenter.geometry == Sphere(radius=4e-3)


def test_overriding_the_tag_changes_the_variant() -> None:
    scene = scene_of("scene.body.geometry.shape=cylinder", "scene.body.geometry.height=3 mm")
    assert scene.body.geometry == Cylinder(height=3e-3)
    rig = load_rig("sim", overrides=["task.kind=reposition", "task.goal=[1 mm, 0]"])
    assert isinstance(rig.config.task, RepositionConfig)
    assert isinstance(load_rig("sim").config.task, SqueezeConfig)


# Reading


@pytest.mark.parametrize("text", ["1e5", "1E5", "+1e5", "100000", "1.e+5", "100000.0"])
def test_numbers_are_numbers(text: str) -> None:
    node = parse_text(f"a: {text}", "x", Path(), LoadState())
    assert node.items["a"].value == 1e5
    assert node_as_json(node) == '{"a": 100000}'


@pytest.mark.parametrize("text", ["no", "on", "y", "12:30", "2024-01-01", "0x10", "1_000", "1e", ".", "e5", "'1e5'"])
def test_what_yaml_1_1_would_guess_stays_a_text(text: str) -> None:
    assert parse_text(f"a: {text}", "x", Path(), LoadState()).items["a"].value == text.strip("'")


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
    | st.text(st.characters(exclude_categories=["Cs", "Cc"]) | st.sampled_from("0123456789eE.+-:#'\" ~"), max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.from_regex(r"\A[a-z]{1,4}\Z"), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip


@pytest.mark.slow
@given(plain)
def test_what_is_dumped_is_read_back(data: object) -> None:
    def values(node):
        if isinstance(node.value, dict):
            return {key: values(child) for key, child in node.value.items()}
        return [values(child) for child in node.value] if isinstance(node.value, list) else node.value

    state = LoadState()
    back = values(parse_text(dump_yaml({"data": data}), "x", Path(), state))
    assert state.problems == []
    assert back == {"data": data}


# JSON schema


@pytest.mark.parametrize("kind", KINDS)
def test_schema_is_complete_with_references(kind: str) -> None:
    schema = json_schema(kind)
    references = [found["enum"] for found in walk(schema) if isinstance(found.get("enum"), list)]
    assert shipped_names(kind) in references
    for found in walk(schema):
        if "$ref" in found:
            assert found["$ref"].removeprefix("#/$defs/") in schema["$defs"]
        assert not {"gt", "ge", "lt", "le", "oneOf", "discriminator"} & set(found) - set(found.get("properties", ()))


def test_schema_offers_every_key_of_the_shipped_rigs() -> None:
    mapping = json_schema("rig")["anyOf"][1]
    assert mapping["additionalProperties"] is False
    for name in shipped_names("rig"):
        shipped = yaml.load((config_root() / f"rigs/{name}.yaml").read_text(), Loader=yaml.SafeLoader)
        assert set(shipped) <= set(mapping["properties"])
    number, text = mapping["properties"]["period"]["anyOf"]
    assert number == {"type": "number", "exclusiveMinimum": 0}
    assert "ms" in text["pattern"]


def walk(schema):
    if isinstance(schema, dict):
        yield schema
        for value in schema.values():
            yield from walk(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from walk(value)


def test_the_loader_is_a_safe_one() -> None:
    assert issubclass(_Loader, yaml.SafeLoader)
    with pytest.raises(KeyError):
        shipped_names("robot")


def test_overrides_do_not_loosen_the_limits_of_a_real_arm() -> None:
    for override, words in {
        "arms.upper.limits.force=100": "limits.force: 20 -> 100",
        "arms.upper.limits.workspace.upper=[1, 1, 1]": "limits.workspace: reaches farther",
        "arms.lower.action_timeout=1": "action_timeout: 0.2 -> 1",
        "keep_out=[]": "keep_out of lower and upper",
    }.items():
        with pytest.raises(ConfigError, match=re.escape(words)) as refused:
            load_rig("ur5e", overrides=[override])
        assert "write it into the rig file" in str(refused.value)


def test_overrides_may_narrow_the_limits_of_a_real_arm_and_change_those_of_a_mock() -> None:
    arm = load_rig("ur5e", overrides=["arms.upper.limits.force=10", "arms.upper.limits.depth=1 mm"]).config.arms[
        "upper"
    ]
    assert isinstance(arm, UrArmConfig) and arm.limits.force == 10 and arm.limits.depth == 1e-3
    arm = load_rig("mock", overrides=["arms.upper.limits.force=100"]).config.arms["upper"]
    assert isinstance(arm, UrArmConfig) and arm.limits.force == 100


def test_a_real_arm_without_limits_or_with_a_slow_watchdog_is_refused(tmp_path: Path) -> None:
    text = (config_root() / "rigs/ur5e.yaml").read_text()
    slow = tmp_path / "slow.yaml"
    slow.write_text(text.replace("watchdog: 10", "watchdog: 2", 1))
    with pytest.raises(ConfigError, match="at least 10 Hz"):
        load_rig(slow)
    lines = text.splitlines()
    first = next(index for index, line in enumerate(lines) if "workspace:" in line)
    bare = tmp_path / "bare.yaml"
    bare.write_text("\n".join(lines[:first] + lines[first + 1 :]) + "\n")
    with pytest.raises(ConfigError, match="workspace"):
        load_rig(bare)
