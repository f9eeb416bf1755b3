"""Taichi in one process: started once, used by one thread at a time, never by a forked child."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

WORLD = """
import os, sys, threading
import numpy as np
from tacsim.interface import Pose
from tacsim.physics.worlds.press import PressWorld
from tacsim.models.scene import Gel, Indenter, Scene, Sphere

def world():
    gel = Gel(size=(8e-3, 8e-3, 4e-3))
    return PressWorld(Scene(body=None, indenter=Indenter(geometry=Sphere(radius=3e-3)), gel=gel))

def press(world):
    world.move({"indenter": Pose(world.pose("indenter").position - [0.0, 0.0, 0.3e-3])})
    return float(world.wrench("lower")[2])

def in_threads(*calls):
    found, together = [], threading.Barrier(len(calls))
    def run(call):
        together.wait()
        try:
            found.append(call())
        except BaseException as error:
            found.append(repr(error))
    threads = [threading.Thread(target=run, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found
"""


def run(code: str) -> str:
    """What a fresh process prints, none of whose kernels is compiled yet."""
    command = [sys.executable, "-W", "ignore", "-c", WORLD + code]  # from 3.12 on Python warns of a fork beside threads
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


@pytest.mark.slow
def test_a_world_made_here_may_first_move_in_another_thread() -> None:
    """Where its kernels are compiled; and the thread in which Taichi was started may be gone by then."""
    code = """
made = world()
forces = in_threads(lambda: press(made)) + [press(world())]
print(len(set(forces)) == 1 and forces[0] < 0 or forces)
"""
    assert run(code) == "True"
    assert run(code.replace("made = world()", "made, = in_threads(world)")) == "True"


@pytest.mark.slow
def test_threads_that_make_and_move_their_first_worlds_at_once_take_turns() -> None:
    code = """
forces = in_threads(*[lambda: press(world())] * 3)
print(len(set(forces)) == 1 and forces[0] < 0 or forces)
"""
    assert run(code) == "True"


@pytest.mark.slow
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="processes are never forked here")
def test_a_world_is_not_moved_in_a_forked_child() -> None:
    """It says so, and the world is as it was: nothing waits for threads that are not there."""
    code = """
import signal
made = world()
press(made)
before = made.snapshot()
if os.fork() == 0:
    signal.alarm(30)
    for call in (lambda: press(made), world):
        try:
            call()
        except RuntimeError as error:
            print(error)
    print(all(np.array_equal(a, before[name]) for name, a in made.snapshot().items()), flush=True)
    os._exit(0)
print(os.wait()[1])
"""
    told = "Taichi runs in the parent process and does not survive a fork: start workers by 'spawn'"
    first, second, *rest = run(code).splitlines()
    assert first.startswith(told) and second.startswith(told) and rest == ["True", "0"]


def three(
    folder: Path, places: dict[str, str], more: str = "", *, before: str = ""
) -> subprocess.CompletedProcess[str]:
    """A process that compiles a kernel and prints the three it gives, then does `more`. places: what says in its
    environment where kernels are kept; before: what it does once Taichi is imported."""
    code = "from tacsim.compute.runtime import start_taichi, ti\n@ti.kernel\ndef three() -> ti.i32: return 3\n"
    (folder / "small.py").write_text(f"{code}{before}start_taichi()\nprint(three())\n{more}")
    elsewhere = ("HOME", "XDG_CACHE_HOME", "TI_OFFLINE_CACHE_FILE_PATH")
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere} | places
    environment |= {"PYTHONPATH": os.pathsep.join(sys.path), "TACSIM_DEVICE": "cpu"}
    command = [sys.executable, "-W", "ignore", str(folder / "small.py")]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("cache", [None, "file/cache"], ids=["no HOME", "not writable"])
def test_process_ends_normally_without_writable_cache(tmp_path: Path, cache: str | None) -> None:
    """Taichi ends the process without a home directory, and crashes at its end without a cache: a service's, say."""
    (tmp_path / "file").touch()
    told = "import warnings\nwarnings.simplefilter('default')\n"
    done = three(tmp_path, {} if cache is None else {"XDG_CACHE_HOME": str(tmp_path / cache)}, before=told)
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr
    assert ("compiled kernels cannot be kept" in done.stderr) == (cache is not None)


def test_compiled_kernels_are_cached_with_references_to_taichi_at_end(tmp_path: Path) -> None:
    referring = "import ctypes\nctypes.pythonapi.Py_IncRef(ctypes.py_object(ti.lang.impl.get_runtime().prog))\n"
    places = {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "cache")}
    done = three(tmp_path, places, referring + 'raise ValueError("an end by an error")')
    assert (done.returncode, done.stdout) == (1, "3\n"), done.stderr
    assert done.stderr.rstrip().endswith("an end by an error")
    assert list((tmp_path / "cache").glob("*.tic"))


@pytest.mark.parametrize(
    ("age", "left"),
    [(61.0, False), (-3600.0, False), (0.0, True)],
    ids=["of a killed process", "of a wrong clock", "held"],
)
def test_only_stale_lock_is_removed(tmp_path: Path, age: float, left: bool) -> None:
    """Taichi locks what it keeps for milliseconds, and neither reads nor keeps kernels while the lock is there."""
    lock = tmp_path / "cache" / "ticache.lock"
    lock.parent.mkdir()
    lock.touch()
    os.utime(lock, (time.time() - age, time.time() - age))
    done = three(tmp_path, {"TI_OFFLINE_CACHE_FILE_PATH": str(lock.parent)})
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr
    assert lock.exists() == left
    assert bool(list(lock.parent.glob("*.tic"))) != left


@pytest.mark.slow
@pytest.mark.parametrize("size", [None, 0, 700], ids=["lost", "empty", "cut"])
def test_damaged_cached_kernel_is_compiled_again(tmp_path: Path, size: int | None) -> None:
    """By itself Taichi compiles it in every process and never writes what its list says is there."""
    places = {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "cache")}
    three(tmp_path, places)
    (kept,) = (tmp_path / "cache").glob("*.tic")
    whole = kept.read_bytes()
    if size is None:
        kept.unlink()
    else:
        kept.write_bytes(whole[:size])
    done = three(tmp_path, places)
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr
    assert kept.stat().st_size == len(whole)
    kept.touch()
    os.utime(kept, (0, 0))
    three(tmp_path, places)
    assert kept.stat().st_mtime == 0  # nothing was wrong: it was read


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not hold a process to the limit")
def test_small_address_space_raises_error_with_advice(tmp_path: Path) -> None:
    """Half a gigabyte more than it has taken so far, which grows with the cores."""
    limit = """
import resource
most = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + 2**29
resource.setrlimit(resource.RLIMIT_AS, (most, most))
"""
    done = three(tmp_path, {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "cache")}, before=limit)
    assert done.stderr.rstrip().splitlines()[-1].startswith("RuntimeError: Taichi cannot reserve the gigabyte"), (
        done.stderr
    )
