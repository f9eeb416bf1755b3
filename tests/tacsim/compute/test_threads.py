"""Several calls at once: their results, their failures, and how many threads there are."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
import time
from functools import partial

import pytest

from tacsim.compute import threads
from tacsim.compute.threads import map_parallel, map_serial


@pytest.fixture(params=["1", "2", "4"])
def allowed(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Number of threads that may be used."""
    monkeypatch.setattr(threads, "core_count", lambda: 4)
    monkeypatch.setenv("TACSIM_THREADS", request.param)
    monkeypatch.setattr(threads, "_thread_pool", threads._thread_pool.__wrapped__)
    return int(request.param)


def test_results_stand_in_the_order_of_the_calls(allowed: int) -> None:
    def slow_first(index: int) -> int:
        time.sleep(0.01 * (5 - index))
        return index

    calls = [partial(slow_first, index) for index in range(5)]
    assert map_parallel(calls) == map_serial(calls) == list(range(5))
    assert map_parallel([]) == []


def test_as_many_run_at_once_as_may_to_the_last_of_many(allowed: int) -> None:
    """Also the calling thread goes on to a next one."""
    together = threading.Barrier(allowed, timeout=2.0)
    map_parallel([together.wait] * (3 * allowed))  # a barrier is passed by so many or by none


def test_an_interruption_ends_what_has_not_begun(allowed: int) -> None:
    done = []

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        map_parallel([interrupt, *[partial(lambda: done.append(time.sleep(0.02)))] * 40])
    assert len(done) < 20


def test_the_first_failure_is_raised_when_all_are_done(allowed: int) -> None:
    done = []

    def fails(words: str) -> None:
        raise ValueError(words)

    with pytest.raises(ValueError, match="second"):
        map_parallel([lambda: done.append(0), partial(fails, "second"), partial(fails, "third")])
    if allowed > 1:

        def slow() -> None:
            time.sleep(0.05)
            done.append(1)

        with pytest.raises(ValueError, match="first"):
            map_parallel([partial(fails, "first"), slow])
        assert done[-1] == 1  # nothing runs on behind the caller's back


@pytest.mark.parametrize("wanted", ["0", "two", "-1", ""])
def test_a_wrong_number_of_threads_is_refused(wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACSIM_THREADS", wanted)
    with pytest.raises(ValueError, match="TACSIM_THREADS must be a whole number"):
        threads.thread_count()


FORKED = """
import multiprocessing
from functools import partial
from tacsim.compute import threads
threads.core_count = lambda: 2
def work():
    assert threads.map_parallel([partial(abs, -1), partial(abs, -2)]) == [1, 2]
work()
child = multiprocessing.get_context("fork").Process(target=work)
child.start()
child.join(20.0)
child.kill()
raise SystemExit(child.exitcode != 0)
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="processes are never forked here")
def test_a_forked_process_has_threads_of_its_own() -> None:
    # from 3.12 on Python warns of every fork beside threads
    environment = {key: value for key, value in os.environ.items() if key != "TACSIM_THREADS"}
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], env=environment, timeout=60.0, check=True)
