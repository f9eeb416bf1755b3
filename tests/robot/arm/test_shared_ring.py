"""Shared memory between two true processes: whole records, nothing left behind."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.arm import shared_ring

RECORD = np.dtype([("a", np.float64, 40), ("b", np.uint64)])
ROOT = str(Path(shared_ring.__file__).parents[2])


@pytest.fixture
def segment() -> Iterator[shared_ring.Segment]:
    made = shared_ring.create(shared_ring.segment_name(os.getpid(), "test"), shared_ring.Ring.size(RECORD, 8))
    yield made
    made.close()


def record(value: float) -> shared_ring.Record:
    made = np.zeros((), RECORD)
    made["a"], made["b"] = value, int(value)
    return made


def child(code: str, *arguments: str) -> subprocess.Popen[str]:
    text = "import sys, time, os, numpy as np\nfrom robot.arm import shared_ring\n" + textwrap.dedent(code)
    return subprocess.Popen(
        [sys.executable, "-c", text, *arguments],
        env={**os.environ, "PYTHONPATH": ROOT},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_records_in_order_and_the_past_that_fits(segment: shared_ring.Segment) -> None:
    ring = shared_ring.Ring(segment.memory, RECORD, 8)
    assert ring.latest() is None
    assert len(ring.recent(100)) == 0
    for value in range(1, 21):
        ring.write(record(value))
        newest = ring.latest()
        assert newest is not None and newest["b"] == value
    assert ring.recent(100)["b"].tolist() == [14, 15, 16, 17, 18, 19, 20]  # the slot in danger is left out
    assert ring.recent(3)["b"].tolist() == [18, 19, 20]
    del ring
    segment.close()


@pytest.mark.promise(10)
def test_no_torn_read_in_a_hundred_thousand(segment: shared_ring.Segment) -> None:
    """Another process writes as fast as it can; every copy here is of one record."""
    writer = child(
        """
        record = np.dtype([("a", np.float64, 40), ("b", np.uint64)])
        ring = shared_ring.Ring(shared_ring.attach(sys.argv[1]).memory, record, 8)
        value, made = 0, np.zeros((), record)
        print("writing", flush=True)
        while os.getppid() == int(sys.argv[2]):
            value += 1
            made["a"], made["b"] = value, value
            ring.write(made)
        """,
        segment.name,
        str(os.getpid()),
    )
    try:
        assert writer.stdout is not None and writer.stdout.readline() == "writing\n"
        ring = shared_ring.Ring(segment.memory, RECORD, 8)
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
        ring = None  # type: ignore[assignment]
        segment.close()


def test_who_only_attached_leaves_the_segment_alone(segment: shared_ring.Segment) -> None:
    code = "segment = shared_ring.attach(sys.argv[1])\nprint(len(segment.memory), flush=True)\n"
    assert child(code, segment.name).communicate(timeout=60)[0].strip() == str(len(segment.memory))
    killed = child(code + "time.sleep(60)\n", segment.name)
    assert killed.stdout is not None and killed.stdout.readline()
    killed.kill()
    killed.communicate()
    shared_ring.attach(segment.name).close()  # still there
    segment.close()
    with pytest.raises(FileNotFoundError):
        shared_ring.attach(segment.name)
    segment.close()  # twice does no harm


def test_what_a_killed_process_left_is_swept_and_nothing_else(segment: shared_ring.Segment) -> None:
    code = "segment = shared_ring.create(shared_ring.segment_name(os.getpid(), 'gone'), 100)\n"
    code += "print(segment.name, flush=True)\n"
    killed = child(code + "time.sleep(60)\n")
    assert killed.stdout is not None
    name = killed.stdout.readline().strip()
    assert name not in shared_ring.sweep()
    killed.kill()
    killed.communicate()
    assert name in shared_ring.sweep()
    with pytest.raises(FileNotFoundError):
        shared_ring.attach(name)
    shared_ring.attach(segment.name).close()
    segment.close()


def test_a_name_is_given_once(segment: shared_ring.Segment) -> None:
    with pytest.raises(FileExistsError):
        shared_ring.create(segment.name, 64)
    segment.close()
