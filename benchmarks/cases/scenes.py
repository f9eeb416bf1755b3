"""Scenes group: cost of a scene by its content, and the time to make a second world."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.cases.press import press, press_scene
from benchmarks.cases.squeeze import (
    PRESETS,
    STEP,
    close_sensors,
    closing_targets,
    normal_forces,
    squeeze_scene,
    world_in_contact,
)
from benchmarks.harness.measure import Measurement, Timing, step_cost, timed
from benchmarks.harness.runner import Case
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Cylinder, Mesh, Scene, Shape, Sphere
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

DEPTH = 0.3e-3  # of an indenter [m]
CLOSE = 0.3e-3  # both sensors together [m]
RADIUS = 4e-3
ENVIRONMENTS = (1, 8, 64)
AT_REST = "contact force against force at the backing, and their change"


def rigid(shape: Callable[[Path], Shape], repeat: int) -> list[Measurement]:
    """A rigid indenter pressed 0.3 mm into the draft gel, including the world from its scene: no particles, no grid."""
    with tempfile.TemporaryDirectory() as folder:
        scene = press_scene(shape(Path(folder)), 1e-3)
        timing, (world, stats) = timed(partial(press, scene, DEPTH), repeat)
        started, _ = timed(partial(make_world, scene), repeat, warm=lambda: None)
    moving = max(timing.median - started.median, 0.0)
    figures = {"ready_ms": started.median * 1e3, "force_n": abs(float(world.wrench("lower")[2]))}
    return [_row(timing, stats, "", moving, figures)]


def _ball(folder: Path) -> Shape:
    return Sphere(radius=RADIUS)


def _cylinder(folder: Path) -> Shape:
    return Cylinder(radius=RADIUS, height=2 * RADIUS)


def _box(folder: Path) -> Shape:
    return Box(size=(2 * RADIUS,) * 3)


def _mesh(folder: Path) -> Shape:
    import trimesh

    path = folder / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=RADIUS * 1e3).export(path)  # an STL is in millimetres
    return Mesh(path=str(path))


def body(material: str, repeat: int) -> list[Measurement]:
    """A cube of 10 mm between two draft gels, closed by 0.3 mm in the middle of a squeeze; then with its images too."""
    from tacsim.config import load_sensor
    from tacsim.optics.render import Renderer

    scene = squeeze_scene("draft")
    if material == "elastic":
        assert scene.body is not None
        config = scene.body.material
        soft = BodyMaterial(youngs_modulus=config.youngs_modulus, poisson_ratio=config.poisson_ratio)
        scene = scene.model_copy(update={"body": Body(geometry=scene.body.geometry, material=soft)})
    world = world_in_contact(scene)
    close_sensors(world, 0.5e-3)
    begin = world.snapshot()

    def run() -> MoveStats:
        world.restore(begin)
        return close_sensors(world, CLOSE)

    timing, stats = timed(run, repeat, warm=lambda: None)
    rows = [_row(timing, stats, "", timing.median, {"force_n": float(normal_forces(world).mean())})]
    sensor = load_sensor("ideal", ["geometry.width=320", "geometry.height=240"])
    camera = Renderer(sensor, scene.gel.size[:2])

    def render_images() -> list[object]:
        return [camera(world.surface(name)) for name in world.sensors]

    rendering, _ = timed(render_images, repeat)
    both = Timing(tuple(timing.median + each for each in rendering.samples), timing.processor + rendering.processor)
    rows.append(_row(both, stats, "and two images of 320 x 240", both.median, {"images_ms": rendering.median * 1e3}))
    return rows


def _row(timing: Timing, stats: MoveStats, variant: str, moving: float, figures: dict[str, float]) -> Measurement:
    """moving: duration of the substeps [s]."""
    each = {"wall_per_substep_us": moving * 1e6 / stats.substeps}
    note = "" if stats.settled else "not settled"
    return Measurement(
        timing, stats.residual * 100, "% residual", AT_REST, variant, stats.substeps, {**each, **figures}, note
    )


def second_world(preset: str, repeat: int) -> list[Measurement]:
    """A second world from a scene, in a process that has made and moved one already: no kernel compiles again."""
    scene = squeeze_scene(preset, mach=0.1, max_substeps=0)
    first, first_ms, first_move_ms = _made_and_moved(scene)
    timing, _ = timed(partial(make_world, scene), repeat, warm=lambda: None)
    second, _, second_move_ms = _made_and_moved(scene)
    state = second.snapshot()
    different = max(
        float(np.abs(a.astype(np.float64) - state[name].astype(np.float64)).max(initial=0.0))
        for name, a in first.snapshot().items()
    )
    figures = {"first_ms": first_ms, "second_ms": timing.median * 1e3}
    figures |= {"first_move_ms": first_move_ms, "second_move_ms": second_move_ms}
    return [
        Measurement(timing, different, "difference of state", "the first world after the same motion", figures=figures,
                    note="the first world starts Taichi, its first move compiles kernels or loads them; moves are 1 µm")
    ]  # fmt: skip


def _made_and_moved(scene: Scene) -> tuple[World, float, float]:
    """A world, the time to make it and the time of its first motion [ms]."""
    began = time.perf_counter()
    world = make_world(scene)
    made = time.perf_counter()
    close_sensors(world, 1e-6)
    return world, (made - began) * 1e3, (time.perf_counter() - made) * 1e3


FIRST_MOTION = """
import time
from tacsim.models.scene import Scene
from tacsim.physics.world import make_world
from tacsim.pose import Pose
world = make_world(Scene(preset="draft"))
pose = world.pose("upper")
world.move({"upper": Pose(pose.position - [0, 0, 0.5e-3], pose.quaternion)})
print(world.wrench("upper")[2], time.process_time())
"""


def first_motion(repeat: int) -> list[Measurement]:
    """A process that makes the default scene's draft world and closes it by 0.5 mm: without cached kernels, then with
    them."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": folder}
        command = [sys.executable, "-W", "ignore", "-c", FIRST_MOTION]
        samples: list[tuple[float, float, float]] = []  # force [N], processor's time, wall time [s]
        for _ in range(1 + max(repeat, 1)):
            began = time.perf_counter()
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
            if done.returncode:
                raise RuntimeError(f"a process ended with {done.returncode}: {done.stderr.strip()[-500:]}")
            force, taken = map(float, done.stdout.split())
            samples.append((force, taken, time.perf_counter() - began))
    rows = []
    for variant, runs in (("kernels compiled", samples[:1]), ("kernels kept", samples[1:])):
        forces, processor, seconds = zip(*runs, strict=True)
        timing = Timing(seconds, float(np.median(processor)))
        different = max(abs(force - samples[0][0]) for force in forces)
        figures = {"force_n": abs(forces[0])}
        rows.append(
            Measurement(timing, different, "N", "the process that compiled them", variant, figures=figures,
                        note="memory is of the process that starts it")
        )  # fmt: skip
    return rows


def batch(count: int, repeat: int, preset: str = "draft") -> list[Measurement]:
    """Squeezes moved by one launch, each closed by 0.1 mm without a hold: cost of a substep for each of them."""
    from tacsim.physics.worlds.batch import Batch

    begin = world_in_contact(squeeze_scene(preset))
    truth = begin.truth()
    assert truth is not None
    close_sensors(begin, 0.5e-3)
    scene = squeeze_scene(preset, max_substeps=0)
    alone, many = make_world(scene), Batch([scene] * count)
    for world in (alone, *many.worlds):
        world.restore(begin.snapshot())

    def run() -> MoveStats:
        ends = many.move([closing_targets(world, STEP) for world in many.worlds])
        for end in ends:
            if isinstance(end, Exception):
                raise end
        assert isinstance(ends[0], MoveStats)
        return ends[0]

    timing, stats = timed(run, repeat if count < max(ENVIRONMENTS) else 1)  # the largest takes seconds
    for _ in range(len(timing.samples) + 1):  # as often as the batch, with its untimed motion
        close_sensors(alone, STEP)
    force = float(normal_forces(alone).mean())
    error = max(abs(float(normal_forces(world).mean()) / force - 1) for world in many.worlds) * 100
    each = timing.median * 1e6 / (stats.substeps * count)
    figures = {"wall_per_environment_substep_us": each, "force_n": force}
    figures |= step_cost(timing, stats.substeps * count, len(truth.points), "particle")
    return [Measurement(timing, error, "% of force", "the same motions of a world alone", "", stats.substeps, figures)]


def _indenter(name: str, shape: Callable[[Path], Shape]) -> Case:
    return Case("scenes", f"indenter_{name}", "tacsim", "gel 1 mm", partial(rigid, shape))


CASES = (
    *(_indenter(n, f) for n, f in (("sphere", _ball), ("cylinder", _cylinder), ("box", _box), ("mesh", _mesh))),
    *(Case("scenes", f"body_{m}", "tacsim", PRESETS["draft"], partial(body, m)) for m in ("elastic", "plastic")),
    *(Case("scenes", "second_world", "tacsim", words, partial(second_world, p)) for p, words in PRESETS.items()),
    Case("scenes", "first_motion", "tacsim", PRESETS["draft"], first_motion),
    *(Case("scenes", "batch", "tacsim", f"{n} x {PRESETS['draft']}", partial(batch, n)) for n in ENVIRONMENTS),
)  # fmt: skip
