"""A lost link: distinguished from other exits of a worker, and explained by the timing that the worker measured."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from robot.arm.channel import STATE, STATISTICS_PERIODS, Record
from robot.arm.status import TIME_LIMIT_EXIT_STATUS, ArmStatus, describe_lost_link, ended_by_lost_link, status_of
from robot.arm.ur import URArm
from robot.mock import MockUR
from tests.robot.arm.mocked import config, go, in_motion, moved
from tests.robot.waiting import until

SAID = "RTDEControlInterface: Lost connection to robot...\nwrite: Connection reset by peer\n"
REAL = config().model_copy(update={"mock": None, "link_timeout": 0.05})


def record(age: float, now: float, **fields: float) -> Record:
    """Of a worker that runs since long; its newest package is `age` [s] old at `now`."""
    made = np.zeros((), STATE)
    made["time"], made["written"], made["cycles"], made["status"] = now - age, now, 10_000, ArmStatus.OK
    for name, value in {"longest": 2.1e-3, **fields}.items():
        made[name] = value
    return made


@pytest.mark.parametrize("end", [0, 3, -signal.SIGSEGV, -signal.SIGABRT, -signal.SIGKILL, TIME_LIMIT_EXIT_STATUS])
@pytest.mark.parametrize("published", [ArmStatus.OK, ArmStatus.LINK_LOST])
@pytest.mark.parametrize("printed", ["", "Traceback of something else\n", SAID])
def test_status_history_second_cause_keeps_first(end: int, published: ArmStatus, printed: str) -> None:
    """For any exit of the worker the link was lost first if the worker published it or the library reported it."""
    newest = record(0.01, time.monotonic(), status=published)
    first = published == ArmStatus.LINK_LOST or printed == SAID or end == TIME_LIMIT_EXIT_STATUS
    expected = ArmStatus.LINK_LOST if first else ArmStatus.WORKER_DEAD
    assert status_of(newest, end, 1.0, is_link_lost=ended_by_lost_link(end, printed)) == expected


def test_describe_lost_link_punctual_worker_names_cable() -> None:
    words = describe_lost_link(record(0.062, 100.0), REAL, None, 100.0)
    assert words.startswith("its last package is 62 ms old (link_timeout = 50 ms); its worker was punctual (0 of")
    assert words.endswith("check the cable")
    assert "cable" not in describe_lost_link(record(1.5, 100.0), config(), None, 100.0)  # a mock has none


@pytest.mark.parametrize(
    ("fields", "overdue", "words"),
    [
        ({"late": 37, "longest": 0.081}, 0.0, "37 of its last 500 periods of 2 ms were late, the longest 81 ms"),
        ({"late": 1, "longest": 0.040}, 0.0, "1 of its last 500 periods of 2 ms were late, the longest 40 ms"),
        ({"late": 100}, 0.0, "100 of its last 500"),
        ({}, 0.060, "the longest 60 ms"),
        ({"late": 3, "longest": 0.004, "cycles": 20}, 0.0, "3 of its last 20 periods"),
    ],
)
def test_describe_lost_link_late_worker_names_periods(fields: dict[str, float], overdue: float, words: str) -> None:
    now = 100.0
    newest = record(0.062, now, **fields)
    newest["written"] -= overdue
    told = describe_lost_link(newest, REAL, None, now)
    assert words in told and "its worker itself was late" in told and "cable" not in told
    assert "real-time priority was not given); allow it (`tacsim doctor` says how)" in told
    newest["realtime"] = 1
    assert "with real-time priority); reduce the load of this machine" in describe_lost_link(newest, REAL, None, now)
    assert "`mock: {realtime: true}`" in describe_lost_link(
        record(0.062, now, late=STATISTICS_PERIODS), config(), None, now
    )


def test_describe_lost_link_cut_or_blocked_names_cause() -> None:
    newest = record(0.003, 100.0)
    assert "3 ms old (link_timeout = 50 ms), the connection was closed or reset;" in describe_lost_link(
        newest, REAL, 0, 250.0
    )
    assert "a command took longer than link_timeout" in describe_lost_link(newest, REAL, TIME_LIMIT_EXIT_STATUS, 250.0)


@pytest.mark.slow
@pytest.mark.parametrize(("printed", "expected"), [(SAID, ArmStatus.LINK_LOST), ("", ArmStatus.WORKER_DEAD)])
def test_status_of_library_crash_with_report_is_lost_link(mock: MockUR, printed: str, expected: ArmStatus) -> None:
    with URArm(config(), "left") as arm:
        worker = arm.worker
        assert worker is not None
        worker._errors.write(printed.encode())
        worker._errors.flush()
        os.kill(worker.pid, signal.SIGSEGV)
        until(lambda: not worker.running, "end of the worker")
        assert arm.status() == expected, arm.explain()
        arm.recover()
        go(arm, moved(arm.state().pose, x=0.005))


def test_status_history_exit_after_lost_link_keeps_cause(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        worker = arm.worker
        assert worker is not None
        os.kill(worker.pid, signal.SIGSTOP)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        assert "its worker itself was late" in arm.explain() and "cable" not in arm.explain()
        os.kill(worker.pid, signal.SIGKILL)
        until(lambda: not worker.running, "end of the worker")
        assert arm.status() == arm.status() == ArmStatus.LINK_LOST


def test_worker_late_periods_are_counted(mock: MockUR) -> None:
    with URArm(config(), "left") as arm:
        worker = arm.worker
        assert worker is not None
        os.kill(worker.pid, signal.SIGSTOP)
        time.sleep(0.15)
        os.kill(worker.pid, signal.SIGCONT)

        def newest() -> Record:
            found = arm._channel.states.latest()
            assert found is not None
            return found

        until(lambda: newest()["longest"] > 0.14 and newest()["late"] >= 1, "the late period")
        assert newest()["realtime"] == 0


@pytest.mark.deep
@pytest.mark.parametrize("ports", [None, [30004]])
def test_arm_connection_reset_is_lost_link(mock: MockUR, ports: list[int] | None) -> None:
    """In one of 30 resets ur_rtde crashes."""
    for _ in range(30):
        mock.faults.reset()
        with URArm(config(link_timeout=0.5), "left") as arm:
            in_motion(arm, moved(arm.state().pose, x=0.1))
            mock.faults.cut(ports, reset=True)
            until(lambda arm=arm: arm.status().is_fault, "fault")  # type: ignore[misc]
            worker = arm.worker
            assert worker is not None
            until(lambda worker=worker: not worker.running, "end of the worker")  # type: ignore[misc]
            assert arm.status() == ArmStatus.LINK_LOST, arm.explain()
