"""Environments in processes of their own: by each way of starting them, and round a batch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tacsim.gym.small import AS_WRITTEN, SMALL, VARIANTS

ROOT = Path(__file__).parents[3]
HEAD = f"""
import multiprocessing, sys
import gymnasium, numpy as np
OPTIONS = dict(overrides={list(SMALL)!r}, variants={[list(each) for each in VARIANTS]!r}, **{AS_WRITTEN!r})
NAME = "tacsim.gym:tacsim/Squeeze-v0"  # nothing else imports tacsim in a process that is spawned
"""
ASYNC = """
def steps(env):
    flats, infos = env.reset(seed=3)
    for _ in range(4):
        flats, rewards, *_ = env.step(np.tile(np.array([0.4, -0.4], np.float32), (2, 1)))
    return rewards, flats["wrench_upper"]

def main():
    context = sys.argv[1] if len(sys.argv) > 1 else None
    env = gymnasium.make_vec(NAME, 2, vectorization_mode="async", vector_kwargs={"context": context}, **OPTIONS)
    found = steps(env)
    env.close()
    wanted = steps(gymnasium.make_vec(NAME, 2, **OPTIONS))  # after the processes: from here on nothing may fork
    assert np.array_equal(found[0], wanted[0]) and found[1].tobytes() == wanted[1].tobytes()
    print("equal")

if __name__ == "__main__":
    main()
"""
LATE = """
gymnasium.make(NAME, **OPTIONS).reset(seed=0)  # Taichi runs in this process now
env = gymnasium.make_vec(NAME, 2, vectorization_mode="async", vector_kwargs={"context": "fork"}, **OPTIONS)
try:
    env.reset(seed=0)
except RuntimeError as error:
    print("refused:", error)
env.close(terminate=True)
"""
POOL = """
def rewards_of(seed):
    env = gymnasium.make_vec(NAME, 2, **OPTIONS)
    env.reset(seed=seed)
    return env.step(np.zeros((2, 2), np.float32))[1].tolist()

def main():
    with multiprocessing.get_context(sys.argv[1]).Pool(2) as pool:
        found = pool.map(rewards_of, [1, 2])
    assert found == [rewards_of(1), rewards_of(2)]
    print("equal")

if __name__ == "__main__":
    main()
"""


def run(tmp_path: Path, body: str, *arguments: str) -> str:
    program = tmp_path / "program.py"  # what is spawned imports it by its name
    program.write_text(HEAD + body)
    command = [sys.executable, "-W", "ignore::DeprecationWarning", str(program), *arguments]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}", "TACSIM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.deep
@pytest.mark.parametrize("context", [(), ("spawn",), ("forkserver",)])
def test_gymnasiums_processes_give_the_same_bits(tmp_path: Path, context: tuple[str, ...]) -> None:
    """(): as `vectorization_mode="async"` is by default, which forks on Linux."""
    assert "equal" in run(tmp_path, ASYNC, *context)


@pytest.mark.deep
@pytest.mark.skipif(sys.platform != "linux", reason="fork is for Linux")
def test_a_fork_after_the_simulation_has_begun_says_what_to_do(tmp_path: Path) -> None:
    said = run(tmp_path, LATE)
    assert "refused:" in said and "spawn" in said and "vector_kwargs" in said


@pytest.mark.deep
def test_a_batch_lives_in_a_process(tmp_path: Path) -> None:
    assert "equal" in run(tmp_path, POOL, "spawn")
