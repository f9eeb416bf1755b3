"""A user's program, in a process of its own: `python policy.py CONFIG X`: one arm goes X metres along x.

It commands the target every 10 ms and says on standard output, as lines of JSON, when it is connected and each new
status of the arm with its time on the monotonic clock. After a fault it only looks.
"""

from __future__ import annotations

import json
import sys
import time

from robot.arm.ur import URArm
from robot.errors import LinkLost
from tacsim.interface import Pose
from tacsim.models.hardware import UrArmConfig


def say(**words: object) -> None:
    print(json.dumps({"time": time.monotonic(), **words}), flush=True)


def connect(config: UrArmConfig, tries: int = 5) -> URArm:
    """A machine that stands still for longer than link_timeout looks like a lost link. Opening is tested elsewhere."""
    for left in reversed(range(tries)):
        try:
            return URArm(config, "observed")
        except LinkLost:
            if not left:
                raise
    raise AssertionError("unreachable")


def main(config: str, x: str) -> None:
    with connect(UrArmConfig.model_validate_json(config)) as arm:
        start = arm.state().pose
        target = Pose(start.position + [float(x), 0.0, 0.0], start.quaternion)
        assert arm.worker is not None
        last, commanded = arm.status(), 0.0
        say(worker=arm.worker.pid, status=last.name)
        while True:
            status = arm.status()
            if status != last:
                last = status
                say(status=status.name, words=arm.explain())
            if not status.is_fault and time.monotonic() - commanded > 0.01:
                commanded = time.monotonic()
                try:
                    arm.command(target)
                except Exception as failure:  # its status says why, too
                    say(status=arm.status().name, words=str(failure))
            time.sleep(1e-3)


if __name__ == "__main__":
    main(*sys.argv[1:])
