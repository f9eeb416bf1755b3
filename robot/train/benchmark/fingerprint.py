"""What physics a score was computed with, and on what machine.

Physics has two hashes. `motion` is of the bits of a short reference motion: it changes if and only if results change
there, and it does not change with a comment. It depends on the vector width of the processor, because sums are ordered
by it. `source` is of the source files of the simulator: it is the same on all machines, and shows whether the program
could be another one.
"""

from __future__ import annotations

import hashlib
import logging
import platform
import re
from functools import cache
from pathlib import Path

import numpy as np

from robot.deploy.control_loop import versions
from robot.train.benchmark.hashing import hash_files
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.quantity import Config

# Rooms whose code decides what an episode is; others (report, record, cli ...) only show it.
PHYSICS_ROOMS = ("physics", "sim", "tasks", "gym", "optics", "geometry", "compute", "models")


class Physics(Config):
    """What simulated the episodes."""

    motion: str  # hash of the bits of the reference motion, on this machine
    source: str  # hash of the source files of the simulator
    tacsim: str = ""  # its version


class Machine(Config):
    """What a score was computed on."""

    vector_width: int  # of the kernels [bits]; with the same width and physics the bits of a score are the same
    device: str  # cpu, cuda ...
    processor: str
    architecture: str
    versions: dict[str, str] = {}  # of Python and of packages that results may depend on


@cache
def physics() -> Physics:
    """Of this installation. Computes the reference motion: seconds, most of them to compile."""
    log = logging.getLogger("tacsim")
    level = log.level
    log.setLevel(logging.ERROR)  # its coarse mesh is no choice of the user's
    try:
        motion = _hash_reference_motion()
    finally:
        log.setLevel(level)
    return Physics(motion=motion, source=hash_physics_source(), tacsim=versions().get("tacsim", ""))


@cache
def machine(clock: str = "sim") -> Machine:
    """This machine. clock: of the rig; with `mujoco` the version of MuJoCo counts."""
    from tacsim.physics.exec.lanes import LANES, NODES, ON_DEVICE

    floats = LANES if ON_DEVICE else 4 * NODES
    found = versions()
    from importlib import metadata
    from importlib.util import find_spec

    for package in ("onnxruntime", *["mujoco"] * (clock == "mujoco")):
        if find_spec(package) is not None:
            found[package] = metadata.version(package)
    from tacsim.compute.runtime import DEVICE

    return Machine(
        vector_width=32 * floats,
        device=DEVICE,
        processor=_processor_name(),
        architecture=platform.machine(),
        versions=found,
    )


def hash_physics_source() -> str:
    """Of the modules in PHYSICS_ROOMS and of `robot.rig`."""
    root = Path(__file__).resolve().parents[3]
    folders = [*(root / "tacsim" / room for room in PHYSICS_ROOMS), root / "robot/rig", root / "calibration"]
    return hash_files(root, (path for folder in folders for path in folder.rglob("*.py")))


def _hash_reference_motion() -> str:
    """A cube of clay is squeezed, sheared and let go between two gels: of its particles and of the forces."""
    from tacsim.config import load_scene
    from tacsim.physics.world import make_world

    world = make_world(load_scene("squeeze", ["preset=learn"]))
    digest = hashlib.sha256()
    start = {name: world.pose(name) for name in world.sensors}
    gap = float(start["upper"].position[2]) - 10e-3  # clear of a body of 10 mm [m]
    for down, aside, flow in ((gap + 0.4e-3, 0.0, False), (gap + 0.8e-3, 0.3e-3, True), (gap + 0.5e-3, 0.2e-3, False)):
        upper = start["upper"].position + np.array([aside, 0.0, -down])
        world.move({"upper": Pose(upper, start["upper"].quaternion)}, flow=flow)
        truth = world.truth()
        assert truth is not None
        digest.update(np.ascontiguousarray(truth.points, np.float32).tobytes())
        for name in world.sensors:
            digest.update(np.asarray(world.wrench(name), np.float64).tobytes())
            digest.update(np.asarray(se3.transform(world.pose(name), np.zeros(3)), np.float64).tobytes())
    return digest.hexdigest()


def _processor_name() -> str:
    try:
        about = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*: (.+)$", about, re.MULTILINE)
    return found[1].strip() if found else platform.machine()


def describe_differences(one: tuple[Physics, Machine], other: tuple[Physics, Machine]) -> list[str]:
    """What differs between where a score was computed (`one`) and here (`other`), each a phrase; what cannot change
    bits comes last."""
    (physics_there, machine_there), (physics_here, machine_here) = one, other
    found = []
    for name, label in (("device", "device"), ("vector_width", "vector width [bits]")):
        there, here = getattr(machine_there, name), getattr(machine_here, name)
        if there != here:
            found.append(f"{label}: {there} there, {here} here")
    if physics_there.source != physics_here.source:
        found.append(
            f"source of the simulator: {physics_there.source[:12]} there (tacsim {physics_there.tacsim}), "
            f"{physics_here.source[:12]} here (tacsim {physics_here.tacsim})"
        )
    if physics_there.motion != physics_here.motion:
        found.append(
            f"bits of the reference motion: {physics_there.motion[:12]} there, {physics_here.motion[:12]} here"
        )
    for package in sorted(machine_there.versions.keys() | machine_here.versions.keys()):
        there, here = machine_there.versions.get(package, "none"), machine_here.versions.get(package, "none")
        if there != here and package != "tacsim":
            found.append(f"{package}: {there} there, {here} here")
    return found
