"""Functions compiled separately give right results, and every process finds them in the kernel cache."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tacsim.compute.fresh_process import run_script

pytestmark = pytest.mark.cpu

KERNEL = """
import random
import numpy as np
from tacsim.compute.runtime import start_taichi, ti
from tacsim.compute.taichi_patches.separate_functions import compiled_separately
start_taichi()
garbage = [bytearray(random.randrange(600, 3000)) for _ in range(20000)]  # and holes in it, where functions come to lie
for n in random.sample(range(20000), 10000):
    garbage[n] = None

Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)

@ti.func
def powers(a: ti.template(), i, highest):
    total, power = 0.0, 1.0
    for _ in range(highest):
        if a[i] > 0.0:
            power *= a[i]
            total += power
        else:
            total -= 1.0
    return total

@ti.func
def add(a: ti.template(), i):
    a[i] += SHIFT

@ti.func
def halve(a: ti.template(), i):
    a[i] *= 0.5

@compiled_separately
def summed(i: ti.i32, highest: ti.i32, a: Floats, b: Floats):
    b[i] = powers(a, i, highest)

@compiled_separately
def one(work: ti.template(), i: ti.i32, a: Floats):
    work(a, i)

@compiled_separately
def raise_by(amount: ti.template(), i: ti.i32, a: Floats):
    a[i] += amount

@compiled_separately
def both(i: ti.i32, a: Floats, b: Floats):
    one(add, i, a)
    one(halve, i, b)

@ti.kernel
def kernel(a: Floats, b: Floats):
    for i in range(a.shape[0]):
        summed(i, 3, a, b)
        one(add, i, b)
        one(halve, i, a)
        both(i, a, b)
        for amount in ti.static(range(-6, 7)):
            raise_by(amount, i, a)

a = np.array([-1.0, 0.5, 2.0], np.float32)
b = np.zeros(3, np.float32)
kernel(a, b)
print(a.tolist(), b.tolist())
"""


def run(tmp_path: Path, shift: float = 1.0, seed: int = 0) -> tuple[str, set[str]]:
    text = KERNEL.replace("SHIFT", str(shift))
    return run_script(tmp_path / "kernel.py", text, kept=tmp_path / "kept", PYTHONHASHSEED=str(seed))


EXPECTED = "[0.5, 1.25, 2.0] [-1.0, 0.9375, 7.5]\n"


@pytest.mark.slow
def test_results_are_right_and_found_again_in_every_process(tmp_path: Path) -> None:
    first = run(tmp_path)
    assert first[0] == EXPECTED and len(first[1]) == 1
    for seed in range(1, 6):
        assert run(tmp_path, seed=seed) == first


@pytest.mark.slow
def test_another_body_of_a_function_is_another_kernel(tmp_path: Path) -> None:
    assert run(tmp_path)[0] == EXPECTED
    printed, kept = run(tmp_path, shift=2.0)
    assert printed == "[1.5, 2.25, 3.0] [-0.5, 1.4375, 8.0]\n" and len(kept) == 2
