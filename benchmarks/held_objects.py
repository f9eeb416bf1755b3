"""Objects that are held at rest between gel pads: `python -m benchmarks.held_objects [NAME ...]`.

Measures weight against shear, creep, stick limit, drag of slides, stability, agreement with a press and with MuJoCo,
and cost, one group a function; all without names. docs/held-objects.md has the table.
"""

from __future__ import annotations

import itertools
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.harness.machine import Run
from tacsim.interface import FloatArray, Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Preset, Scene, Shape, Sphere
from tacsim.physics.grip.model import HeldObject, Support, facing_pads
from tacsim.physics.grip.world import GripWorld
from tacsim.physics.world import make_world

GRAVITY, FRICTION = 9.81, 0.6
MESHES: tuple[Preset, ...] = ("learn", "draft")
SHAPES: dict[str, tuple[Shape, FloatArray, float]] = {  # shape, its orientation, half its width between the pads [m]
    "box": (Box(size=(20e-3, 12e-3, 16e-3)), np.array([0.0, 0.0, 0.0, 1.0]), 10e-3),
    "ball": (Sphere(radius=10e-3), np.array([0.0, 0.0, 0.0, 1.0]), 10e-3),
    "plate": (Box(size=(20e-3, 40e-3, 160e-3)), np.array([0.0, 0.0, 0.0, 1.0]), 10e-3),
    "rod": (Cylinder(radius=8e-3, height=18e-3), np.array([0.0, 0.0, 0.0, 1.0]), 8e-3),
}
ORIGIN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class Grip:
    """One object between two pads, closed by a force from 0.5 mm on each side."""

    def __init__(
        self, shape: str, mass: float, force: float, *, modulus: float = 0.145e6, preset: Preset = "learn",
        gravity: FloatArray | None = None, count: int = 1, released: bool = True,
    ) -> None:  # fmt: skip
        geometry, turn, half = SHAPES[shape]
        self.width, self.force, self.count = 2 * half + 1e-3, force, count
        down = np.array([0.0, 0.0, -GRAVITY]) if gravity is None else gravity
        gel = Gel(material=GelMaterial(youngs_modulus=modulus), housing=None)
        self.world = GripWorld([HeldObject(geometry, mass, FRICTION)] * count, gel, preset=preset, gravity=down)
        self.weight, self.pose = mass * down, ORIGIN.copy()
        self.world.reset([[0, 0, 0, *turn]] * count, self.pads)
        self.now = self.world.states
        if released:
            self.now = self.world.grasp(self.pads, [force] * count)

    @property
    def pads(self) -> FloatArray:
        return facing_pads(np.tile(self.pose, (self.count, 1)), self.width)

    def step(self, **options: object) -> None:
        options = {"forces": [self.force] * self.count, **options}
        self.now = self.world.step(self.pads, **options)  # type: ignore[arg-type]

    @property
    def total(self) -> FloatArray:
        """(3,) force on all pads of grip 0, world axes [N]."""
        turns = Rotation.from_quat(self.now.pads[0, :, 3:])
        return np.asarray(turns.apply(self.now.wrenches[0, :, :3]).sum(axis=0))

    @property
    def place(self) -> FloatArray:
        return np.asarray(self.now.objects[0, :3] - self.pose[:3])


def report(what: str, *figures: object) -> None:
    sys.stdout.write(" | ".join([what, *map(str, figures)]) + "\n")
    sys.stdout.flush()


def weight() -> None:
    """Sum of the pads' forces against the weight, gravity in eight directions."""
    for preset, shape in itertools.product(MESHES, ("box", "ball", "rod")):
        errors = []
        for tilt, turn in itertools.product((0.0, 45.0, 90.0, 135.0), (0.0, 60.0)):
            a, b = np.radians([tilt, turn])
            gravity = -GRAVITY * np.array([np.sin(a) * np.sin(b), np.sin(a) * np.cos(b), np.cos(a)])
            grip = Grip(shape, 0.1, 4.0, gravity=gravity, preset=preset)
            for _ in range(10):
                grip.step(settle=True)
            errors.append(np.linalg.norm(grip.total - grip.weight) / (0.1 * GRAVITY))
        report(f"weight, {shape}, {preset}", f"largest error {max(errors):.1e}")


def creep() -> None:
    """Motion of a held object in its pads within 10 s of control steps of 50 ms, after 1 s."""
    for shape, mass in (("box", 0.05), ("ball", 0.2), ("rod", 0.05)):
        grip = Grip(shape, mass, 4.0)
        for _ in range(20):
            grip.step()
        start = grip.place
        for _ in range(200):
            grip.step()
        report(f"creep, {shape} of {mass} kg", f"{1e3 * np.abs(grip.place - start).max() / 10:.1e} mm/s")


def stick() -> None:
    """Force at which a box slips, over Coulomb's: pushed along z at 3 N, and at a falling grip with 0.2 kg."""
    for preset, name in itertools.product(MESHES, ("push", "falling grip")):
        mass = 0.05 if name == "push" else 0.2
        gravity = np.zeros(3) if name == "push" else None
        force = 3.0 if name == "push" else 1.15 * mass * GRAVITY / (2 * FRICTION)
        grip = Grip("box", mass, force, gravity=gravity, preset=preset)
        found = float("nan")
        for share in (0.5, 0.8, 0.9, 0.95, *np.arange(0.97, 1.05, 0.0025)):
            load = np.zeros((1, 6))
            if name == "push":
                load[0, 2] = -share * 2 * FRICTION * force
            else:
                grip.force = mass * GRAVITY / (2 * FRICTION) / share
            for _ in range(6):
                grip.step(loads=load)
            before = grip.place
            for _ in range(2):
                grip.step(loads=load)
            if share > 0.95 and np.linalg.norm(grip.place - before) > 20e-6:
                found = share
                break
        report(f"stick limit, {name}, {preset}", f"slips at {found:.4f} of Coulomb's law")


def drag() -> None:
    """Friction of an object that a support holds while its pads slide along it, over mu N, mean over the last steps."""
    for preset, (shape, step, count) in itertools.product(
        MESHES, (("box", 0.25e-3, 20), ("plate", 0.25e-3, 32), ("plate", 1e-3, 24), ("plate", 5e-3, 12))
    ):
        grip = Grip(shape, 0.05, 3.0, gravity=np.zeros(3), preset=preset)
        held = Support([1e5] * 3 + [100.0] * 3)
        grip.step(support=held)
        ratios = []
        for _ in range(count):
            grip.pose[2] += step
            grip.step(support=held)
            wrenches = grip.now.wrenches[0]
            ratios.append(np.hypot(*wrenches[:, :2].T).sum() / -wrenches[:, 2].sum())
        what = f"drag over mu N, {shape}, {preset}, {step / 0.05 * 1e3:g} mm/s"
        report(what, f"{np.mean(ratios[-8:]) / FRICTION:.4f}", f"{grip.now.substeps[0]} substeps a step")


def stability() -> None:
    """Held through 20 random pokes: masses, moduli; each is a load for one step, with a random motion of the pads."""
    random, lost, pokes = np.random.default_rng(0), 0, 0
    for modulus, shape, mass in itertools.product(
        (0.05e6, 0.145e6, 1e6), ("box", "ball", "rod"), (0.005, 0.05, 0.5)
    ):  # fmt: skip
        force = max(3.0, 1.6 * mass * GRAVITY / (2 * FRICTION))
        what = f"stability, {modulus / 1e6} MPa, {shape} of {mass} kg"
        if modulus < 0.1e6 and mass > 0.1 and shape != "box":
            continue  # 6 N press it so deep into 4 mm of this gel that it is squeezed out
        try:
            grip = Grip(shape, mass, force, modulus=modulus)
            for _ in range(20):
                load, pokes = np.zeros((1, 6)), pokes + 1
                load[0, :3] = 0.3 * FRICTION * force * random.normal(size=3) / 1.7
                grip.pose[:3] += random.uniform(-5e-3, 5e-3, 3)
                grip.step(loads=load)
                for _ in range(3):
                    grip.step()
            for _ in range(10):
                grip.step()
            before = grip.place
            grip.step()
            moved = float(np.abs(grip.place - before).max())
            if grip.now.dropped[0] or not grip.now.touching.all() or moved > 0.2e-6 or grip.now.imbalances[0] > 2e-3:
                raise RuntimeError(f"moves by {1e6 * moved:.2g} um a step, imbalance {grip.now.imbalances[0]:.2g}")
        except (RuntimeError, ValueError) as error:
            lost += 1
            report(what, str(error)[:150])
    report("stability", f"{lost} grips lost, {pokes} pokes")


def press() -> None:
    """Force of a held object over that of a settled press at the same depth."""
    for preset, shape in itertools.product(MESHES, ("box", "ball")):
        grip = Grip(shape, 0.05, 3.0, gravity=np.zeros(3), preset=preset)
        for _ in range(5):
            grip.step(settle=True)
        pad, item = (Pose(each[:3], each[3:]) for each in (grip.now.pads[0, 0], grip.now.objects[0]))
        back = Rotation.from_quat(pad.quaternion.copy()).inv()
        at = back.apply(item.position - pad.position)
        turn = (back * Rotation.from_quat(item.quaternion.copy())).as_quat()
        settling = Scene().settling.model_copy(update={"tolerance": 1e-3})
        indenter = Indenter(geometry=SHAPES[shape][0], friction=FRICTION)
        world = make_world(Scene(preset=preset, body=None, indenter=indenter, gel=Gel(housing=None), settling=settling))
        world.place({"indenter": Pose(at + [0, 0, 2e-3], turn)})
        world.move({"indenter": Pose(at, turn)})
        force = grip.now.wrenches[0, 0, 2]
        report(f"press, {shape}, {preset}", f"{force / world.wrench('lower')[2] - 1:+.2%} at {-force:.3f} N")


def dynamic() -> None:
    """Sag of an object under its weight, and force, where MuJoCo holds it with the same gels, and here, at rest. Needs
    the extra `mujoco`."""
    from benchmarks.mujoco_touch import Grip as DynamicGrip

    for shape, mass, preset in itertools.product(("box", "ball"), (0.05, 0.2), MESHES):
        other = DynamicGrip(shape, mass, preset=preset)
        other.close(4.0)
        lift = np.concatenate([-other.weight, np.zeros(3)])
        other.wait(0.3, push=lambda now, lift=lift: lift)
        before = other.touch.poses()[:, :3].copy()
        other.wait(0.6)
        theirs = other.touch.poses()[:, :3] - before
        grip = Grip(shape, mass, 4.0, preset=preset, released=False)
        places = []
        for load in ([-grip.weight], np.zeros((1, 3))):
            for _ in range(5):
                grip.step(loads=np.hstack([load, np.zeros((1, 3))]), settle=True)
            turns = Rotation.from_quat(grip.now.pads[0, :, 3:]).inv()
            places.append(turns.apply(grip.now.objects[0, :3] - grip.now.pads[0, :, :3]))
        sags = [float(np.linalg.norm(each[:, :2], axis=1).mean()) for each in (places[1] - places[0], theirs)]
        depths = [1e6 * float(each.mean()) for each in (places[1][:, 2], other.touch.poses()[:, 2])]
        forces = [np.linalg.norm(each[:, :3], axis=1).mean() for each in (grip.now.wrenches[0], other.touch.wrenches)]
        report(
            f"dynamic, {shape} of {mass} kg, {preset}", f"sag {1e6 * sags[0]:.2f} and {1e6 * sags[1]:.2f} um",
            f"depth differs by {depths[0] - depths[1]:+.2f} um", f"force by {forces[0] / forces[1] - 1:+.2%}",
        )  # fmt: skip


def flow() -> None:
    """Forces and places at the end of steps of fixed length against steps that settle, on a learner's random path."""
    for preset, shape in itertools.product(MESHES, ("box", "ball")):
        grips = [Grip(shape, 0.05, 3.0, preset=preset) for _ in range(2)]
        random, errors, places = np.random.default_rng(0), [], []
        for _ in range(60):
            shift, turn, change = (
                random.uniform(-1e-3, 1e-3, 3),
                random.uniform(-0.01, 0.01, 3),
                random.uniform(-0.3, 0.3),
            )
            for settles, grip in enumerate(grips):
                grip.pose[:3] += shift
                grip.pose[3:] = (Rotation.from_rotvec(turn) * Rotation.from_quat(grip.pose[3:])).as_quat()
                grip.force = float(np.clip(grip.force + change, 1.5, 5.0))
                grip.step(settle=bool(settles))
            now, rest = (grip.now for grip in grips)
            size = np.linalg.norm(rest.wrenches[0, :, :3], axis=1).max()
            errors.append(np.linalg.norm((now.wrenches - rest.wrenches)[0, :, :3], axis=1).max() / size)
            places.append(np.linalg.norm((now.objects - rest.objects)[0, :3]))
        report(
            f"flow, {shape}, {preset}", f"force differs by {np.mean(errors):.2%} on average, at most {max(errors):.2%}",
            f"place by {1e6 * np.mean(places):.2f} um, at most {1e6 * max(places):.2f} um",
        )  # fmt: skip


def cost() -> None:
    """Processor time of a control step, random motions of pads and of the grip force; 16 grips on all cores."""
    machine = Run().metadata([], 1).machine
    report("machine", machine.cpu, f"{machine.cores} cores", f"load {machine.load_before}")
    for preset, shape, count in (*itertools.product(MESHES, ("box", "ball"), (1,)), ("learn", "box", 16)):
        grip, random = Grip(shape, 0.05, 3.0, preset=preset, count=count), np.random.default_rng(0)
        steps = 100
        cpu, wall = time.process_time(), time.perf_counter()
        for _ in range(steps):
            grip.pose[:3] += random.uniform(-1e-3, 1e-3, 3)
            grip.force = float(np.clip(grip.force + random.uniform(-0.3, 0.3), 1.5, 5.0))
            grip.step()
        taken = [1e3 * (now() - then) / steps for now, then in ((time.process_time, cpu), (time.perf_counter, wall))]
        report(
            f"cost, {count} of {shape}, {preset}", f"{taken[0]:.2f} ms CPU, {taken[1]:.2f} ms wall a step",
            f"{1e3 * count / taken[1]:.0f} grips x steps a second",
        )  # fmt: skip


GROUPS = (weight, creep, stick, drag, stability, press, dynamic, flow, cost)


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
