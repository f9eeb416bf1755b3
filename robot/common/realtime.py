"""Real-time priority for time-critical processes: workers of real arms, and mocks where timing is measured."""

from __future__ import annotations

import os

WORKER, CONTROLLER = 10, 11  # priorities: a mock controller, which stands in for hardware, comes before its worker


def request_realtime(priority: int) -> bool:
    """Gives this process, and threads that it starts later, real-time priority (SCHED_RR): no ordinary process delays
    it. Returns False, without any change, where the system has no such priority or does not allow it.

    Linux allows it for root, with CAP_SYS_NICE, or by `rtprio` in /etc/security/limits.conf.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except (OSError, ValueError):
        return False
    return True


def is_realtime_allowed() -> bool:
    """True if a process may have real-time priority here; the priority of this process does not change."""
    if not hasattr(os, "sched_setscheduler"):
        return False
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    granted = request_realtime(WORKER)
    if granted:
        os.sched_setscheduler(0, policy, parameters)
    return granted
