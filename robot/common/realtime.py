"""Real-time priority for time-critical processes: workers of real arms, and mocks where timing is measured."""

from __future__ import annotations

import os

WORKER, CONTROLLER = 10, 11  # priorities: a mock controller, which stands in for hardware, comes before its worker


def ask_for_realtime(priority: int) -> bool:
    """Makes this process a real-time one (SCHED_RR), so that no ordinary process can keep it waiting; the threads that
    it starts later are too. False where the system has no such thing, or does not allow it: then it runs as any other.

    On Linux it is allowed for root, with CAP_SYS_NICE, or by `rtprio` in /etc/security/limits.conf.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except (OSError, ValueError):
        return False
    return True


def allowed() -> bool:
    """True if a process may become a real-time one here; this process is left as it is."""
    if not hasattr(os, "sched_setscheduler"):
        return False
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    granted = ask_for_realtime(WORKER)
    if granted:
        os.sched_setscheduler(0, policy, parameters)
    return granted
