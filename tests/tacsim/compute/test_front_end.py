"""The quicker front end changes no kernel, and still says where a mistake in one stands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tacsim.compute.front_end import quicken

KERNELS = """
import sys
import numpy as np
if sys.argv[1] == "ours":
    from tacsim.compute.runtime import start, ti
    start()
else:
    import taichi as ti
    ti.init(arch=ti.cpu, default_fp=ti.f32, offline_cache=True, cfg_optimization=False)
from typing import Any, NamedTuple

class Pair(NamedTuple):
    a: Any
    b: Any

    @ti.func
    def total(self):
        return self.a[0] + \\
            self.b[0]

@ti.func
def doubled(value):
    return 2.0 * value

@ti.kernel
def sums(a: ti.types.ndarray(dtype=ti.f32, ndim=1), b: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for i in range(a.shape[0]):
        pair = ti.static(Pair(a, b))
        a[i] = doubled(pair.total()) + doubled(b[i])

@ti.kernel
def scaled(factor: ti.template(), a: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    a[0] *= factor

@ti.kernel
def wrong(a: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    a[0] = nowhere

a, b = np.ones(1, np.float32), np.ones(1, np.float32)
sums(a, b)
print(a[0])
scaled(2.0, a)
scaled(3.0, a)  # compiled a second time
print(a[0])
try:
    wrong(a)
except ti.TaichiCompilationError as error:
    print(error)
"""


def run(tmp_path: Path, front_end: str) -> tuple[str, set[str]]:
    """What a fresh process prints, and the names of the compiled kernels that it keeps."""
    cache, script = tmp_path / front_end, tmp_path / "kernels.py"
    script.write_text(KERNELS, encoding="utf-8")
    environment = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": str(cache), "TACSIM_DEVICE": "cpu"}
    command = [sys.executable, "-W", "ignore", str(script), front_end]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout, {each.name for each in cache.glob("*.tic")}


@pytest.mark.deep
def test_cached_kernels_are_those_of_taichi_itself(tmp_path: Path) -> None:
    ours, theirs = run(tmp_path, "ours"), run(tmp_path, "theirs")
    assert ours[1] and ours[1] == theirs[1]
    assert ours[0].startswith("6.0\n36.0\n") and "6.0\n36.0\n" in theirs[0]


def test_a_mistake_in_a_kernel_is_told_with_its_place(tmp_path: Path) -> None:
    printed, _ = run(tmp_path, "ours")
    assert printed.startswith("6.0\n36.0\n")
    line = KERNELS.splitlines().index("    a[0] = nowhere") + 1
    assert f'kernels.py", line {line}, in wrong:' in printed
    assert "    a[0] = nowhere\n" in printed and '"nowhere" is not defined' in printed


def test_another_taichi_stays_as_it_is() -> None:
    module, context, builder = SimpleNamespace(renamed=1), SimpleNamespace(), SimpleNamespace()
    quicken(module, context, builder)
    assert vars(module) == {"renamed": 1} and vars(context) == {} and vars(builder) == {}
