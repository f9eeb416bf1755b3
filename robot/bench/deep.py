"""Long rows of the squeeze group: a squeeze by four fifths against slab theory, and a sheared body left alone."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from robot.bench.measure import Measurement, timed
from robot.bench.runner import Case
from robot.bench.squeeze import PRESETS, TOUCH, close, normal_forces, squeeze_scene, touching
from tacsim.interface import Pose, Truth
from tacsim.physics.world import MoveStats, World, make_world

SIDE = 10e-3  # of the cube [m]
SHARES = (0.5, 0.8)  # of its height
DRIFT_SUBSTEPS = 100_000
NEVER = 1e-12  # a tolerance that no residual in float32 keeps within


def slab(preset: str, repeat: int) -> list[Measurement]:
    """A cube between two gels, closed by half and by four fifths of its height: F = sigma_y A (1 + W / (3 sqrt 3 H)).

    Upper bound for a slab between rough rigid plates (Hill 1950); H, A and W = sqrt A are those of the body at the end.
    Soft gels make cups round a deeply squeezed body, which the theory knows nothing of.
    """
    scene = squeeze_scene(preset)
    assert scene.body is not None and scene.body.material.yield_stress is not None
    world = touching(scene)
    rows: list[Measurement] = []
    done = 2 * TOUCH
    for share in SHARES:
        timing, stats = timed(partial(close, world, share * SIDE - done), 1, warm=lambda: None)
        done = share * SIDE
        height = _truth(world).height
        force = float(normal_forces(world).mean())
        theory = slab_force(scene.body.material.yield_stress, SIDE**3, height)
        figures = {"force_n": force, "slab_n": theory, "ratio": force / theory, "height_mm": height * 1e3}
        rows.append(
            Measurement(
                timing, abs(force / theory - 1) * 100, "%", "slab theory", f"{share * 100:.0f} % of its height",
                stats.substeps, figures, "" if stats.settled else "not settled",
            )
        )  # fmt: skip
    return rows


def slab_force(yield_stress: float, volume: float, height: float) -> float:
    """[N] to squeeze a square slab between rough plates; yield stress in uniaxial compression [Pa]."""
    area = volume / height
    return yield_stress * area * (1 + math.sqrt(area) / (3 * math.sqrt(3) * height))


def sheared_rest(preset: str, repeat: int) -> list[Measurement]:
    """A body pressed and sheared, then left alone for 100,000 substeps: how far its centre and its particles creep."""
    world = touching(squeeze_scene(preset))
    close(world, 0.5e-3)
    pose = world.pose("upper")
    world.move({"upper": Pose(pose.position + [0.5e-3, 0.0, 0.0], pose.quaternion)})
    _rest(world, preset, 4000)  # the body's own slow settling is not what is asked for
    before, force = _truth(world), normal_forces(world)
    timing, stats = timed(partial(_rest, world, preset, DRIFT_SUBSTEPS), 1, warm=lambda: None)
    after = _truth(world)
    centre = float(np.linalg.norm(after.position - before.position))
    each = np.linalg.norm(after.points.astype(np.float64) - before.points, axis=1)
    lost = float(np.abs(normal_forces(world) / force - 1).max())
    figures = {"farthest_particle_um": float(each.max()) * 1e6, "force_change_percent": lost * 100}
    note = "" if stats.substeps >= DRIFT_SUBSTEPS else f"it rested for {stats.substeps} substeps only"
    return [
        Measurement(
            timing, centre * 1e6, "µm of its centre", "where it was", "", stats.substeps, figures, note
        )
    ]  # fmt: skip


def _rest(world: World, preset: str, substeps: int) -> MoveStats:
    """Holds the state of `world` for so many substeps; `world` follows."""
    still = make_world(squeeze_scene(preset, tolerance=NEVER, max_substeps=substeps))
    still.restore(world.snapshot())
    stats = still.move({})
    world.restore(still.snapshot())
    return stats


def _truth(world: World) -> Truth:
    truth = world.truth()
    assert truth is not None
    return truth


CASES = (
    Case("squeeze", "slab", "tacsim", PRESETS["draft"], partial(slab, "draft"), long=True),
    Case("squeeze", "slab", "tacsim", PRESETS["standard"], partial(slab, "standard"), long=True),
    Case("squeeze", "sheared_rest", "tacsim", PRESETS["draft"], partial(sheared_rest, "draft"), long=True),
)
