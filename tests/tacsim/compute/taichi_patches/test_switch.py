"""TACSIM_TAICHI_PATCHES=0, or an unknown version of Taichi, leaves Taichi as it is; results agree."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from tacsim.compute import taichi_patches
from tests.tacsim.compute.fresh_process import run_script

PROGRAM = """
import warnings
from importlib import metadata
import numpy as np
INSTALLED
from tacsim.compute.runtime import start_taichi, ti
from tacsim.compute.taichi_patches.repeated_launch import launch_kernel
from tacsim.compute.taichi_patches.separate_functions import compiled_separately
start_taichi()
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Pair = ti.types.argpack(a=Floats, b=Floats)

@compiled_separately
def add_root(i: ti.i32, a: Floats, b: Floats):
    b[i] += ti.sqrt(a[i] + 0.1)

@ti.kernel
def add_roots(times: ti.i32, pair: Pair):
    for i in range(pair.a.shape[0]):
        for _ in range(times):
            add_root(i, pair.a, pair.b)

a, b = np.arange(5, dtype=np.float32), np.ones(5, np.float32)
for times in (1, 2, 3):
    launch_kernel(add_roots, times, (a, b))
WORLD
print(ti.lang.kernel_impl._inside_class.__module__, b.tobytes().hex(), bits)
"""
PRESS = """
from tacsim.interface import Pose
from tacsim.models.scene import Gel, Indenter, Scene, Sphere
from tacsim.physics.worlds.press import PressWorld
gel = Gel(size=(8e-3, 8e-3, 4e-3))
world = PressWorld(Scene(body=None, indenter=Indenter(geometry=Sphere(radius=3e-3)), gel=gel))
for _ in range(2):
    world.move({"indenter": Pose(world.pose("indenter").position - [0.0, 0.0, 0.2e-3])})
bits = world.wrench("lower").tobytes().hex()
"""
SQUEEZE = """
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.world import make_world
world = make_world(Scene(preset="learn"))
upper = world.pose("upper")
world.move({"upper": Pose(upper.position - [0.0, 0.0, 0.5e-3], upper.quaternion)})
bits = world.wrench("lower").tobytes().hex()
"""
OWN, TAICHI = "tacsim.compute.taichi_patches.front_end", "taichi.lang.kernel_impl"


def run(tmp_path: Path, *, switch: str = "1", version: str = "", world: str = "bits = ''") -> list[str]:
    """What the program prints in a fresh process: the module of a patched function, and the bits of its results."""
    installed = f"metadata.version = lambda name: '{version}'" if version else ""
    text = PROGRAM.replace("INSTALLED", installed).replace("WORLD", world)
    kept = tmp_path / "kept"  # of all runs: equal kernels are compiled once
    printed, _ = run_script(tmp_path / "program.py", text, kept=kept, TACSIM_TAICHI_PATCHES=switch)
    return printed.split()


@pytest.mark.slow
def test_results_are_the_same_bits_without_patches(tmp_path: Path) -> None:
    patched, unpatched = (run(tmp_path, switch=switch, world=PRESS) for switch in ("1", "0"))
    assert (patched[0], unpatched[0]) == (OWN, TAICHI)
    assert patched[1:] == unpatched[1:] and len(patched) == 3


@pytest.mark.deep
def test_a_squeeze_agrees_to_rounding_without_patches(tmp_path: Path) -> None:
    patched, unpatched = (run(tmp_path, switch=switch, world=SQUEEZE) for switch in ("1", "0"))
    assert patched[1] == unpatched[1]
    wrenches = [np.frombuffer(bytes.fromhex(printed[2])) for printed in (patched, unpatched)]
    assert np.allclose(*wrenches, rtol=1e-5, atol=1e-5) and wrenches[0].any()


def test_an_unknown_version_runs_unpatched(tmp_path: Path) -> None:
    assert run(tmp_path, version="1.7.99")[0] == TAICHI


def test_an_unknown_version_is_named_in_one_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TACSIM_TAICHI_PATCHES", raising=False)
    monkeypatch.setattr(metadata, "version", lambda name: "1.7.99")
    words = "Taichi 1.7.99 runs without tacsim's patches, which are known for 1.7.4: results agree to rounding, starts"
    with pytest.warns(UserWarning, match=re.escape(words)) as warned:
        assert not taichi_patches.are_enabled.__wrapped__()
    assert len(warned) == 1


def test_the_installed_version_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise starts are slow and nobody notices: see docs/taichi-patches.md for what to check."""
    monkeypatch.delenv("TACSIM_TAICHI_PATCHES", raising=False)
    assert taichi_patches.are_enabled.__wrapped__()


def test_a_switch_that_is_neither_0_nor_1_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACSIM_TAICHI_PATCHES", "off")
    with pytest.raises(ValueError, match=r"TACSIM_TAICHI_PATCHES must be 0 \(off\) or 1 \(on\), found 'off'"):
        taichi_patches.are_enabled.__wrapped__()
