"""Long rows of the squeeze group: squeezes by four fifths against slab theory, and a sheared body at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from benchmarks.cases.materials import RIGID
from benchmarks.cases.squeeze import PRESETS, SLOW, TOUCH, close_sensors, normal_forces, squeeze_scene, world_in_contact
from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from tacsim.interface import Pose, Truth
from tacsim.models.scene import Gel, Scene
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

SIDE = 10e-3  # of the cube [m]
SHARES = (0.5, 0.8)  # of its height, by which the sensors close
RIGID_SHARES = (0.5, 0.6, 2 / 3, 0.75, 0.8)
# Between stiff plates. At 0.003 and draft, the force at a quarter of the height is 6 % too small; at standard it is
# 0.3 % smaller than at 0.002.
PLATES_MACH = {"draft": 0.001, "standard": 0.002}
DRIFT_SUBSTEPS = 100_000
UNREACHABLE = 1e-12  # a tolerance below every residual in float32


def slab(preset: str, repeat: int) -> list[Measurement]:
    """A cube between two soft gels whose sensors close by half and by four fifths of its height, against slab theory.

    The body itself is squeezed by less, because the gels deform: see `slab_force` for the theory, which does not
    include the cups that the gels form around it.
    """
    return _slab_rows(squeeze_scene(preset), SHARES, "sensors closed by {:.0f} %")


def rigid_slab(preset: str, repeat: int) -> list[Measurement]:
    """The same cube between larger gels that are 700 times as stiff, slowly: as between rigid plates."""
    scene = squeeze_scene(preset, "hybrid", **{**SLOW, "mach": PLATES_MACH[preset], "max_substeps": 5000})
    plates = Gel(size=(28e-3, 28e-3, 2e-3), material=RIGID, housing=None)
    return _slab_rows(scene.model_copy(update={"gel": plates}), RIGID_SHARES, "by {:.0f} %")


def _slab_rows(scene: Scene, shares: Sequence[float], words: str) -> list[Measurement]:
    """A row for each share of the cube's height by which the sensors close; the figures contain the cube's height."""
    assert scene.body is not None and scene.body.material.yield_stress is not None
    world = world_in_contact(scene)
    rows: list[Measurement] = []
    done = 2 * TOUCH
    for share in shares:
        timing, stats = timed(partial(close_sensors, world, share * SIDE - done), 1, warm=lambda: None)
        done = share * SIDE
        height, force = _ground_truth(world).height, float(normal_forces(world).mean())
        theory = slab_force(scene.body.material.yield_stress, SIDE**3, height)
        figures = {"force_n": force, "slab_n": theory, "ratio": force / theory, "height_mm": height * 1e3,
                   "squeezed_percent": (1 - height / SIDE) * 100}  # fmt: skip
        note = f"{words.format(share * 100)}: {height * 1e3:.2f} mm high, {force:.1f} N"
        rows.append(
            Measurement(
                timing, abs(force / theory - 1) * 100, "%", "slab theory", words.format(share * 100), stats.substeps,
                figures, note if stats.settled else f"{note}, not settled",
            )
        )  # fmt: skip
    return rows


def slab_force(yield_stress: float, volume: float, height: float) -> float:
    """F = sigma_y A (1 + W / (3 sqrt 3 H)) [N]: a square slab between rough rigid plates (Hill 1950), upper bound.

    H, A and W = sqrt A are those of the deformed slab; yield stress in uniaxial compression [Pa].
    """
    area = volume / height
    return yield_stress * area * (1 + math.sqrt(area) / (3 * math.sqrt(3) * height))


def sheared_rest(preset: str, repeat: int) -> list[Measurement]:
    """A body pressed and sheared, then held for 100,000 substeps: the drift of its centre and of its particles."""
    world = world_in_contact(squeeze_scene(preset))
    close_sensors(world, 0.5e-3)
    pose = world.pose("upper")
    world.move({"upper": Pose(pose.position + [0.5e-3, 0.0, 0.0], pose.quaternion)})
    _hold_still(world, preset, 4000)  # excludes the settling of the body after the shear
    before, force = _ground_truth(world), normal_forces(world)
    timing, stats = timed(partial(_hold_still, world, preset, DRIFT_SUBSTEPS), 1, warm=lambda: None)
    after = _ground_truth(world)
    centre = float(np.linalg.norm(after.position - before.position))
    each = np.linalg.norm(after.points.astype(np.float64) - before.points, axis=1)
    change = float(np.abs(normal_forces(world) / force - 1).max())
    figures = {"rms_um": float(np.sqrt(np.mean(each**2))) * 1e6, "force_change_percent": change * 100}
    note = "" if stats.substeps >= DRIFT_SUBSTEPS else f"it rested for {stats.substeps} substeps only"
    return [
        Measurement(timing, drift * 1e6, f"µm of {what}", "where it was", what, stats.substeps, figures, note)
        for what, drift in (("its centre", centre), ("its farthest particle", float(each.max())))
    ]


def _hold_still(world: World, preset: str, substeps: int) -> MoveStats:
    """Holds the state of `world` for this number of substeps."""
    still = make_world(squeeze_scene(preset, tolerance=UNREACHABLE, max_substeps=substeps))
    still.restore(world.snapshot())
    stats = still.move({})
    world.restore(still.snapshot())
    return stats


def _ground_truth(world: World) -> Truth:
    truth = world.truth()
    assert truth is not None
    return truth


CASES = (
    Case("squeeze", "slab", "tacsim", PRESETS["draft"], partial(slab, "draft"), long=True),
    Case("squeeze", "slab", "tacsim", PRESETS["standard"], partial(slab, "standard"), long=True),
    Case("squeeze", "rigid_slab", "tacsim", PRESETS["draft"], partial(rigid_slab, "draft"), long=True),
    Case("squeeze", "rigid_slab", "tacsim", PRESETS["standard"], partial(rigid_slab, "standard"), long=True),
    Case("squeeze", "sheared_rest", "tacsim", PRESETS["draft"], partial(sheared_rest, "draft"), long=True),
)
