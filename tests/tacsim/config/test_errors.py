"""What a person reads when a configuration is wrong: the exact texts, hostile files, never another error."""

# ruff: noqa: E501  # complaints are long lines, compared whole

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tacsim.config import ConfigError, config_root, load_rig, load_scene, load_sensor

SCENE_KEYS = "name, physics, preset, particle_spacing, element_size, gel, gels, body, indenter, object, fixtures, timestep, friction, gravity, settling"
NEW_SCENE = "; `tacsim new scene NAME` writes one, `tacsim list scene` prints the shipped ones"
LENGTH = "length > 0 m, bare in m or with a unit (m, mm, cm, um)"


def complaint(load=load_scene, source="a.yaml", **options) -> str:
    with pytest.raises(ConfigError) as caught:
        load(source, **options)
    return str(caught.value)


# The text of a scene file, and the whole complaint about it.
TEXTS = {
    "unknown key": ("name: x\nfrction: 1", f"a.yaml:2: frction: unknown key; allowed: {SCENE_KEYS}; did you mean 'friction'?"),
    "unknown nested key": ("gel:\n  size: [1, 1, 1]\n  materal: silicone",
                           "a.yaml:3: gel.materal: unknown key; allowed: size, material, housing; did you mean 'material'?"),
    "unknown key in a variant": ("body:\n  geometry:\n    shape: box\n    radius: 1",
                                 "a.yaml:4: body.geometry.radius: unknown key; allowed: shape, size"),
    "unknown entry": ("friction: {uper: 1, lower: 1}",
                      "a.yaml:1: friction.uper: unknown key; allowed: lower, upper; did you mean 'upper'?"),
    "a gel of no sensor": ("gels:\n  uper: {housing: 0 mm}", "a.yaml:2: gels.uper: unknown key; allowed: lower, upper; did you mean 'upper'?"),
    "unknown key of one gel": ("gels:\n  upper:\n    sise: [1, 1, 1]",
                               "a.yaml:3: gels.upper.sise: unknown key; allowed: size, material, housing, element_size; did you mean 'size'?"),
    "no material of one gel": ("gels:\n  upper:\n    material: jelly",
                               "a.yaml:3: gels.upper.material: no material 'jelly'; allowed: cold-plasticine, dough, modelling-clay, seed, silicone, soft-clay"),
    "a stiffness of one gel": ("gels: {lower: {material: {youngs_modulus: 0 kPa}}}",
                               "a.yaml:1: gels.lower.material.youngs_modulus: 0 kPa is out of range; allowed: a pressure >= 1 Pa and <= 1e+12 Pa, bare in Pa or with a unit (Pa, kPa, MPa, GPa)"),
    "two gels under an indenter": ("extends: press\ngels:\n  upper: {housing: 0 mm}",
                                   "a.yaml:1: gels: an indenter presses the gel 'lower' alone; write what is in gels.upper into gel, leave out gels"),
    "two gels of the seed": ("physics: seed\ngels:\n  upper: {housing: 0 mm}",
                             "a.yaml:1: gels: physics 'seed' has one gel for both; write what is in gels.upper into gel, leave out gels"),
    "a thin gel": ("gels:\n  upper: {size: [8 mm, 8 mm, 1 mm], element_size: 0.6 mm}",
                   "a.yaml:1: element_size 0.0006 m is too coarse for a gel of sensor 'upper' 0.001 m thick: it needs two layers of elements; choose at most 0.0005 m"),
    "range": ("friction:\n  upper: 1\n  lower: 9", "a.yaml:3: friction.lower: 9 is out of range; allowed: a number >= 0 and <= 5"),
    "range of a quantity": ("element_size: -3 mm", f"a.yaml:1: element_size: -3 mm is out of range; allowed: a {LENGTH}, or null"),
    "a yield of nothing": ("body:\n  material:\n    yield_stress: 0 kPa",
                           "a.yaml:3: body.material.yield_stress: 0 kPa is out of range; allowed: a pressure > 0 Pa, bare in Pa or with a unit (Pa, kPa, MPa, GPa), or null"),
    "range in a list": ("gel:\n  size:\n    - 1\n    - 0 mm\n    - 1", f"a.yaml:4: gel.size.1: 0 mm is out of range; allowed: a {LENGTH}"),
    "type": ("settling: {mach: fast}", "a.yaml:1: settling.mach: 'fast' does not fit; allowed: a number > 0 and <= 0.3, or null"),
    "a quoted number": ("settling: {mach: '0.1'}", "a.yaml:1: settling.mach: '0.1' does not fit; allowed: a number > 0 and <= 0.3, or null"),
    "a broken count": ("settling: {max_substeps: 1.5}",
                       "a.yaml:1: settling.max_substeps: 1.5 does not fit; allowed: a whole number >= 0 and <= 1000000"),
    "yes for a number": ("settling: {mach: true}", "a.yaml:1: settling.mach: true does not fit; allowed: a number > 0 and <= 0.3, or null"),
    "yes for a quantity": ("element_size: true", f"a.yaml:1: element_size: true does not fit; allowed: a {LENGTH}, or null"),
    "number for a text": ("name: 1e5", "a.yaml:1: name: 1e5 does not fit; allowed: a text"),
    "list for a mapping": ("gel: [1]", "a.yaml:1: gel: a list of 1 does not fit; allowed: a mapping with keys among size, material, housing"),
    "null": ("gel:", "a.yaml:1: gel: nothing (null) does not fit; allowed: a mapping with keys among size, material, housing"),
    "literal": ("physics: sed", "a.yaml:1: physics: 'sed' is unknown; allowed: hybrid | seed; did you mean 'seed'?"),
    "variant": ("body:\n  geometry: {shape: spere}",
                "a.yaml:2: body.geometry: shape 'spere' is unknown; allowed: box | sphere | cylinder | mesh; did you mean 'sphere'?"),
    "no variant": ("body:\n  geometry:\n    size: [1, 1, 1]",
                   "a.yaml:2: body.geometry: 'shape' is missing; allowed: shape: box | sphere | cylinder | mesh"),
    "missing": ("body: {geometry: {shape: mesh}}", "a.yaml:1: body.geometry.path: is missing; allowed: a text"),
    "short list": ("gel:\n  size: [1]", f"a.yaml:2: gel.size: has 1 entry; allowed: a list of 3, each a {LENGTH}"),
    "long list": ("gel:\n  size: [1, 1, 1, 1]", f"a.yaml:2: gel.size: has 4 entries; allowed: a list of 3, each a {LENGTH}"),
    "unit": ("element_size: 3 mn", "a.yaml:1: element_size: '3 mn': no unit 'mn' for a length; allowed: a number [m], "
             "or a text with its unit (m, mm, cm, um) such as '1.5 mm'; did you mean '3 mm'?"),
    "unit of another kind": ("body: {material: {yield_stress: 3 mm}}", "a.yaml:1: body.material.yield_stress: '3 mm' is a length, "
                             "not a pressure; allowed: a number [Pa], or a text with its unit (Pa, kPa, MPa, GPa) such as '1.5 kPa'"),
    "not finite": ("settling: {mach: .nan}", "a.yaml:1: settling.mach: .nan is not finite; give a finite number"),
    "infinite": ("gel:\n  housing: -.inf", "a.yaml:2: gel.housing: -.inf is not finite; give a finite number"),
    "overflow": ("gel: {housing: 1e999}", "a.yaml:1: gel.housing: 1e999 is not finite; give a finite number"),
    "a model's own rule": ("name: x\nbody:\n  material: {yield_stress: 3, yield_strain: 0.1}",
                           "a.yaml:3: body.material: give yield_stress or yield_strain, not both"),
    "half of a mapping": ("friction: {upper: 1}", "a.yaml:1: friction of the surface 'lower' is missing; give both lower and upper"),
    "unknown name": ("body:\n  material: doh", "a.yaml:2: body.material: no material 'doh'; allowed: cold-plasticine, dough, "
                     "modelling-clay, seed, silicone, soft-clay; did you mean 'dough'?"),
    "missing file": ("body:\n  material: my/clay.yaml", "a.yaml:2: body.material: there is no file 'my/clay.yaml'; there is no folder 'my' either; `tacsim new material NAME` writes one, `tacsim list material` prints the shipped ones"),
    "no name": ("body: {material: a b}", "a.yaml:1: body.material: 'a b' is no material; allowed: a name (cold-plasticine, dough, "
                "modelling-clay, seed, silicone, soft-clay), or a path ending in .yaml"),
    "unknown base": ("name: x\nextends: sqeeze", "a.yaml:2: extends: no scene 'sqeeze'; allowed: drawer, hold, knead, peg, press, relief, reposition, squeeze, turn; did you mean 'squeeze'?"),
    "base of a wrong type": ("extends: [squeeze]", "a.yaml:1: extends: a list of 1 does not fit; allowed: the name of a scene, or a path"),
    "itself": ("a.yaml", "a.yaml:1: the references form a circle: a.yaml -> a.yaml; break it in one of them"),
    "duplicate": ("name: x\npreset: draft\nname: y", "a.yaml:3: name: the key occurs twice, first at a.yaml:1; keep one"),
    "nested duplicate": ("gel:\n  housing: 1\n  housing: 2", "a.yaml:3: gel.housing: the key occurs twice, first at a.yaml:2; keep one"),
    "anchor": ("gel:\n  size: &s [1, 1, 1]", "a.yaml:2: anchors (&) and aliases (*) are not allowed; write the value out, or refer to a file by its name"),
    "merge": ("name: x\n<<: {preset: draft}", "a.yaml:2: <<: merge keys are not allowed; use 'extends: NAME' instead"),
    "tag": ("name: !!python/object/apply:os.system [ls]", "a.yaml:1: tags are not allowed (tag:yaml.org,2002:python/object/apply:os.system); leave it out"),
    "own tag": ("name: !x y", "a.yaml:1: tags are not allowed (!x); leave it out"),
    "syntax": ("name: x\ngel: [1, 2", "a.yaml:2: not valid YAML: while parsing a flow sequence, expected ',' or ']', but got '<stream end>'"),
    "tab": ("gel:\n\tsize: 1", "a.yaml:2: not valid YAML: while scanning for the next token, found character '\\t' that cannot start any token"),
    "two documents": ("name: x\n---\nname: y", "a.yaml:2: not valid YAML: expected a single document in the stream, but found another document"),
    "control character": ("name: x\nfoo: \x07", "a.yaml:2: not valid YAML: the character '\\x07' is not allowed"),
    "half a character": ('name: "\\ud800"', "a.yaml:1: name: '\\ud800' is no Unicode text (it holds half of a surrogate pair)"),
    "key that is a list": ("? [a]\n: 1", "a.yaml:1: a key must be a plain text, not a list or a mapping"),
    "empty": ("", "a.yaml:1: the file is empty; allowed: a mapping of keys to values"),
    "only comments": ("# nothing\n\n", "a.yaml:1: the file is empty; allowed: a mapping of keys to values"),
    "no mapping": ("5", "a.yaml:1: 5 does not fit; allowed: the name of a scene (drawer, hold, knead, peg, press, relief, reposition, squeeze, turn), or a mapping with keys among " + SCENE_KEYS),
    "deep": ("\n".join(" " * i + "a:" for i in range(40)), "a.yaml:32: nested too deeply; at most 32 levels are allowed"),
    "escape code": ('"\\e[31mred": 1', f"a.yaml:1: \\x1b[31mred: unknown key; allowed: {SCENE_KEYS}"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), TEXTS.values(), ids=TEXTS)
def test_text(text: str, message: str, folder: Path) -> None:
    (folder / "a.yaml").write_text(text)
    assert complaint() == message


def test_all_problems_are_listed_in_the_order_of_lines(folder: Path) -> None:
    (folder / "a.yaml").write_text(
        "frction: 1\nbody:\n  geometry: {shape: box, size: [1, 3 mn]}\n  material: doh\n"
        "gel: {size: 3}\nphysics: x\nname: 1\nname: 2\nelement_size: .inf\n"
    )
    starts = [line.split(":")[1] + line.split(":")[2] for line in complaint().splitlines()]
    assert starts == [
        "1 frction", "3 body.geometry.size.1", "3 body.geometry.size", "4 body.material", "5 gel.size", "6 physics",
        "7 name", "8 name", "9 element_size",
    ]  # fmt: skip


@pytest.mark.slow
def test_thousands_of_problems_are_cut_short(folder: Path) -> None:
    (folder / "a.yaml").write_text("\n".join(f"key{i}: 1" for i in range(5000)))
    lines = complaint().splitlines()
    assert len(lines) == 31
    assert lines[-1] == "... and 4970 more problems"


def test_a_problem_in_a_referenced_file_is_reported_there(folder: Path) -> None:
    (folder / "parts").mkdir()
    (folder / "parts/clay.yaml").write_text("# a clay\nextends: dough\nyield_stress: soft\n")
    (folder / "parts/scene.yaml").write_text("body:\n  material: clay.yaml\nfriction: 3\n")
    (folder / "rig.yaml").write_text("extends: sim\nscene: parts/scene.yaml\nperiod: 0\n")
    assert [line.rpartition(";")[0] for line in complaint(load_rig, "rig.yaml").splitlines()] == [
        "rig.yaml:3: period: 0 is out of range",
        "parts/clay.yaml:3: scene.body.material.yield_stress: 'soft' is no pressure",
        "parts/scene.yaml:3: scene.friction: 3 does not fit",
    ]
    dough = config_root() / "materials/dough.yaml"
    line = dough.read_text().splitlines().index("yield_stress: 5 kPa") + 1
    (folder / "a.yaml").write_text("gel: {material: dough}")
    shown = dough.relative_to(folder) if dough.is_relative_to(folder) else dough
    assert complaint().startswith(f"{shown}:{line}: gel.material.yield_stress: unknown key; allowed: youngs_modulus,")


def test_union_and_discriminated_fields_keep_their_lines(folder: Path) -> None:
    text = "lighting:\n  background:\n    - 1\n    - 9\n    - 1\n  lights:\n    - {direction: [0, 0, -1], colour: [1, 1]}\n"
    (folder / "a.yaml").write_text(text)
    assert complaint(load_sensor).splitlines() == [
        "a.yaml:4: lighting.background.1: 9 is out of range; allowed: a number >= 0 and <= 4",
        "a.yaml:7: lighting.lights.0.colour: has 2 entries; allowed: a list of 3, each a number >= 0 and <= 4",
    ]
    (folder / "a.yaml").write_text(
        "name: x\nclock: sim\nscene: press\narms:\n  lower: {driver: sim, x: 1}\nsensors:\n"
        "  lower:\n    driver: sim\n    arm: lwer\n    model: {texture: x}\n  Up:\n    driver: real\n"
    )
    assert [line.partition(";")[0] for line in complaint(load_rig).splitlines()] == [
        "a.yaml:5: arms.lower.x: unknown key",
        "a.yaml:10: sensors.lower.model.texture: 'x' is no length",
        "a.yaml:11: sensors.Up: 'Up' is no name",
        "a.yaml:11: sensors.Up: driver 'real' is unknown",
    ]


def test_an_arm_that_is_not_there_is_reported_at_the_sensor(folder: Path) -> None:
    (folder / "a.yaml").write_text("extends: sim\nsensors:\n  upper:\n    arm: uper\n")
    assert complaint(load_rig) == "a.yaml:4: sensors.upper.arm: no arm 'uper'; allowed: lower, upper"


OVERRIDES = {
    "scene.presett=draft": f"scene.presett: unknown key; allowed: {SCENE_KEYS}; did you mean 'preset'?",
    "scne.preset=draft": "scne: unknown key; allowed: name, clock, period, task, scene, arms, grippers, sensors, cameras, canonical, motion, lock_step, contact, keep_out, start, record; did you mean 'scene'?",
    "scene.body.material=doh": "scene.body.material: no material 'doh'; allowed: cold-plasticine, dough, modelling-clay, seed, silicone, "
    "soft-clay; did you mean 'dough'?",
    "scene=missing.yaml": f"scene: there is no file 'missing.yaml'{NEW_SCENE}",
    "period=3 mm": "period: '3 mm' is a length, not a time; allowed: a number [s], or a text with its unit (s, ms, us, min) such as '1.5 ms'",
    "record.arm_packages=true": "record.arm_packages: this rig has no UR arm, whose packages could be recorded; leave it out",
    "name.x=1": "name.x: 'name' is 'sim', which has no keys",
    "sensors.upper.model.lighting.lights.3.colour=[1, 1, 1]": "sensors.upper.model.lighting.lights.3: no such entry; "
    "allowed: an index from 0 to 2",
    "clock={a: 1}": "clock: a mapping does not fit; allowed: sim | mujoco | wall | replay",
    "scene.friction.upper=.nan": ".nan is not finite; give a finite number",
    "period=[": "not valid YAML: while parsing a flow node, expected the node content, but found '<stream end>'",
    "period=&a 1": "anchors (&) and aliases (*) are not allowed; write the value out, or refer to a file by its name",
    "period": "allowed: key.sub=value, for example scene.preset=standard",
    "=1": "allowed: key.sub=value, for example scene.preset=standard",
    "scene..preset=draft": "allowed: key.sub=value, for example scene.preset=standard",
}


@pytest.mark.parametrize(("override", "message"), OVERRIDES.items())
def test_text_of_a_wrong_override(override: str, message: str, empty_folder: Path) -> None:
    assert complaint(load_rig, "sim", overrides=[override]) == f"--set {override}: {message}"


def test_a_mount_of_a_mock_needs_lock_step() -> None:
    free = ["lock_step=false", "arms.upper.mock.mount.stiffness=2 N/mm"]
    assert "a mock mount gives way once in a control period, so it needs lock_step: true" in complaint(
        load_rig, "mock", overrides=free
    )
    assert load_rig("mock", overrides=free[1:])


def test_a_file_that_is_not_there_lists_the_names() -> None:
    assert (
        complaint(load_rig, "simm")
        == "simm: no rig 'simm'; allowed: hand, mock, press, replay, sim, stand, ur5e, ur5e-mujoco, ur5e-one; did you mean 'sim'?"
    )
    assert complaint(load_rig, "my/rig.yaml") == (
        "my/rig.yaml: there is no file 'my/rig.yaml'; there is no folder 'my' either; `tacsim new rig NAME` writes one, "
        "`tacsim list rig` prints the shipped ones"
    )
    wrong_task = complaint(load_rig, "sim", task="sqeeze")
    assert (
        wrong_task
        == "--task sqeeze: task: no task 'sqeeze'; allowed: drawer, hold, knead, lengthen, peg, relief, reposition, squeeze, turn; did you mean 'squeeze'?"
    )


# Hostile files


def quick(source: str = "a.yaml", seconds: float = 10.0) -> str:
    start = time.process_time()
    text = complaint(load_scene, source)
    assert time.process_time() - start < seconds
    assert len(text) < 2000
    return text


def test_cyclic_references(folder: Path) -> None:
    (folder / "a.yaml").write_text("extends: b.yaml")
    (folder / "b.yaml").write_text("name: b\nextends: c.yaml")
    (folder / "c.yaml").write_text("./b.yaml")
    assert complaint() == (
        "c.yaml:1: the references form a circle: b.yaml -> c.yaml -> b.yaml; break it in one of them"
    )


def test_a_long_chain_of_files_is_refused(folder: Path) -> None:
    for i in range(40):
        (folder / f"f{i}.yaml").write_text(f"f{i + 1}.yaml")
    assert quick("f0.yaml") == "f15.yaml:1: more than 16 files refer to each other in a row; shorten the chain"


def test_alias_bomb(folder: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    (folder / "a.yaml").write_text("\n".join(lines))
    assert "a.yaml:1: anchors (&) and aliases (*) are not allowed" in quick()


@pytest.mark.slow
def test_a_bomb_of_references(folder: Path) -> None:
    (folder / "big.yaml").write_text("extends: ideal\nlighting: {lights: [" + "{direction: [0, 0, -1]}, " * 2000 + "]}")
    sensors = "\n".join(f"  s{i}: {{driver: sim, arm: upper, model: big.yaml}}" for i in range(2000))
    (folder / "rig.yaml").write_text(f"extends: sim\nsensors:\n{sensors}")
    start = time.process_time()
    assert "too many values; at most 20000 are allowed" in complaint(load_rig, "rig.yaml")
    assert time.process_time() - start < 20


def test_a_large_file_is_not_even_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "a.yaml").write_bytes(b"# " + b"x" * 10_000_000)
    monkeypatch.setattr(Path, "open", lambda *_, **__: pytest.fail("opened a file that is too large"))
    assert complaint() == "a.yaml: 'a.yaml' has 10.0 MB; at most 1 MB is allowed"


@pytest.mark.parametrize("text", ["[" * 500_000, "{a: " * 200_000, "- " * 400_000, "? " * 400_000, "[1, " * 200_000])
def test_huge_nesting(folder: Path, text: str) -> None:
    (folder / "a.yaml").write_text(text)
    assert quick() == "a.yaml:1: nested too deeply; at most 32 levels are allowed"


@pytest.mark.slow
def test_many_values(folder: Path) -> None:
    (folder / "a.yaml").write_text("x: [" + "1," * 200_000 + "]")
    assert quick() == "a.yaml:1: too many values; at most 20000 are allowed, referenced files included"


def test_huge_numbers(folder: Path) -> None:
    (folder / "a.yaml").write_text("element_size: " + "9" * 100_000)
    assert "is not finite" in quick()


def test_not_a_file(folder: Path) -> None:
    (folder / "dir.yaml").mkdir()
    assert complaint(source="dir.yaml") == "dir.yaml: 'dir.yaml' is a folder; give a YAML file"
    assert complaint(source=folder) == f"{folder}: '.' is a folder; give a YAML file"
    os.mkfifo(folder / "pipe.yaml")
    assert complaint(source="pipe.yaml") == "pipe.yaml: 'pipe.yaml' is no regular file; give a YAML file"
    assert "is no regular file" in complaint(source="/dev/zero")
    (folder / "loop.yaml").symlink_to("loop.yaml")
    assert "loop.yaml: cannot read 'loop.yaml': " in complaint(source="loop.yaml")
    assert "cannot read" in complaint(source="a\0b.yaml")
    assert complaint(source="x" * 300 + ".yaml").endswith("File name too long")


def test_not_utf8(folder: Path) -> None:
    (folder / "a.yaml").write_bytes(b"name: ok\nsource: caf\xe9\n")
    assert complaint() == "a.yaml:2: byte 0xe9 is not UTF-8; save the file as UTF-8 text"
    (folder / "a.yaml").write_bytes("name: ok".encode("utf-16"))
    assert complaint() == "a.yaml:1: byte 0xff is not UTF-8; save the file as UTF-8 text"
    (folder / "a.yaml").write_bytes(b"\xef\xbb\xbfname: caf\xc3\xa9")  # a byte order mark is no fault
    assert load_scene("a.yaml").name == "café"


# Nothing but ConfigError, whatever is in the file

KEYS = ["name", "scene", "task", "arms", "sensors", "body", "gel", "geometry", "shape", "size", "material", "extends", "driver",
        "kind", "friction", "lights", "lighting", "model", "background", "upper", "lower", "goal", "x", "0", "<<"]  # fmt: skip
VALUES = ["sim", "squeeze", "press", "ideal", "dough", "a.yaml", "../a.yaml", "box", "mesh", "1", "-1e400", ".nan", "3 mm", "3 mn",
          "null", "true", "", "*a", "&a b", "!t x", "[", "}", "'", '"', "|", "a: b", "[1, 2]", "{shape: sphere}", "\t", "é",
          "\x00", "\u2028", '"\\ud800"', '"\\Uffffffff"', "%YAML 1.1", "---", "? ", "- - "]  # fmt: skip
tree = st.recursive(
    st.sampled_from(VALUES),
    lambda inner: (
        st.lists(inner, max_size=3).map(lambda items: "[" + ", ".join(items) + "]")
        | st.lists(st.tuples(st.sampled_from(KEYS), inner), max_size=4).map(
            lambda pairs: "{" + ", ".join(f"{key}: {value}" for key, value in pairs) + "}"
        )
    ),
    max_leaves=12,
)
lines = st.lists(st.tuples(st.sampled_from(["", "  ", "    ", "- "]), st.sampled_from(KEYS), tree), max_size=8).map(
    lambda rows: "\n".join(f"{indent}{key}: {value}" for indent, key, value in rows)
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.one_of(st.text(), lines, st.binary()), load=st.sampled_from([load_rig, load_scene, load_sensor]))
@example(content='name: "\\Uffffffff"', load=load_scene)
@example(content="%YAML 1.99999999999999999999\n---\na: 1", load=load_scene)
def test_any_content_loads_or_raises_config_error(content: str | bytes, load, folder: Path) -> None:
    raw = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    (folder / "a.yaml").write_bytes(raw)
    try:
        load("a.yaml")
    except ConfigError as error:
        check_printable(error)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.lists(st.sampled_from(KEYS), min_size=1, max_size=5), st.one_of(tree, st.text())).map(
            lambda pair: f"{'.'.join(pair[0])}={pair[1]}"
        )
        | st.text(),
        max_size=3,
    )
)
def test_any_override_applies_or_raises_config_error(overrides: list[str]) -> None:
    try:
        load_rig("sim", overrides=overrides)
    except ConfigError as error:
        check_printable(error)


@settings(max_examples=200, deadline=None)
@given(st.text())
def test_any_name_loads_or_raises_config_error(name: str) -> None:
    try:
        load_rig(name, task=name)
    except ConfigError as error:
        check_printable(error)


def check_printable(error: ConfigError) -> None:
    text = str(error)
    assert text
    assert "Traceback" not in text
    assert all(line.isprintable() and ": " in line for line in text.split("\n") if not line.startswith("... and"))
    assert isinstance(error, ValueError)


def test_a_file_that_is_not_there_hints_at_a_near_one(folder: Path) -> None:
    (folder / "cell.yaml").write_text("extends: sim")
    near = "cel.yaml: there is no file 'cel.yaml'; did you mean 'cell.yaml'?"
    assert complaint(load_rig, "cel.yaml") == near
    assert complaint(load_rig, "cell").endswith("; did you mean the file 'cell.yaml'?")
    shipped = "; the shipped rig is called 'mock', without an ending"
    assert complaint(load_rig, "mock.yaml") == f"mock.yaml: there is no file 'mock.yaml'{shipped}"
    others = "; files there: cell.yaml; `tacsim new rig NAME` writes one"
    assert others in complaint(load_rig, "x.yaml")
