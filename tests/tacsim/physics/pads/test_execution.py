"""Where gel pads run: any number of threads with the same bits, on the launching thread or on Taichi's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
PROGRAM = """
import hashlib
from tests.tacsim.physics.pads.test_pads import BALL, GelPads, pad, wander

found = hashlib.sha256()
for count in (1, 3):  # of one pad more threads, in other pieces
    pads = GelPads([pad(BALL)] * count, 1e-3)
    for poses in wander(count, 5):
        found.update(pads.step(poses).tobytes() + pads.surface(0).displacement.tobytes())
    found.update(b"".join(pads.snapshot(0)[name].tobytes() for name in ("gel_velocity", "anchor", "sums")))
print(found.hexdigest(), pads.wrenches[:, 2].max())
"""


@pytest.mark.slow
@pytest.mark.cpu
def test_the_number_of_threads_changes_no_bit() -> None:
    results = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], cwd=ROOT, env={**os.environ, "TACSIM_THREADS": str(threads)},
            capture_output=True, text=True, timeout=240,
        )
        for threads in (1, 2, 4)
    ]  # fmt: skip
    assert all(done.returncode == 0 for done in results), results[0].stderr
    assert len({done.stdout for done in results}) == 1 and float(results[0].stdout.split()[1]) < -0.05
