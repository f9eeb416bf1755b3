"""Gel pads in MuJoCo scenes: hold, slip, energy, batches, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from tacsim.config import load_sensor
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Gel, Mesh, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.sim.engines.mujoco_module import load_mujoco, require_major
from tacsim.sim.engines.touch import ObjectDropped, TouchSensor, step_each, step_together
from tests.tacsim.sim.engines.gripper import BALL, BOX, ROD, grip, hold, load, object_dofs, scene

SITES = ("left", "right")
COULOMB = 0.6


def sensor(xml: str, objects: str = "thing", friction: float | None = COULOMB, **options: Any) -> TouchSensor:
    return TouchSensor(*load(xml), SITES, objects, friction=friction, **options)


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (0.0, -6.0, -7.76), (-5.0, -5.0, -6.8)])
@pytest.mark.parametrize(("geom", "width"), [(BOX, 0.01), (BALL, 0.01), (ROD, 0.008)], ids=["box", "ball", "rod"])
def test_the_pads_carry_the_weight_and_nothing_creeps(
    geom: str, width: float, gravity: tuple[float, float, float]
) -> None:
    touch = sensor(scene(geom, 0.05, width, gravity=gravity))
    grip(touch, 4.0, 0.5)
    weight = 0.05 * np.array(gravity)
    assert np.linalg.norm(touch.world_forces.sum(axis=0) - weight) < 1e-3 * np.linalg.norm(weight)
    place = touch.poses()[0, :3]
    hold(touch, 0.2, lambda time: 4.0)
    assert np.abs(touch.poses()[0, :3] - place).max() / 0.2 < 1e-6  # [m/s]


@pytest.mark.slow
def test_a_pushed_box_slips_where_coulombs_law_says() -> None:
    touch = sensor(scene(mass=0.05, gravity=(0, 0, 0)))
    grip(touch, 3.0, 0.3)
    dofs, limit = object_dofs(touch.model), 2 * COULOMB * 3.0
    start, before = touch.poses()[0, :2], 0.0
    for share in np.arange(0.9, 1.1, 0.01):
        touch.data.qvel[:] = 0.0

        def watch(time: float, push: float = share * limit) -> None:
            touch.data.qfrc_applied[dofs.start + 2] = -push

        hold(touch, 0.05, lambda time: 3.0, watch=watch)
        slid = float(np.linalg.norm(touch.poses()[0, :2] - start))
        if slid - before > 0.3e-3 and before > 0.0:
            break
        before = slid
    assert 1.0 <= share <= 1.03 and slid < 5e-3
    assert touch.slip_share("left") == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_a_sliding_box_is_braked_by_the_friction_that_the_gels_feel() -> None:
    """Stiffness along the surface, without a limit, would brake it like a viscous fluid."""
    touch = sensor(scene(mass=0.1, gravity=(0, 0, 0)), gel=Gel(housing=None))
    grip(touch, 3.0, 0.3)
    dofs, push, speeds, drags = object_dofs(touch.model), 1.2 * 2 * COULOMB * 3.0, list[float](), list[float]()

    def watch(time: float) -> None:
        touch.data.qfrc_applied[dofs.start + 2] = -push
        speeds.append(-float(touch.data.qvel[dofs.start + 2]))
        drags.append(-float(touch.world_forces[:, 2].sum()))

    hold(touch, 0.03, lambda time: 3.0, watch=watch)
    sliding = slice(12, 29)
    assert np.array(drags[sliding]) == pytest.approx(push / 1.2, rel=0.15)
    gained = (speeds[29] - speeds[12]) * 0.1 / 17e-3
    assert gained == pytest.approx(push - np.mean(drags[13:30]), abs=0.03 * push)


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.005, 0.05, 0.5])
def test_light_and_heavy_boxes_are_held_through_pokes(mass: float) -> None:
    touch = sensor(scene(mass=mass, finger=0.05))
    grip(touch, 6.0, 0.3)
    dofs, random = object_dofs(touch.model), np.random.default_rng(3)
    place = touch.poses()[0, :3]
    for _ in range(5):
        poke = random.normal(size=3)

        def watch(time: float, poke: np.ndarray = poke) -> None:
            touch.data.qfrc_applied[dofs.start : dofs.start + 3] = 0.5 * poke * (time < 0.01)

        hold(touch, 0.06, lambda time: 6.0, watch=watch)
    hold(touch, 0.1, lambda time: 6.0)
    touch.require_held()
    assert np.abs(touch.poses()[0, :3] - place).max() < 0.5e-3
    assert np.abs(touch.data.qvel[dofs])[:3].max() < 2e-3 and np.abs(touch.data.qvel[dofs])[3:].max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.005, 0.2])
def test_a_held_box_is_pressed_on_a_table_and_all_forces_balance(mass: float) -> None:
    """The contact with the table is MuJoCo's, and stiff."""
    touch = sensor(scene(mass=mass, table=True))
    mujoco, table = load_mujoco(), np.zeros(6)
    for number in range(600):
        touch.data.ctrl[:2] = 3.0 * min(1.0, number / 100)
        touch.data.ctrl[2] = -0.3e-3 * min(1.0, max(0.0, (number - 200) / 200))
        touch.step()
    pushed = 0.0
    for number in range(touch.data.ncon):
        mujoco.mj_contactForce(touch.model, touch.data, number, table)
        pushed += table[0]
    held = touch.world_forces[:, 2].sum()
    assert held > 0.15 and pushed == pytest.approx(held + mass * 9.81, rel=1e-3)
    assert np.abs(touch.data.qvel[object_dofs(touch.model)]).max() < 1e-4


@pytest.mark.slow
def test_a_dropped_object_is_reported() -> None:
    touch = sensor(scene())
    touch.require_held()  # nothing was held so far
    grip(touch, 3.0, 0.2)
    touch.require_held()
    hold(touch, 0.25, lambda time: -1.0)
    with pytest.raises(ObjectDropped, match=r"'thing' was dropped: at 0.45 s none of its pads left, right touches it"):
        touch.require_held()
    touch.reset()
    touch.require_held()


@pytest.mark.slow
@pytest.mark.cpu
def test_a_scene_of_a_batch_has_the_bits_that_it_has_alone_and_after_a_restore() -> None:
    xmls = [scene(mass=mass, gravity=(0.0, -3.0, -9.0)) for mass in (0.02, 0.1)]
    sensors = TouchSensor.batch([load(xml) for xml in xmls], SITES, "thing", friction=COULOMB)

    def drive(touches: list[TouchSensor], first: int, last: int) -> None:
        for number in range(first, last):
            for touch in touches:
                touch.data.ctrl[:2] = 3.0 * min(1.0, number / 40)
            step_together(touches)

    drive(sensors, 0, 60)
    kept = sensors[1].snapshot()
    drive(sensors, 60, 80)
    alone = sensor(xmls[1])
    drive([alone], 0, 80)
    ends = [np.concatenate([each.data.qpos, each.data.qvel, each.wrenches.ravel()]) for each in (sensors[1], alone)]
    assert np.array_equal(*ends) and (np.abs(alone.wrenches[:, 2]) > 1.0).all()
    alone.restore(kept)
    drive([alone], 60, 80)
    assert np.array_equal(ends[1], np.concatenate([alone.data.qpos, alone.data.qvel, alone.wrenches.ravel()]))
    with pytest.raises(ValueError, match="needs all sensors of one batch"):
        step_together(sensors[:1])
    kept = sensors[0].snapshot()
    drive([alone], 80, 90)
    for number in range(80, 90):
        sensors[1].data.ctrl[:2] = 3.0 * min(1.0, number / 40)
        assert step_each(sensors[1:]) == [None]
    assert np.array_equal(sensors[1].data.qpos, alone.data.qpos) and np.array_equal(sensors[1].wrenches, alone.wrenches)
    assert all(np.array_equal(kept[name], value) for name, value in sensors[0].snapshot().items())
    sensors[0].data.qpos[-7] += 0.1  # the object jumps
    (jumped, moved), time = step_each(sensors), float(sensors[1].data.time)
    assert "pad 'left' moves by 100 mm" in str(jumped) and moved is None
    assert time > float(sensors[0].data.time) + 9.5e-3


def test_a_pad_gives_pictures_and_surfaces_by_its_name() -> None:
    touch = sensor(scene(), sensor=load_sensor("ideal"))
    touch.step()
    assert touch.picture("left").dtype == np.uint8 and not touch.surface("right").displacement.any()
    with pytest.raises(KeyError, match="no pad 'middle'; this sensor has left, right"):
        touch.picture("middle")
    with pytest.raises(ValueError, match="have no camera"):
        sensor(scene()).picture("left")


MESH = '<mesh name="m" file="{file}" scale=".001 .001 .001"/>'


def test_what_mujoco_and_the_gels_describe_differently_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'thing' is a box of 20 mm x 12 mm x 16 mm in MuJoCo and a box of 20 mm x"):
        sensor(scene(), geometry={"thing": Box(size=(20e-3, 12e-3, 20e-3))})
    with pytest.raises(ValueError, match=r"is a box of .* in MuJoCo and a sphere of 10 mm for the gels"):
        sensor(scene(), geometry={"thing": Sphere(radius=10e-3)})
    with pytest.raises(ValueError, match="'thing' is a capsule; gels know box, sphere, cylinder and mesh"):
        sensor(scene("type='capsule' size='.01 .01'"))


@pytest.mark.slow
def test_a_mesh_must_be_the_same_in_mujoco_and_the_gels(tmp_path: Path) -> None:
    file = tmp_path / "part.stl"
    part = trimesh.util.concatenate([trimesh.creation.box((20.0, 12.0, 16.0))])
    part.apply_translation([0.0, 2.0, 1.0])
    part.export(file)
    xml = scene("type='mesh' mesh='m'", asset=MESH.format(file=file))
    with pytest.raises(ValueError, match="'thing' is a mesh: give its file to the gels too"):
        sensor(xml)
    with pytest.raises(ValueError, match=r"is a mesh for the gels .* but not in MuJoCo"):
        sensor(scene(), geometry={"thing": Mesh(path=str(file))})
    with pytest.raises(ValueError, match="its mesh is 20 x 12 x 16 mm in MuJoCo and 40 x 24 x 32 mm in"):
        sensor(xml, geometry={"thing": Mesh(path=str(file), scale=2e-3)})
    touch = sensor(xml, geometry={"thing": Mesh(path=str(file), scale=1e-3)})
    touch.step()  # the middle of the mesh is beside the origin of its file
    assert touch.poses()[:, :3] == pytest.approx(np.array([[-1, 2, 10.5], [1, 2, 10.5]]) * 1e-3, abs=1e-6)


def test_pads_and_objects_that_are_not_there_are_refused_with_those_that_are() -> None:
    with pytest.raises(ValueError, match="pad 'thumb': the model has no site of that name, only 'left', 'right'; add"):
        TouchSensor(*load(scene()), ("left", "thumb"), "thing")
    with pytest.raises(ValueError, match="'cup': the model has no geom or body of that name; bodies are 'world', 'ba"):
        sensor(scene(), "cup")
    with pytest.raises(ValueError, match="3 objects for 2 pads"):
        TouchSensor(*load(scene()), SITES, ["thing"] * 3)
    with pytest.raises(ValueError, match="geometry of 'cup', which is none of the objects"):
        sensor(scene(), geometry={"cup": Sphere()})
    model, data = load(scene())
    model.body("object").mass[0] = 0.0
    model.body_subtreemass[model.body("object").id] = 0.0
    with pytest.raises(ValueError, match="'thing' can move and has a mass of 0 kg"):
        TouchSensor(model, data, SITES, "thing")


def test_a_geom_of_mujoco_in_the_place_of_the_gel_is_refused() -> None:
    solid = '<site name="left"'
    pad = '<geom name="rubber" type="box" size=".01 .01 .002" pos="-.002 0 0" quat=".7071068 0 .7071068 0"/>'
    with pytest.raises(
        ValueError, match=r"pad 'left': geom 'rubber' of its body lies 0\.00 mm below the gel's surface"
    ):
        sensor(scene().replace(solid, pad + solid))
    sensor(scene().replace(solid, pad.replace("/>", ' contype="0" conaffinity="0"/>') + solid))
    sensor(scene(extra='<contact><exclude body1="left" body2="object"/></contact>').replace(solid, pad + solid))


def test_integrators_and_timesteps_that_the_coupling_does_not_know_are_refused() -> None:
    with pytest.raises(ValueError, match="RK4 evaluates forces four times a step: use Euler"):
        sensor(scene().replace("implicitfast", "RK4"))
    touch = sensor(scene())
    touch.model.opt.timestep = 2e-3
    with pytest.raises(ValueError, match=r"timestep is 0.002 s and was 0.001 s when the sensor was made"):
        touch.step()


def test_a_reset_by_mujoco_itself_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    touch = sensor(scene())
    touch.step()
    touch.data.qfrc_applied[0] = 1e20
    touch.step()
    with pytest.raises(SimulationDiverged, match=r"MuJoCo found the acceleration .* at degree of freedom 0"):
        touch.step()


def test_a_step_too_long_for_the_stiffness_is_refused_with_one_that_holds() -> None:
    stiff = Gel(material=GelMaterial(youngs_modulus=1e6))
    with pytest.raises(ValueError, match=r"timestep of 0\.01 s is too long .*; set a timestep of at most 0\.003 s"):
        sensor(scene(timestep=10e-3, mass=0.005), gel=stiff)
    sensor(scene(timestep=2e-3, mass=0.005), gel=stiff)


def test_mujoco_is_asked_for_by_its_major_version() -> None:
    require_major(load_mujoco().__version__)
    with pytest.raises(ImportError, match=r"MuJoCo 3\.9\.0 is installed, but tacsim is written for version 4"):
        require_major("3.9.0")


def test_without_mujoco_tacsim_is_imported_and_the_error_names_the_extra() -> None:
    program = """
import sys
sys.modules["mujoco"] = None
import tacsim, robot
tacsim.TactilePads
try:
    tacsim.TouchSensor(None, None, ["left"], "thing")
except ImportError as error:
    assert "pip install 'tacsim[mujoco]'" in str(error), error
else:
    sys.exit("no error")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
