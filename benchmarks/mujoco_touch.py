"""Rigid objects between gel pads in MuJoCo: `python -m benchmarks.mujoco_touch [NAME ...]`.

Measures weight against shear, creep, stick limit, drag of slides, stability, energy and cost, one group a function; all
without names. docs/mujoco.md has the table. Needs the extra `mujoco`.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.harness.machine import Run
from benchmarks.truth.finite_elements import SLIDES
from tacsim.interface import FloatArray, Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Preset, Scene, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.pads.pads import GelPads
from tacsim.physics.world import make_world
from tacsim.sim.engines.touch import ObjectDropped, TouchSensor, step_together

GRAVITY, FRICTION = 9.81, 0.6
RADIUS = 7e-3  # of a rod that lies on its side [m]
SPEEDS = (5e-3, 20e-3, 100e-3)  # [m/s]
MESHES: tuple[Preset, ...] = ("learn", "draft")
SHAPES = {  # MuJoCo's geom, half its width between the pads [m]
    "box": ("type='box' size='.01 .006 .008'", 0.010),
    "ball": ("type='sphere' size='.01'", 0.010),
    "rod": ("type='cylinder' size='.008 .009'", 0.008),
}
FINGER = """<body name="{side}" pos="{x} 0 0"><joint name="{side}" type="slide" axis="{way} 0 0" damping="2"/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>
<geom type="box" size=".002 .01 .01" pos="{gel} 0 0" contype="0" conaffinity="0" rgba=".2 .7 .9 .5"/>
<geom type="box" size=".004 .012 .012" pos="{back} 0 0" contype="0" conaffinity="0" rgba=".35 .35 .35 1"/>
<site name="{side}" quat=".7071068 0 {turn} 0" size="1e-4"/></body>"""
SCENE = """<mujoco><option timestep="{step}" integrator="implicitfast" gravity="{gravity}"/><visual>
<headlight ambient=".5 .5 .5" diffuse=".5 .5 .5"/><map znear=".01"/></visual><worldbody>
<body name="base"><joint name="lift" type="slide" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
{fingers}</body><body name="object"><freejoint/><geom name="object" mass="{mass}" rgba=".9 .5 .2 1" {geom}/></body>
</worldbody>
<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality><actuator>
<motor name="left" joint="left"/><motor name="right" joint="right"/>
<position name="lift" joint="lift" kp="20000" kv="300"/></actuator></mujoco>"""


class Grip:
    """A gripper of two fingers around an object, closed by a force."""

    def __init__(
        self, shape: str, mass: float = 0.05, *, step: float = 1e-3, modulus: float = 0.145e6, finger: float = 0.1,
        gravity: FloatArray | None = None, preset: Preset = "learn",
    ) -> None:  # fmt: skip
        geom, width = SHAPES[shape]
        down = np.array([0.0, 0.0, -GRAVITY]) if gravity is None else gravity
        fingers = "".join(
            FINGER.format(
                side=side,
                x=way * -(width + 0.5e-3),
                way=way,
                turn=way * 0.7071068,
                mass=finger,
                gel=-0.002 * way,
                back=-0.008 * way,
            )
            for side, way in (("left", 1), ("right", -1))
        )
        xml = SCENE.format(step=step, gravity=" ".join(map(str, down)), fingers=fingers, mass=mass, geom=geom)
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.options: dict[str, Any] = {
            "gel": Gel(material=GelMaterial(youngs_modulus=modulus), housing=None), "friction": FRICTION,
            "preset": preset,
        }  # fmt: skip
        self.touch = TouchSensor(self.model, self.data, ("left", "right"), "object", **self.options)
        self.mass, self.weight, self.force = mass, mass * down, 0.0
        first = int(self.model.body_dofadr[self.model.body("object").id])
        self.dofs = slice(first, first + 6)

    def run(
        self, seconds: float, force: Callable[[float], float] | None = None,
        push: Callable[[float], FloatArray] | None = None,
    ) -> Iterator[float]:  # fmt: skip
        """Steps with a grip force, and a push on the object (6,) in world; gives the time before each step."""
        for number in range(round(seconds / self.model.opt.timestep)):
            now = number * self.model.opt.timestep
            self.force = self.force if force is None else force(now)
            self.data.ctrl[:2] = self.force
            self.data.qfrc_applied[:] = 0.0
            if push is not None:
                self.data.qfrc_applied[self.dofs] = push(now)
            yield now
            self.touch.step()

    def wait(self, seconds: float, **options: Any) -> None:
        for _ in self.run(seconds, **options):
            pass

    def close(self, force: float, seconds: float = 0.1) -> None:
        """Closes with a ramp, and carries the object until it is held."""
        drag = 2 * np.sqrt(500 * self.mass) * np.array([1, 1, 1, 1e-5, 1e-5, 1e-5])
        carried = np.concatenate([-self.weight, np.zeros(3)])
        self.wait(
            seconds, force=lambda now: force * min(1.0, now / (0.6 * seconds)),
            push=lambda now: carried - drag * self.data.qvel[self.dofs],
        )  # fmt: skip

    @property
    def place(self) -> FloatArray:
        """(3,) of the object in the frame of the left pad [m]."""
        return np.asarray(self.touch.poses()[0, :3])


def report(what: str, *figures: object) -> None:
    sys.stdout.write(" | ".join([what, *map(str, figures)]) + "\n")
    sys.stdout.flush()


def weight() -> None:
    """Sum of the pads' forces against the weight, gravity in eight directions."""
    for shape in SHAPES:
        errors = []
        for tilt, turn in itertools.product((0.0, 45.0, 90.0, 135.0), (0.0, 60.0)):
            a, b = np.radians([tilt, turn])
            gravity = -GRAVITY * np.array([np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a)])
            grip = Grip(shape, 0.1, gravity=gravity)
            grip.close(4.0)
            grip.wait(0.6)
            errors.append(np.linalg.norm(grip.touch.world_forces.sum(axis=0) - grip.weight) / (0.1 * GRAVITY))
        report(f"weight, {shape}", f"largest error {max(errors):.1e}")


def creep() -> None:
    """Motion of a held object in its pads within 10 s, after 1 s."""
    for shape, mass in (("box", 0.05), ("ball", 0.2), ("rod", 0.05)):
        grip = Grip(shape, mass)
        grip.close(4.0)
        grip.wait(1.0)
        start = grip.place
        grip.wait(10.0)
        report(f"creep, {shape} of {mass} kg", f"{1e3 * np.abs(grip.place - start).max() / 10:.1e} mm/s")


def stick() -> None:
    """Force at which a box slips, over Coulomb's: pushed down at 3 N, and at a falling grip with 0.2 kg."""
    for preset in MESHES:
        for name, mass in (("push", 0.05), ("falling grip", 0.2)):
            gravity = np.zeros(3) if name == "push" else None
            grip = Grip("box", mass, gravity=gravity, preset=preset)
            start_force = 3.0 if name == "push" else 1.15 * mass * GRAVITY / (2 * FRICTION)
            grip.close(start_force)
            grip.wait(0.3)
            found = float("nan")
            for share in (0.5, 0.8, 0.9, 0.95, *np.arange(0.97, 1.05, 0.0025)):
                push = np.zeros(6)
                if name == "push":
                    push[2] = -share * 2 * FRICTION * start_force
                else:
                    grip.force = mass * GRAVITY / (2 * FRICTION) / share
                grip.wait(0.06, push=lambda now, push=push: push)
                before = grip.place
                grip.wait(0.02, push=lambda now, push=push: push)
                if share > 0.95 and np.linalg.norm((grip.place - before)[:2]) > 20e-6:  # 1 mm/s
                    found = share
                    break
            report(f"stick limit, {name}, {preset}", f"slips at {found:.4f} of Coulomb's law")


def slide(scene: Scene, half: float, depth: float, speed: float, distance: float = 4e-3) -> float:
    """Drag over normal force of an object that slides at constant speed and depth, mean over the last element."""
    pads = GelPads([scene], 1e-3)
    turn = [0.7071068, 0.0, 0.0, 0.7071068] if half == RADIUS else [0.0, 0.0, 0.0, 1.0]
    for share in np.linspace(0.0, 1.0, 41):
        pads.step([[0.0, 0.0, half - share * depth, *turn]])
    ratios = []
    for x in np.arange(0.0, distance, speed * 1e-3):
        wrench = pads.step([[x, 0.0, half - depth, *turn]])[0]
        if x > distance - scene.effective_element_size:
            ratios.append(np.hypot(wrench[0], wrench[1]) / -wrench[2])
    return float(np.mean(ratios))


def drag() -> None:
    """Friction of one pad at 5, 20 and 100 mm/s: of a plate over mu N, of a ball over independent finite elements."""
    for preset in MESHES:
        for name, geometry, depth, half in (
            ("plate", Box(size=(50e-3, 30e-3, 4e-3)), 0.12e-3, 2e-3),
            ("box 12 x 12 mm", Box(size=(12e-3, 12e-3, 6e-3)), 0.2e-3, 3e-3),
            ("rod R 7 mm on its side", Cylinder(radius=RADIUS, height=14e-3), 0.3e-3, RADIUS),
        ):
            indenter = Indenter(geometry=geometry, friction=FRICTION)
            scene = Scene(preset=preset, body=None, indenter=indenter, gel=Gel(housing=None))
            ratios = [slide(scene, half, depth, speed) / FRICTION for speed in SPEEDS]
            report(f"drag over mu N, {name}, {preset}", *(f"{ratio:.3f}" for ratio in ratios))
        for (millimetres, friction), truth in SLIDES.items():
            indenter = Indenter(geometry=Sphere(radius=4e-3), friction=friction)
            scene = Scene(preset=preset, body=None, indenter=indenter)
            ratios = [slide(scene, 4e-3, millimetres * 1e-3, speed) / truth for speed in SPEEDS]
            what = f"drag over FE, ball R 4 mm, {millimetres} mm, mu {friction}, {preset}"
            report(what, *(f"{ratio - 1:+.1%}" for ratio in ratios))


def stability() -> None:
    """Held through 20 random pokes of 10 ms each: masses, moduli and steps."""
    random, lost, pokes = np.random.default_rng(0), 0, 0
    for step, modulus, shape, mass in itertools.product(
        (0.5e-3, 1e-3, 2e-3), (0.05e6, 0.145e6, 1e6), ("box", "ball"), (0.005, 0.05, 0.5)
    ):
        force = max(3.0, 1.6 * mass * GRAVITY / (2 * FRICTION))
        if modulus < 0.1e6 and mass > 0.1 and shape == "ball":
            continue  # 6 N press a ball 2.6 mm deep into 4 mm of this gel, and it is squeezed out
        try:
            grip = Grip(shape, mass, step=step, modulus=modulus, finger=0.05)
            grip.close(force)
            grip.wait(0.1)
            for _ in range(20):
                kick, pokes = 0.3 * FRICTION * force * random.normal(size=3) / 1.7, pokes + 1
                push = np.concatenate([kick, np.zeros(3)])
                grip.wait(0.04, push=lambda now, push=push: push * (now < 0.01))
            grip.wait(0.2)
            grip.touch.require_held()
            speed = float(np.abs(grip.data.qvel[grip.dofs][:3] - [0, 0, grip.data.qvel[0]]).max())
            if speed > 20e-3:
                raise ObjectDropped(f"it moves at {speed * 1e3:.2g} mm/s")
        except (ObjectDropped, SimulationDiverged, ValueError) as error:
            lost += 1
            report("stability", f"{step} s, {modulus / 1e6} MPa, {shape} of {mass} kg", str(error)[:120])
    report("stability", f"{lost} of 51 grips lost, {pokes} pokes")


def energy() -> None:
    """Swing of a held object after a release: largest amplitude in each tenth of a second over the one before."""
    for shape, mass in (("box", 0.5), ("ball", 0.5), ("ball", 0.05)):
        grip = Grip(shape, mass)
        grip.close(6.0)
        grip.wait(0.3)
        push = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
        grip.wait(0.2, push=lambda now, push=push: push)
        track = np.array([grip.place for _ in grip.run(0.8)])
        swing = np.linalg.norm(track - track[-100:].mean(axis=0), axis=1).reshape(8, -1).max(axis=1)[:6]
        shares = [after / before for before, after in itertools.pairwise(swing)]
        report(f"energy, {shape} of {mass} kg", "swing over the one before", *(f"{share:.3f}" for share in shares))


def press() -> None:
    """Force of an object that a finger presses in MuJoCo, over that of `tacsim press` at the same depth."""
    for preset, shape in itertools.product(MESHES, ("box", "ball")):
        grip = Grip(shape, gravity=np.zeros(3), preset=preset)
        grip.close(3.0)
        grip.wait(0.6)
        scene = grip.touch.pads.scenes[0].model_copy(
            update={"settling": Scene().settling.model_copy(update={"tolerance": 1e-3})}
        )
        world = make_world(scene)
        pose = grip.touch.poses()[0]
        world.place({"indenter": Pose(pose[:3] + [0, 0, 2e-3], pose[3:])})
        world.move({"indenter": Pose(pose[:3], pose[3:])})
        ratio = grip.touch.wrenches[0, 2] / world.wrench("lower")[2]
        report(f"press, {shape}, {preset}", f"{ratio - 1:+.2%} at {-grip.touch.wrenches[0, 2]:.3f} N")


def cost() -> None:
    """Processor time of a step of 1 ms with two pads, alone and in batches."""
    machine = Run().metadata([], 1).machine
    report("machine", machine.cpu, f"{machine.cores} cores", f"load {machine.load_before}")
    for preset, shape, step in itertools.product(MESHES, ("box", "ball"), (1e-3, 2e-3)):
        grip = Grip(shape, preset=preset, step=step)
        grip.close(3.0)
        cpu, wall = time.process_time(), time.perf_counter()
        grip.wait(100 * step)
        taken = [1e3 * (now() - then) / 100 for now, then in ((time.process_time, cpu), (time.perf_counter, wall))]
        what = f"{taken[0]:.2f} ms CPU, {taken[1]:.2f} ms wall a step of {1e3 * step:g} ms"
        report(f"cost, {shape}, {preset}", what, f"{0.05 / step * taken[0]:.0f} ms CPU in 50 ms")
    grips = [Grip("box") for _ in range(16)]
    scenes = [(grip.model, grip.data) for grip in grips]
    touches = TouchSensor.batch(scenes, ("left", "right"), "object", **grips[0].options)
    for number in range(200):
        if number == 100:
            cpu = time.process_time()
        for grip in grips:
            grip.data.ctrl[:2] = 3.0 * min(1.0, number / 60)
        step_together(touches)
    report("cost, 16 boxes, learn", f"{1e3 * (time.process_time() - cpu) / 100 / 16:.2f} ms CPU a step and scene")


GROUPS = (weight, creep, stick, drag, stability, energy, press, cost)


def main() -> None:
    wanted = sys.argv[1:] or [group.__name__ for group in GROUPS]
    unknown = set(wanted) - {group.__name__ for group in GROUPS}
    if unknown:
        sys.exit(f"{Path(__file__).name}: no group {sorted(unknown)[0]}; there are {[g.__name__ for g in GROUPS]}")
    for group in GROUPS:
        if group.__name__ in wanted:
            group()


if __name__ == "__main__":
    main()
