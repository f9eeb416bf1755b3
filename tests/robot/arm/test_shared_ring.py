"""Shared memory between two true processes: whole records, nothing left behind."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from robot.arm import channel

RECORD = np.dtype([("a", np.float64, 40), ("b", np.uint64)])
ROOT = str(Path(channel.__file__).parents[2])


@pytest.fixture
def segment() -> channel.Segment:
    return channel.create_segment(channel.Ring.size(RECORD, 8))


def record(value: float) -> channel.Record:
    made = np.zeros((), RECORD)
    made["a"], made["b"] = value, int(value)
    return made


def child(code: str, segment: channel.Segment, *arguments: str) -> subprocess.Popen[str]:
    text = "import sys, time, os, numpy as np\nfrom robot.arm import channel\n" + textwrap.dedent(code)
    return subprocess.Popen(
        [sys.executable, "-c", text, str(segment.descriptor), *arguments],
        pass_fds=[segment.descriptor],
        env={**os.environ, "PYTHONPATH": ROOT},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_ring_records_keep_order_and_last_slots(segment: channel.Segment) -> None:
    ring = channel.Ring(segment.memory, RECORD, 8)
    assert ring.latest() is None
    assert len(ring.recent(100)) == 0
    for value in range(1, 21):
        ring.write(record(value))
        newest = ring.latest()
        assert newest is not None and newest["b"] == value
    assert ring.recent(100)["b"].tolist() == [14, 15, 16, 17, 18, 19, 20]  # the slot in danger is left out
    assert ring.recent(3)["b"].tolist() == [18, 19, 20]
    assert ring.since(17)[0] == 20 and ring.since(17)[1]["b"].tolist() == [18, 19, 20]
    assert ring.since(2)[1]["b"].tolist() == [14, 15, 16, 17, 18, 19, 20]
    assert len(ring.since(20)[1]) == 0


@pytest.mark.slow
@pytest.mark.promise(10)
def test_ring_100000_reads_have_no_torn_record(segment: channel.Segment) -> None:
    """Another process writes as fast as it can; every copy here is of one record."""
    writer = child(
        """
        record = np.dtype([("a", np.float64, 40), ("b", np.uint64)])
        ring = channel.Ring(channel.Segment(int(sys.argv[1])).memory, record, 8)
        value, made = 0, np.zeros((), record)
        print("writing", flush=True)
        while os.getppid() == int(sys.argv[2]):
            value += 1
            made["a"], made["b"] = value, value
            ring.write(made)
        """,
        segment,
        str(os.getpid()),
    )
    try:
        assert writer.stdout is not None and writer.stdout.readline() == "writing\n"
        ring = channel.Ring(segment.memory, RECORD, 8)
        while ring.latest() is None:
            time.sleep(1e-3)
        torn, backwards, seen, last = 0, 0, set(), 0
        reads = 0
        while reads < 100_000 or len(seen) < 200:  # both processes had their turns
            reads += 1
            number, copy = ring.newest()
            assert copy is not None
            assert number == copy["b"]  # the number is that of this record, not of a later one
            value = int(copy["b"])
            torn += not (copy["a"] == value).all()
            backwards += value < last
            last = value
            seen.add(value)
            if value % 64 == 0:
                past = ring.recent(8)
                torn += not (past["a"] == past["b"][:, None]).all()
        assert (torn, backwards) == (0, 0)
    finally:
        writer.kill()
        writer.communicate()


def descriptors() -> list[str]:
    """What this process has open."""
    gc.collect()
    return sorted(str(path.readlink()) for path in Path("/proc/self/fd").iterdir() if path.exists())


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="looks at open files as Linux shows them")
def test_segment_is_freed_with_last_process() -> None:
    """There is no file: nothing to find for others, nothing to be squatted, nothing that a kill could leave."""
    before = descriptors()
    segment = channel.create_segment(channel.Ring.size(RECORD, 8))
    ring = channel.Ring(segment.memory, RECORD, 8)
    ring.write(record(7.0))
    assert all(path.endswith("(deleted)") for path in set(descriptors()) - set(before))
    code = """
    held = channel.Segment(int(sys.argv[1]))
    ring = channel.Ring(held.memory, np.dtype([("a", np.float64, 40), ("b", np.uint64)]), 8)
    print(int(ring.latest()["b"]), flush=True)
    time.sleep(60)
    """
    killed = child(code, segment)
    assert killed.stdout is not None and killed.stdout.readline() == "7\n"
    killed.kill()
    killed.communicate()
    assert ring.latest() is not None
    del segment, ring
    assert descriptors() == before


def test_segment_without_standard_streams_reaches_child() -> None:
    """Else it would get one of their numbers, and the child a pipe by that number."""
    code = """
    import os
    os.closerange(0, 3)
    from robot.arm import channel
    os._exit(channel.create_segment(64).descriptor)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], env={**os.environ, "PYTHONPATH": ROOT})
    assert done.returncode >= 3
