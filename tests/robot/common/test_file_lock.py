"""A lock on a file that is replaced."""

from __future__ import annotations

import multiprocessing
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest

from robot.common.file_lock import hold_lock
from robot.common.whole_file import write_whole


def hold_until(path: Path, held: Event, end: Event) -> None:
    with hold_lock(path):
        write_whole(path, b"theirs")
        held.set()
        end.wait()


def test_lock_excludes_other_processes_until_the_holder_ends(tmp_path: Path) -> None:
    spawn, path = multiprocessing.get_context("spawn"), tmp_path / "folder" / "score.json"
    held, end = spawn.Event(), spawn.Event()
    other = spawn.Process(target=hold_until, args=(path, held, end))
    other.start()
    assert held.wait(60)
    with pytest.raises(BlockingIOError), hold_lock(path):
        pass
    other.kill()
    other.join()
    with hold_lock(path):
        write_whole(path, b"mine")
    assert [each.name for each in path.parent.iterdir()] == [path.name]
