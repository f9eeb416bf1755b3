"""The same motions on the CPU and on a device. Each in a process of its own: Taichi starts once a process.

CUDA if there is any, else the processor as if it were a device: so a device's kernels can be checked, though not timed,
without a GPU. Runs as a program for one device: `test_device.py OUT.npz`.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.compute.runtime import is_available
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.exec.device_arrays import DeviceArrays
from tacsim.physics.exec.layout import SHAPE_FIRST
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.motion.controller import Launch
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.press import PressWorld

SECONDS = 600  # for one process; a first run compiles
GEL = Gel(size=(5e-3, 4e-3, 2e-3))
QUICK = {"mach": 0.1, "tolerance": 0.4, "max_substeps": 60}  # few substeps: a device that is a processor is slow


def press(geometry: Shape) -> Scene:
    return Scene.model_validate({"body": None, "indenter": Indenter(geometry=geometry), "gel": GEL, "settling": QUICK})


def egg(folder: Path) -> Mesh:
    """So long that, over the middle of the gel, its first tiles are just out of reach."""
    import trimesh

    mesh = trimesh.creation.icosphere(3)
    mesh.apply_scale((7.65, 3.0, 2.0))
    mesh.export(folder / "egg.stl")
    return Mesh(path=str(folder / "egg.stl"))


def squeeze(side: float, stress: float = 2e4) -> Scene:
    body = Body(geometry=Box(size=(side, 2e-3, 1.5e-3)), material=BodyMaterial(yield_stress=stress))
    return Scene.model_validate({"body": body, "gel": GEL, "settling": QUICK, "gravity": [0.0, 0.0, -9.81]})


def unlike(side: float) -> Scene:
    """Another gel above: larger, thinner, stiffer and cut finer."""
    above = {"size": [6e-3, 5e-3, 1.5e-3], "element_size": 0.5e-3, "material": {"youngs_modulus": 0.4e6}}
    return Scene.model_validate({**squeeze(side).model_dump(), "gels": {"upper": above}})


def closer(world: World, by: float, across: float = 0.0) -> dict[str, Pose]:
    """The upper one comes nearer by `by` [m], and goes aside."""
    name = "upper" if "upper" in world.sensors else "indenter"
    pose = world.pose(name)
    return {name: Pose(pose.position + [across, 0.0, -by], pose.quaternion)}


def outcome(world: World, stats: MoveStats) -> dict[str, Any]:
    """What is compared: stats, wrenches, gel surfaces and the whole state."""
    state = {f"state.{name}": array for name, array in world.snapshot().items() if name != "sums"}
    return {
        "stats": np.array(
            [
                stats.substeps,
                stats.hold,
                stats.residual <= QUICK["tolerance"],
                stats.guard_hits,
                stats.retries,
                stats.overlap,
            ]
        ),
        "wrench": np.array([world.wrench(name) for name in world.sensors]),
        "surface": np.concatenate([world.surface(name).displacement.ravel() for name in world.sensors]),
        **state,
    }


def all_outcomes(folder: Path) -> dict[str, Any]:
    """Every motion that is compared; and, as words, what is found unphysical in a launch."""
    found: dict[str, Any] = {}

    def note(name: str, params: Mapping[str, Any]) -> None:
        found.update({f"{name}.{key}": value for key, value in params.items()})

    pressed = PressWorld(press(Sphere(radius=3e-3)))
    note("press", outcome(pressed, pressed.move(closer(pressed, 0.35e-3, 0.1e-3))))
    interrupted = PressWorld(press(Sphere(radius=3e-3)))
    interrupted.move(closer(interrupted, 0.05e-3))
    here = interrupted.snapshot()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DeviceArrays, "download_copy", lambda self, name: (_ for _ in ()).throw(KeyboardInterrupt))
        with contextlib.suppress(KeyboardInterrupt):
            interrupted.move(closer(interrupted, 0.1e-3))  # on a device its launch ends, and is never brought back
    interrupted.restore(here)
    note("interrupted", outcome(interrupted, interrupted.move(closer(interrupted, 0.2e-3))))
    meshed = PressWorld(press(egg(folder)))
    meshed.move(closer(meshed, 0.3e-3))
    tiles = meshed.state.counts[0, SHAPE_FIRST]
    note("mesh", outcome(meshed, meshed.move(closer(meshed, 0.05e-3, 0.2e-3))))
    assert meshed.state.counts[0, SHAPE_FIRST] < tiles  # others were laid, and had to be sent
    # one environment alone would hide a wrong index of environments, equal bodies one of particles
    batch = Batch([squeeze(2e-3), squeeze(3e-3, 1e4)])
    first, second = batch.worlds
    assert isinstance(first, HybridWorld) and isinstance(second, HybridWorld)
    ends = batch.move([closer(first, 0.5e-3, 0.1e-3), closer(second, 0.5e-3)])
    for name, world, stats in (("one", first, ends[0]), ("other", second, ends[1])):
        assert isinstance(stats, MoveStats)
        note(name, outcome(world, stats))
    two = Batch([unlike(2e-3), unlike(3e-3)])
    ends_of_two = two.move([closer(world, 0.5e-3, 0.1e-3) for world in two.worlds])
    assert isinstance(ends_of_two[1], MoveStats)
    note("unlike", outcome(two.worlds[1], ends_of_two[1]))
    # a launch of environment 0 alone, in states that are unphysical; environment 1 rests
    last = (1, -1, -1, -1, 2)  # node of the upper gel, in the surface
    for name, array, entry, value in (("race", "velocity", (-1, 2), 20.0), ("invert", "gel_displacement", last, -6.0)):
        before = first.snapshot()
        first.arrays()[array][entry] += value
        first.state.particles.drop_grid_velocities(0)  # so that what particles know counts
        here = list(first._poses.values())
        prepared = first.prepare(Launch(first.plan(here, here), 0, 1))
        first.state.advance({0: prepared.drive})
        try:
            first.outcome(prepared)
            note(name, {"words": "nothing"})
        except SimulationDiverged as failure:
            note(name, {"words": failure.cause})
        first.restore(before)
    assert isinstance(ends[1], MoveStats)
    note("rests", outcome(second, ends[1]))
    note("learned", episodes())
    return found


def episodes() -> dict[str, Any]:
    """What two environments of a batch return: two steps of both, one of the first after it was reset."""
    import gymnasium

    import tacsim.gym.env  # noqa: F401  registers

    small = [
        "scene.gel.size=[8 mm, 8 mm, 4 mm]", "scene.preset=learn", "scene.body.geometry.size=[4 mm, 4 mm, 4 mm]",
        "scene.settling.mach=0.05", "scene.settling.tolerance=0.1", "motion=flowing", "task.goal=3 mm",
        *(f"sensors.{name}.model.geometry.{what}" for name in ("lower", "upper") for what in ("width=16", "height=16")),
    ]  # fmt: skip
    many = gymnasium.make_vec("tacsim/Squeeze-v0", 2, autoreset_mode="Disabled", overrides=small, features=None)
    many.reset(seed=[1, 2])
    found = [many.step(np.array([[0.5, 1.0], [1.0, 0.2]], np.float32)) for _ in range(2)]
    many.reset(options={"reset_mask": np.array([True, False])})
    found.append(many.step(np.array([[1.0, 0.2], [0.5, 0.5]], np.float32)))
    many.close()
    return {
        **{name: np.array([flats[name] for flats, *_ in found]) for name in ("wrench_lower", "height_upper")},
        "body_height": np.array([info["body_height"] for *_, info in found]),
        "reward": np.array([reward for _, reward, *_ in found]),
    }  # fmt: skip


def run(device: str, out: Path) -> dict[str, Any]:
    """`all_outcomes` on a device, from a process of its own."""
    environment = {**os.environ, "TACSIM_DEVICE": device}
    done = subprocess.run(
        [sys.executable, __file__, str(out)], env=environment, capture_output=True, text=True, timeout=SECONDS,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    with np.load(out) as file:
        return dict(file)


def device_here() -> str:
    """CUDA or Vulkan, if Taichi really works there: a driver alone does not make a device. Else the processor."""
    code = (
        "from tacsim.compute.runtime import start_taichi, ti; start_taichi(); "
        "a = ti.ndarray(ti.f32, 4); a.fill(2.0); print(a.to_numpy())"
    )
    for device in ("cuda", "vulkan"):
        if is_available(device):
            done = subprocess.run(
                [sys.executable, "-c", code], env={**os.environ, "TACSIM_DEVICE": device}, capture_output=True,
                text=True, timeout=SECONDS, check=False,
            )  # fmt: skip
            if done.returncode == 0 and "2. 2. 2. 2." in done.stdout:
                return device
    return "cpu-as-device"


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """All outcomes on the CPU and on the device."""
    folder = tmp_path_factory.mktemp("device")
    return run("cpu", folder / "cpu.npz"), run(device_here(), folder / "device.npz")


@pytest.mark.deep
@pytest.mark.timeout(3 * SECONDS)
def test_device_and_cpu_follow_same_motion(pair: tuple[dict[str, Any], dict[str, Any]]) -> None:
    cpu, there = pair
    assert cpu.keys() == there.keys()
    for name in ("press", "interrupted", "mesh", "one", "other", "unlike"):
        assert there[f"{name}.stats"] == pytest.approx(cpu[f"{name}.stats"], abs=1e-7)
        assert cpu[f"{name}.stats"][2] == 1, "not at rest: compares nothing"
        largest = np.abs(cpu[f"{name}.wrench"][:, :3]).max()
        assert largest > 0.01
        assert np.abs(there[f"{name}.wrench"] - cpu[f"{name}.wrench"]).max() < 1e-3 * largest
        assert np.abs(there[f"{name}.surface"] - cpu[f"{name}.surface"]).max() < 1e-6
        assert np.abs(cpu[f"{name}.surface"]).max() > 20e-6


@pytest.mark.deep
@pytest.mark.timeout(3 * SECONDS)
def test_every_array_agrees(pair: tuple[dict[str, Any], dict[str, Any]]) -> None:
    cpu, there = pair
    for name, value in cpu.items():
        if ".state." in name:
            scale = max(float(np.abs(value).max()), 1e-3)
            assert np.abs(there[name] - value).max() < 2e-3 * scale, name


@pytest.mark.deep
@pytest.mark.timeout(3 * SECONDS)
def test_one_that_rests_keeps_its_bits(pair: tuple[dict[str, Any], dict[str, Any]]) -> None:
    for found in pair:
        same = [name for name in found if name.startswith("other.state.")]
        assert same
        assert all(np.array_equal(found[name], found[name.replace("other", "rests")]) for name in same)


@pytest.mark.deep
@pytest.mark.timeout(3 * SECONDS)
def test_environments_of_a_batch_return_the_same(pair: tuple[dict[str, Any], dict[str, Any]]) -> None:
    cpu, there = pair
    names = [name for name in cpu if name.startswith("learned.")]
    assert len(names) == 4
    for name in names:
        scale = np.abs(cpu[name]).max()
        assert np.abs(there[name] - cpu[name]).max() < 2e-3 * scale, name
    pressed = -cpu["learned.wrench_lower"][..., 2]  # (steps, environments)
    assert pressed.max(axis=0).min() > 0.05 and np.ptp(pressed, axis=1).min() > 0.01


@pytest.mark.deep
@pytest.mark.timeout(3 * SECONDS)
def test_unphysical_state_is_detected_on_device(pair: tuple[dict[str, Any], dict[str, Any]]) -> None:
    for found in pair:
        assert str(found["race.words"]).startswith("a particle moves at")
        assert str(found["invert.words"]).startswith("a gel element is inverted or crushed")


SENT = """
import numpy as np
from tacsim.compute.runtime import start_taichi, ti
from tacsim.physics.exec.device_arrays import DeviceArrays
start_taichi()
arrays, host = DeviceArrays(), np.ones((2, 3), np.float32)
for version in (0, 0, 1):
    print(arrays.upload_if_changed("values", host, ti.f32, version).to_numpy().max())
    host += 1
print(arrays.upload_if_changed("values", np.ones((4, 3), np.float32), ti.f32, 2).shape)
there = arrays.upload("state", host, ti.f32)
there.fill(7.0)  # as kernels do
print(arrays.upload("state", host, ti.f32).to_numpy().max())
arrays.download(state=host)
there.fill(8.0)
print(host.max(), arrays.upload("state", host, ti.f32).to_numpy().max())
host[0, 0] = np.nan
print(np.isnan(arrays.upload("state", host, ti.f32).to_numpy()).sum())
there.fill(9.0)
print(arrays.upload("state", host, ti.f32).to_numpy().max())
arrays.invalidate("state")
print(arrays.upload("state", host, ti.f32).to_numpy()[1, 2])
"""


@pytest.mark.slow
def test_only_changed_arrays_are_sent_to_device() -> None:
    done = subprocess.run([sys.executable, "-c", SENT], capture_output=True, text=True, timeout=SECONDS, check=True)
    words = done.stdout.split("\n")
    assert words[:4] == ["1.0", "1.0", "3.0", "(4, 3)"]  # by version
    assert words[4:6] == ["7.0", "7.0 8.0"]  # not sent: the host has not changed since it was sent, or brought back
    assert words[6:9] == ["1", "9.0", "7.0"]  # sent once, though a NaN is in it; and once more when it is forgotten


WORLD = (
    "from tacsim.physics.world import make_world; from tacsim.models.scene import Scene; "
    "make_world(Scene(physics={!r}))"
)


@pytest.mark.parametrize(
    ("device", "code", "words"),
    [
        ("abacus", WORLD.format("hybrid"), "ValueError: TACSIM_DEVICE must be one of cpu, cuda, vulkan, metal,"),
        ("vulkan", WORLD.format("seed"), "RuntimeError: physics 'seed' runs on the CPU only"),
        pytest.param(
            "cuda", WORLD.format("hybrid"), "RuntimeError: TACSIM_DEVICE is 'cuda', but Taichi finds no such device",
            marks=pytest.mark.skipif(is_available("cuda"), reason="there is a CUDA device"),
        ),
    ],
)  # fmt: skip
def test_a_device_that_will_not_do_is_refused(device: str, code: str, words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "TACSIM_DEVICE": device}, capture_output=True, text=True,
        timeout=SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert words in done.stderr


if __name__ == "__main__":
    np.savez(sys.argv[1], **all_outcomes(Path(sys.argv[1]).parent))
