"""Every package that an arm's controller sends, drained from the records that its worker shares."""

from __future__ import annotations

import numpy as np

from robot.arm.shared_ring import Ring
from robot.arm.trajectory import PERIOD
from tacsim.record.episode import ArmPackages


class PackageLog:
    """The packages since the last look, each once, and all of them if somebody looks every two seconds. What is
    missing, here or on the way from the controller, shows in the controller's time stamps and is counted.

    states: the worker's records, one a package, and another of the same one when a fault is found in it.
    """

    def __init__(self, states: Ring) -> None:
        self._states = states
        self._read = states.count
        self._time = -np.inf  # of the last package, when it was read [s]
        self._stamp = np.nan  # on the controller's clock [s]

    def take(self) -> ArmPackages:
        """The packages since the last call, or since this log was made."""
        self._read, records = self._states.since(self._read)
        records = records[records["stamp"] != 0.0]  # before its first package a worker has none to tell
        records = records[np.diff(records["time"], prepend=self._time) > 0.0]
        lost = 0
        if len(records):
            gaps = np.diff(records["stamp"], prepend=self._stamp)[0 if np.isfinite(self._stamp) else 1 :]
            lost = int(np.maximum(np.round(gaps / PERIOD) - 1.0, 0.0).sum())  # a controller that restarts counts anew
            self._time, self._stamp = float(records["time"][-1]), float(records["stamp"][-1])
        return ArmPackages.of(records, lost)
