"""Test your code against mock devices that speak the real protocols: a UR controller and a camera.

    python examples/mock_devices.py

Both are processes on loopback and fail on request. The controller answers on its dashboard port, as a robot does.
"""

from __future__ import annotations

import os
import socket
import sys
import time

import numpy as np

from robot import Camera, StaleFrame
from robot.mock import MockCamera, MockUR
from tacsim import CameraSensorConfig

DASHBOARD = 29999
HOST = f"127.43.{os.getpid() % 250 + 1}.2"  # an address of this process's own


def ask_dashboard(host: str, question: str) -> str:
    with socket.create_connection((host, DASHBOARD), timeout=5.0) as connection, connection.makefile("rw") as lines:
        lines.readline()  # the greeting
        print(question, file=lines, flush=True)
        return lines.readline().strip()


def main() -> None:
    with MockUR(HOST) as arm, MockCamera(HOST) as mock_camera:
        before = ask_dashboard(arm.host, "safetystatus")
        arm.faults.protective_stop()
        after = ask_dashboard(arm.host, "safetystatus")
        print(f"arm: '{before}', then '{after}'")

        number = mock_camera.push(np.full((240, 320, 3), 90, np.uint8))
        size = {"width": 320, "height": 240}
        config = CameraSensorConfig(driver="camera", source=mock_camera.url, stamped=True, max_age=0.5, **size)
        with Camera(config, "finger") as camera:
            brightness = camera.wait_for(number, timeout=5.0).image.mean()
            mock_camera.stall(True)
            time.sleep(2 * config.max_age)
            error = ""
            try:
                camera.read(timeout=0.1)
            except StaleFrame as stale:
                error = str(stale)
        print(f"camera: brightness {brightness:.0f}, then '{error}'")

    if "NORMAL" not in before or "PROTECTIVE_STOP" not in after:
        sys.exit("the dashboard does not report the protective stop")
    if abs(brightness - 90) > 3 or "limit 500 ms" not in error:
        sys.exit("the camera did not deliver the picture, or delivers it still though it has stalled")


if __name__ == "__main__":
    main()
