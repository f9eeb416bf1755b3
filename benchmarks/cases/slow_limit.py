"""Every shipped body between two gels at the default speed, against the slow limit of the same mesh."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.squeeze import PRESETS, close_sensors, normal_forces
from benchmarks.harness.cache import cached
from benchmarks.harness.measure import Measurement, once
from benchmarks.harness.runner import Case
from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

# Dough opened by 0.3 mm still changes by 3 % from Mach 0.004 to 0.002
SLOW = {"mach": 0.002, "tolerance": 1e-3, "max_substeps": 6000}
MATERIALS = ("modelling-clay", "soft-clay", "dough", "cold-plasticine", "seed")
# Displacement of both sensors together from first contact, in sequence [mm]
STATES = {"closed by 0.5 mm": 0.5, "closed by 1.5 mm": 1.5, "closed by 3 mm": 3.0, "opened to 2.7 mm": 2.7}
DRAGGED = 0.6  # displacement before a drag [mm]
GELS = (0.145, 0.4, 1.0)  # Young's moduli [MPa]
DRAG, DRAGS = 1e-3, 3  # of the upper sensor along x [m], and number of drags
UNLOADED = 0.02  # errors are relative to the force, but at least to this share of the largest force of the states


def shipped_bodies(preset: str, repeat: int) -> list[Measurement]:
    """A cube of each shipped material, closed by 0.5, 1.5 and 3 mm from first contact and opened to 2.7 mm: force after
    each motion, against the slow limit."""
    rows = []
    for material in MATERIALS:
        truth = _slow_forces(f"bodies-{material}-{preset}", partial(_squeezed, material, preset))
        world, min_force = _touched(_scene(preset, f"body.material={material}")), UNLOADED * max(truth)
        for (state, by), true in zip(_motions(), truth, strict=True):
            timing, stats = once(partial(close_sensors, world, by))
            rows.append(
                _row(timing, float(normal_forces(world).mean()), true, min_force, f"{material}, {state}", stats)
            )
    return rows


def dragged_bodies(preset: str, repeat: int) -> list[Measurement]:
    """The clay cube of the shipped reposition, which slips on the lower gel and sticks to the upper one, dragged by
    1 mm three times: force along the lower gel after each, against the slow limit."""
    rows = []
    for modulus in GELS:
        truth = _slow_forces(f"dragged-{modulus}-{preset}", partial(_dragged, modulus, preset))
        world = _ready_to_drag(modulus, preset)
        for number, true in enumerate(truth, 1):
            timing, stats = once(partial(_drag, world))
            what = f"gels of {modulus:g} MPa, {number} mm"
            rows.append(_row(timing, _tangential_force(world), true, 0.0, what, stats))
    return rows


def _scene(preset: str, *overrides: str, **settling: float) -> Scene:
    settled = (f"settling.{name}={value}" for name, value in settling.items())
    return load_scene("squeeze", [f"preset={preset}", *overrides, *settled])


def _touched(scene: Scene) -> World:
    world = make_world(scene)
    truth = world.truth()
    assert truth is not None
    close_sensors(world, float(world.pose("upper").position[2]) - truth.height)
    return world


def _motions() -> list[tuple[str, float]]:
    """Each state, and the displacement of the sensors from the state before [m]."""
    before = [0.0, *STATES.values()]
    return [(state, 1e-3 * (by - last)) for (state, by), last in zip(STATES.items(), before, strict=False)]


def _squeezed(material: str, preset: str) -> list[float]:
    world, forces = _touched(_scene(preset, f"body.material={material}", **SLOW)), []
    for _, by in _motions():
        close_sensors(world, by)
        forces.append(float(normal_forces(world).mean()))
    return forces


def _ready_to_drag(modulus: float, preset: str, **settling: float) -> World:
    overrides = ("friction={lower: 0.3, upper: 1.0}", f"gel.material={{youngs_modulus: {modulus} MPa}}")
    world = _touched(_scene(preset, *overrides, **settling))
    close_sensors(world, 1e-3 * DRAGGED)
    return world


def _drag(world: World) -> MoveStats:
    pose = world.pose("upper")
    return world.move({"upper": Pose(pose.position + [DRAG, 0.0, 0.0], pose.quaternion)})


def _tangential_force(world: World) -> float:
    return float(np.hypot(*world.wrench("lower")[:2]))


def _dragged(modulus: float, preset: str) -> list[float]:
    world, forces = _ready_to_drag(modulus, preset, **SLOW), []
    for _ in range(DRAGS):
        _drag(world)
        forces.append(_tangential_force(world))
    return forces


def _slow_forces(name: str, compute: Any) -> list[float]:
    """Forces [N] at a speed without influence. They take minutes at `standard`, and are cached."""
    return cached(f"slow-limit-{name}", f"{SLOW} {STATES} {DRAGGED} {DRAG} {DRAGS}", compute)


def _row(timing: Any, found: float, true: float, min_force: float, what: str, stats: MoveStats) -> Measurement:
    error = abs(found - true) / max(true, min_force) * 100
    figures = {"found_n": found, "truth_n": true, "settled_error": error if stats.settled else 0.0}
    note = "" if stats.settled else f"not settled: the hold took {stats.force_loss:.1%} of the force"
    return Measurement(timing, error, "%", "the same mesh at Mach 0.002", what, stats.substeps, figures, note)


CASES = tuple(
    Case("squeeze", measure.__name__, "tacsim", at, partial(measure, preset), long=preset == "standard")
    for preset, at in PRESETS.items()
    for measure in (shipped_bodies, dragged_bodies)
)
