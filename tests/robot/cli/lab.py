"""A lab made of mocks that pass for real hardware: a copy of a shipped rig file in which only hosts and cameras are
changed, controllers with a robot's serial number behind it, cameras without stamps, and before each gel a flat body."""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from robot.common.kinematics import Kinematics, matrix
from robot.common.tcp import ArmFrames, pose_of
from robot.fixtures import mock_host
from robot.mock import FaultClient, MockArms, MockCamera
from tacsim import pose as se3
from tacsim.config import config_root, load_rig
from tacsim.interface import Pose
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig

SERIAL = "20195501234"  # of no mock
TINT = 200.0  # change of the picture by depth, as a share of its brightness [1/m]: 0.05 mm give the signal of a touch
GREY, NOISE = 110.0, 2.0  # of the pictures [grey levels]
POSTURE = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])


def copy_of(rig: str, folder: Path, first: int) -> Path:
    """The shipped file `rig` with the hosts and cameras of mocks, number `first` on, said to be a maker's simulator,
    and time-outs that no busy machine breaks."""
    text = (config_root() / "rigs" / f"{rig}.yaml").read_text(encoding="utf-8")
    number = iter(range(first, first + 9))
    text = re.sub(r"host: [\d.]+", lambda found: f"host: {mock_host(next(number))}", text)
    text = text.replace("simulator: false", "simulator: true")
    text = text.replace("link_timeout: 50 ms", "link_timeout: 2 s").replace("max_age: 200 ms", "max_age: 5 s")
    text = text.replace("watchdog: 10", "watchdog: 0.5")
    number = iter(range(first, first + 9))
    text = re.sub(
        r"source: /dev/v4l/.*", lambda found: f"source: http://{mock_host(next(number))}:8081/?action=stream", text
    )
    file = folder / "my.yaml"
    file.write_text(text, encoding="utf-8")
    return file


class Lab:
    """While open, the hardware that the rig file `file` names. Each body lies `ahead` [m] before its gel's start.

    offset: initial positions of the sensors relative to their starts, in their own axes (3,) [m].
    """

    def __init__(
        self, file: Path, ahead: float = 4e-3, offset: tuple[float, float, float] = (2e-3, -1e-3, -3e-3)
    ) -> None:
        self.config = load_rig(file).config
        arms = {name: arm for name, arm in self.config.arms.items() if isinstance(arm, UrArmConfig)}
        cameras = {name: each for name, each in self.config.sensors.items() if isinstance(each, CameraSensorConfig)}
        self._frames = {name: ArmFrames.of(arm) for name, arm in arms.items()}
        self._ahead, self._over = ahead, threading.Event()
        self.starts: Mapping[str, Pose] = {name: arm.start.pose for name, arm in arms.items() if arm.start is not None}
        with ExitStack() as stack:
            controllers = MockArms(
                [arm.host for arm in arms.values()],
                joints=[self._joints(name, se3.compose(self.starts[name], Pose(np.array(offset)))) for name in arms],
                payload=[(arm.payload.mass, *arm.payload.centre) for arm in arms.values()],
                serial=SERIAL,
                realtime=True,  # as a controller: it shares no priority with what a busy machine does
            )
            stack.enter_context(controllers)
            self.faults = dict(zip(arms, controllers.fault_clients, strict=True))
            self.cameras: dict[str, MockCamera] = {}
            for name, camera in cameras.items():
                host = camera.source.split("/")[2].partition(":")[0]
                mock = MockCamera(host, 8081, camera.width, camera.height, camera.fps, stamped=False)
                self.cameras[name] = stack.enter_context(mock)
                assert camera.arm is not None
                thread = threading.Thread(target=self._draw, args=(name, camera.arm, camera.fps))
                thread.start()
                stack.callback(thread.join)
            stack.callback(self._over.set)
            self._stack = stack.pop_all()

    def _joints(self, arm: str, sensor: Pose) -> list[float]:
        kinematics = Kinematics("ur5e")
        postures = kinematics.solutions(self._frames[arm].flange(se3.to_matrix(sensor)), POSTURE)
        assert postures, f"the start of arm '{arm}' is out of reach"
        found: list[float] = max(postures, key=lambda q: round(kinematics.singularity(q), 6)).tolist()
        return found

    def depth(self, arm: str, base_from_tool: tuple[float, ...] | NDArray[np.float64]) -> float:
        """How deep the gel is pressed when the tool of its arm is there [m]; negative before the touch."""
        frames = self._frames[arm]
        sensor = pose_of(frames.world_from_base @ matrix(np.array(base_from_tool)) @ frames.tool_from_sensor)
        start = self.starts[arm]
        return float(se3.rotation(start).as_matrix()[:, 2] @ (sensor.position - start.position)) - self._ahead

    def _draw(self, name: str, arm: str, fps: float) -> None:
        camera, faults = self.cameras[name], FaultClient(self.config.arms[arm].host)  # type: ignore[union-attr]
        random = np.random.default_rng(0)
        shape = (camera.height, camera.width, 3)
        plain = [GREY + random.normal(0.0, NOISE, shape).astype(np.float32) for _ in range(8)]
        tint = GREY * TINT * np.sign(np.linspace(-1.0, 1.0, camera.width, dtype=np.float32))[:, None] * np.ones(3)
        number = 0
        while not self._over.wait(1.0 / fps):
            number += 1
            depth = max(0.0, self.depth(arm, faults.state().pose))
            camera.push((plain[number % 8] + np.float32(depth) * tint.astype(np.float32)).clip(0, 255).astype(np.uint8))
        faults.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._stack.close()
