"""State that stays on a device: what kernels find in it, what is copied and when, and what a failed motion returns to.

Runs as a program for a device, in a process of its own: `test_device_state.py OUT.json`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Gel, Indenter, Scene, Sphere
from tacsim.physics.body.moments import moments_of
from tacsim.physics.contact.gel_overlap import displacement_bounds
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.motion.tuning import SUBSTEPS_PER_LAUNCH
from tacsim.physics.snapshot import gel_arrays
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.device_state import runs_of
from tacsim.physics.worlds.fem import FemWorld
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.hybrid_state import HybridState
from tacsim.physics.worlds.press import PressWorld

SECONDS = 600  # for the process; a first run compiles
GEL = Gel(size=(5e-3, 4e-3, 2e-3))
QUICK = {"mach": 0.1, "tolerance": 0.4, "max_substeps": 40}


def squeeze(side: float) -> Scene:
    body = Body(geometry=Box(size=(side, 2e-3, 1.5e-3)), material=BodyMaterial(yield_stress=2e4))
    return Scene.model_validate({"body": body, "gel": GEL, "settling": QUICK})


def unlike() -> Scene:
    """Another gel above: larger, thinner, stiffer and cut finer."""
    above = {"size": [6e-3, 5e-3, 1.5e-3], "element_size": 0.5e-3, "material": {"youngs_modulus": 0.4e6}}
    return Scene.model_validate({**squeeze(3e-3).model_dump(), "gels": {"upper": above}})


def press() -> Scene:
    settings = {"body": None, "indenter": Indenter(geometry=Sphere(radius=3e-3)), "gel": GEL, "settling": QUICK}
    return Scene.model_validate(settings)


def closer(world: FemWorld, by: float) -> dict[str, Pose]:
    name = "upper" if "upper" in world.sensors else "indenter"
    pose = world.pose(name)
    return {name: Pose(pose.position + [0.0, 0.0, -by], pose.quaternion)}


def largest(found: Any, truth: Any) -> float:
    """Error over the largest entry of the truth."""
    truth = np.asarray(truth, np.float64)
    return float(np.abs(np.asarray(found, np.float64) - truth).max() / np.abs(truth).max())


def torn(world: FemWorld) -> None:
    """Something of everything: displacements and speeds at random, all within bounds."""
    rng = np.random.default_rng(3)
    sizes = {"gel_displacement": 0.02, "gel_velocity": 0.1, "strain": 0.05, "position": 0.3}
    for name, array in world.arrays().items():
        size = sizes.get(name.removesuffix("_lower").removesuffix("_upper"))
        if size is not None:
            array += rng.normal(scale=size, size=array.shape).clip(-3 * size, 3 * size).astype(np.float32)


def compared(world: FemWorld) -> dict[str, float]:
    """Errors of what kernels find in a state, against NumPy."""
    torn(world)
    seen = world._survey()
    assert seen is not None
    gels, index = world.state.gels, world._index
    displacements = gel_arrays(world.arrays(), "gel_displacement").items()
    corners = [diagnosis.corner_volumes(u, world._gels[g].thickness).min() for g, u in displacements]
    shortest, tops = gels.min_edge_length(index), gels.surface_displacements(index)
    seen_shortest = seen.min_edge_length if len(shortest) == len(tops) else [min(seen.min_edge_length)]
    found = {
        "shortest": largest(seen_shortest, shortest),
        "corner": largest(seen.smallest_corner, min(corners)),
        "tops": largest(seen.surface_bounds[: len(world.sensors)], [displacement_bounds(top) for top in tops]),
        "surface": max(largest(*pair) for pair in zip(world.state.surface_displacements(index), tops, strict=True)),
    }
    if isinstance(world.state, HybridState):
        particles, seen_moments = world.state.particles, seen.moments
        moments = moments_of(particles, index)
        found["extents"] = largest(seen.extents, particles.extents(index))
        for name in ("centre", "reference_centre", "second", "reference_second", "cross_moments"):
            found[name] = largest(getattr(seen_moments, name), getattr(moments, name))
        x, planes = world.state.positions_and_planes(index)
        found["outside"] = max(largest(x, particles.x(index)), largest(planes, particles.plane(index)))
    return found


def verdicts(world: FemWorld) -> dict[str, tuple[bool, bool]]:
    """Whether a state is found finite and sound: as it is, with one number of an array spoilt, with one too large."""

    def verdict() -> tuple[bool, bool]:
        seen = world._survey()
        assert seen is not None
        return seen.finite, seen.is_healthy

    before, found = world.snapshot(), {"well": verdict()}
    for name in world.arrays():
        if name == "sums":
            continue
        for value in (np.nan, -np.inf):
            array = world.arrays()[name]
            array[tuple(n - 1 for n in array.shape)] = value
            found[f"{name} {value}"] = verdict()
            world.restore(before)
    velocities = gel_arrays(world.arrays(), "gel_velocity")
    velocities[max(velocities)][-1, 2, 1, 1, 0] = -0.6
    found["fast"] = verdict()
    world.restore(before)
    if "strain" in world.arrays():
        world.arrays()["strain"][5, :3] = -0.9
        found["crushed"] = verdict()
        world.restore(before)
    return found


def copied(world: FemWorld) -> dict[str, Any]:
    """Bytes sent and brought back by what one does with a world."""
    device = world.state.device
    assert device is not None
    found: dict[str, Any] = {}

    def spend(name: str, work: Any) -> Any:
        before = device.arrays.sent_bytes, device.arrays.received_bytes
        result = work()
        found[name] = device.arrays.sent_bytes - before[0], device.arrays.received_bytes - before[1]
        return result

    spend("first", lambda: world.move(closer(world, 0.2e-3)))
    stats = spend("move", lambda: world.move(closer(world, 0.1e-3)))
    spend("wrench", lambda: [world.wrench(name) for name in world.sensors])
    spend("surface", lambda: [world.surface(name) for name in world.sensors])
    spend("again", lambda: [world.surface(name) for name in world.sensors])
    spend("truth", world.truth)
    whole = spend("snapshot", world.snapshot)
    spend("after", lambda: world.move(closer(world, 0.01e-3)))
    here = list(world._poses.values())
    readings = stats.hold // world._plan_flow(here, here).interval
    driven = stats.substeps - stats.hold
    return {
        **found, "substeps": stats.substeps, "launches": -(-driven // SUBSTEPS_PER_LAUNCH) + readings,
        "state": sum(array.nbytes for array in whole.values()),
    }  # fmt: skip


def failed(world: FemWorld, by: float) -> dict[str, Any]:
    """A motion that cannot succeed: what is told of it, and whether the world is as before, to the bit."""
    world.move(closer(world, 0.1e-3))
    here = world.snapshot()
    far = closer(world, by)
    try:
        world.move(far)
    except SimulationDiverged as failure:
        after = world.snapshot()
        same = all(np.array_equal(after[name], here[name]) for name in here)
        good = failure.good  # before the launch that went wrong, if one did
        differ = [
            name for name in good if name in failure.failed and not np.array_equal(good[name], failure.failed[name])
        ]
        moved = world.move(closer(world, 0.05e-3))
        return {
            "same": same, "differ": differ, "substeps": moved.substeps,
        }  # fmt: skip
    return {"same": "it did not fail"}


def everything() -> dict[str, Any]:
    batch = Batch([squeeze(2e-3), squeeze(3e-3)])
    second = batch.worlds[1]
    assert isinstance(second, HybridWorld)
    other = Batch([unlike(), unlike()])
    return {
        "copied": {"body": copied(HybridWorld(squeeze(3e-3))), "press": copied(PressWorld(press()))},
        "failed": failed(HybridWorld(squeeze(3e-3)), 3.2e-3),
        "verdicts": {
            "body": verdicts(second),
            "press": verdicts(PressWorld(press())),
            "unlike body": verdicts(other.worlds[1]),
        },
        "compared": {
            "body": compared(second),
            "press": compared(PressWorld(press())),
            "unlike body": compared(other.worlds[1]),
        },
    }


def test_consecutive_environments_are_stored_together() -> None:
    assert runs_of([]) == []
    assert runs_of([0, 1, 2, 5, 7, 8]) == [(0, 3), (5, 6), (7, 9)]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Any:
    out = tmp_path_factory.mktemp("device") / "found.json"
    device = os.environ.get("TACSIM_DEVICE") or "cpu"
    environment = {**os.environ, "TACSIM_DEVICE": "cpu-as-device" if device == "cpu" else device}
    done = subprocess.run(
        [sys.executable, __file__, str(out)], env=environment, capture_output=True, text=True, timeout=SECONDS,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(out.read_text())


@pytest.mark.deep
@pytest.mark.timeout(2 * SECONDS)
def test_kernels_find_in_a_state_what_numpy_finds(found: Any) -> None:
    for world, errors in found["compared"].items():
        assert len(errors) == (11 if "body" in world else 4)
        for name, error in errors.items():
            assert error < 2e-5, (world, name)


@pytest.mark.deep
@pytest.mark.timeout(2 * SECONDS)
def test_kernels_see_each_number_that_is_not_finite_or_too_large(found: Any) -> None:
    for verdicts in found["verdicts"].values():
        assert verdicts.pop("well") == [True, True]
        assert verdicts.pop("fast") == [True, False]
        if "crushed" in verdicts:
            assert verdicts.pop("crushed") == [True, False]
        assert len(verdicts) >= 10
        assert {name: verdict for name, verdict in verdicts.items() if verdict != [False, False]} == {}


@pytest.mark.deep
@pytest.mark.timeout(2 * SECONDS)
def test_state_stays_on_the_device_until_somebody_asks_for_it(found: Any) -> None:
    for world, copied in found["copied"].items():
        sent, brought = copied["move"]
        launches = copied["launches"]
        # where an indenter is held its gel's surface is searched for points that miss it
        looked = copied["state"] / 2 if world == "press" else 0
        assert brought < (1000 + looked) * launches, world
        assert sent < 144 * 2 * copied["substeps"] + 1000 * launches, world  # drives, parameters
        assert copied["wrench"] == copied["again"] == [0, 0]
        assert copied["surface"][0] == 0 and copied["surface"][1] < copied["state"] / 2
        assert copied["snapshot"][0] == 0 and copied["snapshot"][1] > 0.9 * copied["state"]
        assert copied["after"][0] < sent + 2000  # what was looked at alone is not sent again
    assert found["copied"]["body"]["surface"][1] > 0
    assert 0 < found["copied"]["body"]["truth"][1] < 0.25 * found["copied"]["body"]["state"]


@pytest.mark.deep
@pytest.mark.timeout(2 * SECONDS)
def test_failed_motion_restores_state_stored_on_device(found: Any) -> None:
    failed = found["failed"]
    assert failed["same"] is True and failed["substeps"] > 0
    assert {"gel_displacement", "position"} <= set(failed["differ"])


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(everything()))
