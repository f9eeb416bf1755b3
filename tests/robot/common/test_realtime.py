"""Time-critical processes are run first where the system allows it, and as any other where it does not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from robot import common

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="this system has no such thing")

ASK = (
    "import os\nfrom robot.common import request_realtime, WORKER_PRIORITY\n"
    "granted = request_realtime(WORKER_PRIORITY)\n"
    "print(granted, os.sched_getscheduler(0) == os.SCHED_RR, os.sched_getparam(0).sched_priority)"
)


def test_realtime_allowed_equals_granted() -> None:
    answer = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, timeout=60, check=True).stdout
    allowed = common.is_realtime_allowed()
    assert answer.split() == [str(allowed), str(allowed), str(common.WORKER_PRIORITY if allowed else 0)]


def test_realtime_check_keeps_priority() -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    common.is_realtime_allowed()
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before


def test_realtime_refusal_returns_false(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not common.request_realtime(common.WORKER_PRIORITY)
    monkeypatch.delattr(os, "sched_setscheduler")
    assert not common.request_realtime(common.WORKER_PRIORITY)
    assert not common.is_realtime_allowed()
