"""Pieces of work in several processes: none goes on when the process that wants it is gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import pytest

from robot.common.process_pool import ProcessPool

LONG = 600.0  # a piece of work that nobody waits for [s]
LEFT_ALONE = f"""
import os, time
from robot.common.process_pool import ProcessPool
if __name__ == "__main__":
    with ProcessPool(2) as pool:
        print(*{{pool.submit(os.getpid).result() for _ in range(4)}}, flush=True)
        pool.submit(time.sleep, {LONG}), pool.submit(time.sleep, {LONG})
        time.sleep({LONG})
"""

needs_proc = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for the processes in /proc")


def running(pid: int) -> bool:
    """Whether a process is there, and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@needs_proc
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_pool_processes_end_with_their_parent(number: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "alone.py"
    script.write_text(LEFT_ALONE)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        workers = [int(pid) for pid in process.stdout.readline().split()]
        assert workers and all(running(pid) for pid in workers)
        process.send_signal(number)
    end = time.monotonic() + LONG / 10
    while any(running(pid) for pid in workers) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(running(pid) for pid in workers)


@needs_proc
def test_pool_processes_end_at_once_after_error() -> None:
    begun: list[tuple[int, Future[None]]] = []

    def leave() -> None:
        with ProcessPool(1) as pool:
            begun.append((pool.submit(os.getpid).result(), pool.submit(time.sleep, LONG)))
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        leave()
    ((worker, unwanted),) = begun
    assert not running(worker) and unwanted.exception() is not None


@needs_proc
def test_pool_processes_get_no_end_signals() -> None:
    with ProcessPool(1) as pool:
        worker = pool.submit(os.getpid).result()
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(worker, number)
        assert pool.submit(os.getpid).result() == worker


def test_pool_does_not_execute_module_of_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "random.py").write_text("raise SystemExit('not to be run')")
    monkeypatch.chdir(tmp_path)
    with ProcessPool(1) as pool:
        assert pool.submit(os.getpid).result() != os.getpid()
