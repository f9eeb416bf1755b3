"""The faster front end changes no kernel, and an error in one still names its place."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import pytest

from tacsim.compute.taichi_patches.front_end import function_source
from tests.tacsim.compute.fresh_process import run_script

KERNELS = """
import sys
import numpy as np
if sys.argv[1] == "ours":
    from tacsim.compute.runtime import start_taichi, ti
    start_taichi()
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

POINTS = np.eye(2, dtype=np.float32)

@ti.func
def weighed(values, share: ti.template(), shift):
    return share * values.norm_sqr() + shift

@ti.kernel
def mixed(a: ti.types.ndarray(dtype=ti.f32, ndim=1), whole: ti.types.ndarray(dtype=ti.i32, ndim=2)):
    for i, j in ti.ndrange(2, (0, 2)):
        whole[i, j] = min(i, -j, 5) // 2 + abs(i - 3) % 2 ** 3 | int(a[0]) << 1 & 7 ^ 2
    for index in ti.grouped(whole):
        whole[index] += index[0] - index.y
    turn = ti.Matrix([[0.0, -1.0], [1.0, 0.0]])
    point = turn @ ti.Vector([a[0], 2.0])
    for d, row in ti.static(enumerate(POINTS.tolist())):
        point[d] += ti.Vector(row).dot(point.yx) / len(point)
    if point[0] > 0.0 and not any(point < 0.0) or whole[0, 0] != 1:
        a[0] = weighed(point, ti.static(sum([0.25, 0.5])), shift=2.0) ** 2
    else:
        a[0] = max(float(whole[0, 0]), ti.u8(3), ti.cast(7, ti.f32), 3_000_000_000.0)
    while a[0] > 100.0:
        a[0] -= 50.0

@ti.kernel
def wrong(a: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    a[0] = nowhere

a, b = np.ones(1, np.float32), np.ones(1, np.float32)
sums(a, b)
print(a[0])
scaled(2.0, a)
scaled(3.0, a)  # compiled a second time
print(a[0])
mixed(a, np.zeros((2, 2), np.int32))
try:
    wrong(a)
except ti.TaichiCompilationError as error:
    print(error)
"""

ODD = '''
import functools

def bare(function):
    return function

@bare
def split(
    a, b=(
1,
    ),
):  # noqa
    """Text
at the margin."""
    if a:
# a remark at the margin
        return [
1]
    return a + \\
b

class Odd:
    def next(self): return 1
    async def later(self): pass
    unnamed = lambda self: 1
    @bare
    @bare
    def last(self):
        return (
            self)

# the end of a class
@functools.wraps(bare)
def wrapping(a):
    return a

def last(a):
    return a'''


def run(tmp_path: Path, front_end: str) -> tuple[str, set[str]]:
    return run_script(tmp_path / "kernels.py", KERNELS, front_end, kept=tmp_path / front_end)


@pytest.mark.deep
def test_cached_kernels_are_those_of_taichi_itself(tmp_path: Path) -> None:
    ours, theirs = run(tmp_path, "ours"), run(tmp_path, "theirs")
    assert ours[1] and ours[1] == theirs[1]
    assert ours[0].startswith("6.0\n36.0\n") and "6.0\n36.0\n" in theirs[0]


@pytest.mark.slow
def test_an_error_in_a_kernel_names_its_place(tmp_path: Path) -> None:
    printed, _ = run(tmp_path, "ours")
    assert printed.startswith("6.0\n36.0\n")
    line = KERNELS.splitlines().index("    a[0] = nowhere") + 1
    assert f'kernels.py", line {line}, in wrong:' in printed
    assert "    a[0] = nowhere\n" in printed and '"nowhere" is not defined' in printed


def test_the_lines_of_a_function_are_those_that_inspect_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "odd_lines.py").write_text(ODD, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    odd = importlib.import_module("odd_lines")
    for function in (odd.bare, odd.split, odd.Odd.next, odd.Odd.last, odd.last):
        assert function_source(function) == inspect.getsourcelines(function)
    for function in (odd.wrapping, odd.Odd.later, odd.Odd.unnamed, namedtuple("Without", "a").__new__):
        assert function_source(function) is None  # inspect is asked


@pytest.mark.slow
def test_modules_that_taichi_rarely_uses_are_imported_at_first_use() -> None:
    code = """
import sys
import tacsim.compute.runtime
print(sorted({"dill", "ssl", "urllib.request"} & sys.modules.keys()))
from taichi import _version_check
from taichi.lang import _wrap_inspect
print(_wrap_inspect.dill.source.findsource.__name__, _version_check.request.Request.__name__)
import dill, urllib.request
print(type(dill).__name__, type(urllib.request).__name__)
"""
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout == "[]\nfindsource Request\nmodule module\n"
