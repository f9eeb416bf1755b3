"""Clay in cycles of squeeze, shear and rolling: the change of its force, and the range of its volume ratios."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.cases.squeeze import close_sensors, normal_forces
from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from benchmarks.truth.clay import CLAY
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Body, Box, Cylinder, Scene, Shape, Sphere
from tacsim.physics.world import World, make_world

SHAKEDOWN_CYCLES = 20  # cycles after which the force should be constant


@dataclass(frozen=True)
class Cycle:
    """A body squeezed, then moved in cycles: the upper sensor by `displacement` [m], the lower one by its negative."""

    geometry: Shape
    squeezed: float  # by both sensors together, from first contact [m]
    displacement: tuple[float, float, float]
    pieces: int = 3  # motions in each direction, if they flow


CYCLES = {
    "a cylinder squeezed by 0.3 mm": Cycle(Cylinder(radius=5e-3, height=10e-3), 2.0e-3, (0.0, 0.0, -0.15e-3)),
    "a cube sheared by 0.3 mm": Cycle(Box(size=(6e-3, 6e-3, 5e-3)), 1.6e-3, (0.15e-3, 0.0, 0.0)),
    "a ball rolled by 2 mm": Cycle(Sphere(radius=4e-3), 1.0e-3, (1.0e-3, 0.0, 0.0), pieces=10),
}


def cycles(preset: str, count: int, flow: bool, repeat: int) -> list[Measurement]:
    """A body moved in cycles between two gels. Its force at the end of the forward motion must stay equal to that of
    the first cycle, as in finite elements (2.934, 2.933, 2.933 N for the cylinder), and its elastic volume ratios near
    1."""
    return [_row(preset, what, cycle, count, flow) for what, cycle in CYCLES.items()]


def _row(preset: str, what: str, cycle: Cycle, count: int, flow: bool) -> Measurement:
    scene = Scene.model_validate({"preset": preset, "body": Body(geometry=cycle.geometry, material=CLAY)})
    world = make_world(scene)
    truth = world.truth()
    assert truth is not None
    close_sensors(world, float(world.pose("upper").position[2]) - truth.height)
    close_sensors(world, cycle.squeezed)
    piece = np.array(cycle.displacement) / (cycle.pieces if flow else 1)

    def move_sensors() -> tuple[list[float], list[tuple[float, float]], int]:
        forces, volumes, substeps = [], [], 0
        for _ in range(count):
            for sign in (1.0, -1.0):
                for _ in range(cycle.pieces if flow else 1):
                    stats = world.move(_targets(world, sign * piece), flow=flow)
                    substeps += stats.substeps
                if sign > 0.0:
                    forces.append(float(normal_forces(world).mean()))
            volumes.append((stats.smallest_volume, stats.largest_volume))
        return forces, volumes, substeps

    timing, (forces, volumes, substeps) = timed(move_sensors, 1, warm=lambda: None)
    early = forces[min(SHAKEDOWN_CYCLES, count) - 1]
    return Measurement(
        timing, abs(forces[-1] / forces[0] - 1) * 100, "% of the first cycle's force", "a body that has shaken down",
        f"{what}, {count} cycles, {'flowing' if flow else 'settled'}", substeps,
        {"since_early_percent": (forces[-1] / early - 1) * 100, "first_newton": forces[0],
         "smallest_volume": min(small for small, _ in volumes), "largest_volume": max(large for _, large in volumes)},
        f"{(early / forces[0] - 1) * 100:+.1f} % in the first {min(SHAKEDOWN_CYCLES, count)}",
    )  # fmt: skip


def _targets(world: World, by: FloatArray) -> dict[str, Pose]:
    """Targets of both sensors: the upper one moved by `by` [m], the lower one by -`by`."""
    targets = {}
    for name, sign in (("upper", 1.0), ("lower", -1.0)):
        pose = world.pose(name)
        targets[name] = Pose(pose.position + sign * by, pose.quaternion)
    return targets


CASES = (
    Case("squeeze", "cycles", "tacsim", "draft", partial(cycles, "draft", 20, False)),
    Case("squeeze", "cycles_long", "tacsim", "draft", partial(cycles, "draft", 200, False), long=True),
    Case("squeeze", "cycles_flowing", "tacsim", "draft", partial(cycles, "draft", 700, True), long=True),
)
