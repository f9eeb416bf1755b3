"""Where grips run: any number of threads with the same bits, and no device."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tacsim.compute.runtime import DEVICE

ROOT = Path(__file__).resolve().parents[4]
PROGRAM = """
import hashlib
import numpy as np
from tests.tacsim.physics.grip.gripping import BALL, BOX, make_grip, pads_at
from tacsim.physics.grip.model import HeldObject

world, found = make_grip(HeldObject(BOX, 0.1), HeldObject(BALL, 0.05)), hashlib.sha256()
world.grasp(pads_at(count=2), [3.0, 4.0])
for number in range(12):
    states = world.step(pads_at(-0.3e-3 - 2e-5 * number, count=2), forces=[3.0, np.nan], settle=number % 2 == 0)
    found.update(states.wrenches.tobytes() + states.objects.tobytes() + states.substeps.tobytes())
print(found.hexdigest())
"""


def run(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True,
        timeout=240,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.cpu
def test_the_number_of_threads_changes_no_bit() -> None:
    results = [run(TACSIM_THREADS=str(threads)) for threads in (1, 2, 4)]
    assert all(done.returncode == 0 for done in results), results[0].stderr
    assert len({done.stdout for done in results}) == 1


@pytest.mark.slow
@pytest.mark.skipif(DEVICE != "cpu", reason="asks for a device itself")
def test_a_device_is_refused() -> None:
    done = run(TACSIM_DEVICE="cpu-as-device")
    assert "an object held by pads runs on the CPU only" in done.stderr
