"""A rig as a LeRobot robot, its tactile camera as a LeRobot camera, and small steps by keys or a gamepad.

LeRobot exchanges flat dictionaries of numbers and pictures with a robot, and has no call for a reset. The module
`robot.export.lerobot_mapping` defines the numbers and their names.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot.camera.camera import Camera, StaleFrame
from robot.export.lerobot_mapping import IMAGE, STATE, LeRobotMapping
from robot.open import load_with_task, open_rig, rig_spec
from robot.rig.hardware_rig import WallClock
from robot.rig.parts import sensor_of
from tacsim.gym.features import SCALES
from tacsim.interface import IncompatibleRig, Observation, Pose
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig, parts_of
from tacsim.models.rig import RigConfig
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import TaskConfig
from tacsim.rig import Rig
from tacsim.tasks import make_task

Values = dict[str, float | NDArray[np.uint8]]

RATE_SAMPLES = 10  # consecutive observation periods from which the rate is judged


log = logging.getLogger(__name__)


def ask_at_terminal(question: str) -> bool:
    """Asks the operator at the terminal; returns False if there is no terminal."""
    if not sys.stdin.isatty():
        return False
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def require_rate(config: RigConfig, fps: float) -> None:
    """Raises IncompatibleRig if the rate of LeRobot is not that of the rig."""
    max_rate_error = 1e-3  # relative difference of the rates
    rate = 1.0 / config.period
    if not abs(fps - rate) <= max_rate_error * rate:
        raise IncompatibleRig(
            f"rig '{config.name}' has a control period of {1e3 * config.period:g} ms, which is fps={rate:g}, not "
            f"{fps:g}; give LeRobot that rate, or the rig another period (period={1e3 / fps:.4g} ms)"
        )


def picture_shape(grid: CanonicalGrid) -> tuple[int, int, int]:
    """(rows, columns, 3) of canonical pictures."""
    return grid.rows * grid.image_scale, grid.columns * grid.image_scale, 3


class LeRobotRig:
    """A rig that is reset once, when it is connected. All poses are relative to that moment, all pictures to the
    reference images of that moment, for any number of episodes.

    LeRobot's loop is the clock of hardware. With simulated time, and in lock step, each action advances one control
    period. The constructor opens no device.

    Args:
        rig, task, overrides: as for `open_rig`; a configuration as `rig` allows no task or overrides.
        fps: LeRobot's rate, which must be that of the rig; None: not known.

    Raises:
        IncompatibleRig: the rig has no sensor or no arm, or another rate; and the errors of `open_rig` for a file, a
            calibration or a recording.
    """

    def __init__(
        self,
        rig: str | Path | RigConfig,
        *,
        task: str | TaskConfig | None = None,
        overrides: Sequence[str] = (),
        fps: float | None = None,
    ) -> None:
        self.config = rig if isinstance(rig, RigConfig) else load_with_task(rig, task, overrides).config
        if fps is not None:
            require_rate(self.config, fps)
        goal = None if self.config.task is None else make_task(self.config.task).goal
        self._mapping = LeRobotMapping(rig_spec(self.config), self.config.canonical, maps=False, goal=goal)
        self._rig: Rig | None = None
        self._poses: Mapping[str, Pose] = {}  # the last measured ones
        self._has_observed = False  # since the last action
        self._observation_times: deque[float] = deque(maxlen=RATE_SAMPLES + 1)  # [s]

    @property
    def observation_features(self) -> dict[str, type[float] | tuple[int, int, int]]:
        """Type of each entry that `observe` returns: float, or the shape of a picture."""
        shape = picture_shape(self.config.canonical)
        return dict.fromkeys(self._mapping.state.names, float) | dict.fromkeys(self.config.sensors, shape)

    @property
    def action_features(self) -> dict[str, type[float]]:
        """Type of each number that `send` takes and returns."""
        return dict.fromkeys(self._mapping.action.names, float)

    @property
    def connected(self) -> bool:
        return self._rig is not None

    def connect(self, confirm: Callable[[str], bool] = ask_at_terminal) -> None:
        """Opens the rig and resets it: the arms move to their start and approach until contact.

        confirm: asks the operator; real arms approach only if it returns True.

        Raises:
            RuntimeError: it is connected already; and the errors of `open_rig` and `Rig.reset`.
        """
        if self._rig is not None:
            raise RuntimeError(f"rig '{self.config.name}' is connected already")
        with ExitStack() as stack:
            rig = stack.enter_context(open_rig(self.config, confirm=confirm))
            self._encode(rig.reset(), first=True)
            stack.pop_all()
        self._rig = rig
        self._observation_times = deque(maxlen=RATE_SAMPLES + 1)
        rate = 1.0 / self.config.period
        log.info("rig '%s' is ready; its rate is %g frames a second: --dataset.fps=%g", rig.name, rate, rate)

    def observe(self) -> Values:
        """The numbers of the state by name, and the canonical picture of each sensor, (H, W, 3) uint8.

        Raises the errors of `Rig.observe`, and RuntimeError if it is not connected.
        """
        self._watch_rate()
        return self._encode(self._opened().observe())

    def send(self, action: Mapping[str, float]) -> dict[str, float]:
        """Sends targets to the arms. Returns the targets after all limits; for an arm without a target, its last
        measured pose.

        Raises:
            ActionError: `action` does not have the numbers of `action_features`, or they are no poses; and the errors
                of `Rig.command` and, with simulated time, of `Rig.step`.
        """
        rig, names = self._opened(), self._mapping.action.names
        if set(action) != set(names):
            wrong = sorted(set(names) ^ set(action))[0]
            found = "is missing" if wrong in names else "is none of them"
            raise ActionError(f"an action has the numbers of action_features, but {wrong} {found}")
        targets = self._mapping.decode_action(np.array([float(action[name]) for name in names]))
        if not self._has_observed:  # LeRobot moves back to the start without observing; arms need observations
            self._encode(rig.observe())
        sent = rig.command(targets)
        if not isinstance(rig.clock, WallClock):
            rig.tick()
        self._has_observed = False
        poses = {name: sent.get(name) or pose for name, pose in self._poses.items()}
        grips = {name: grip for name, grip in rig.sent_grippers.items() if grip is not None}
        return dict(zip(names, self._mapping.encode_targets(poses, grips).tolist(), strict=True))

    def close(self) -> None:
        """Stops the arms and closes the rig. A second call does nothing."""
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()

    def _opened(self) -> Rig:
        if self._rig is None:
            raise RuntimeError(f"rig '{self.config.name}' is not connected: call connect() first")
        return self._rig

    def _encode(self, observation: Observation, *, first: bool = False) -> Values:
        row = self._mapping.begin(observation) if first else self._mapping.encode_observation(observation)
        self._poses = {name: arm.pose for name, arm in observation.arms.items()}
        self._has_observed = True
        values: Values = dict(zip(self._mapping.state.names, row[STATE].tolist(), strict=True))
        return values | {name: row[IMAGE + name] for name in observation.tactile}

    def _watch_rate(self) -> None:
        """Warns once if LeRobot is faster than the rig. A slower LeRobot is no error: the machine may be slow."""
        min_period_share = 0.75  # of the control period; if all recent periods are shorter, the rates differ
        self._observation_times.append(time.monotonic())
        longest = (
            float(np.diff(self._observation_times).max()) if len(self._observation_times) > RATE_SAMPLES else math.inf
        )
        if longest < min_period_share * self.config.period:
            self._observation_times = deque([math.inf], maxlen=1)
            log.warning(
                "LeRobot observes every %.0f ms, but the control period of rig '%s' is %g ms: the recording has wrong "
                "times. Give both the same rate: --dataset.fps=%g",
                *(1e3 * longest, self.config.name, 1e3 * self.config.period, 1.0 / self.config.period),
            )


class TactileCamera:
    """One camera of a rig file, without the arms of the rig. The constructor opens no device.

    sensor: its name in the file; None: the only one.

    Raises:
        IncompatibleRig: the sensor is no camera; and the errors of loading the file and its calibration.
    """

    def __init__(self, rig: str | Path, sensor: str | None = None, overrides: Sequence[str] = ()) -> None:
        config = load_with_task(rig, None, overrides).config
        names = ", ".join(config.sensors)
        if sensor is None and len(config.sensors) > 1:
            raise IncompatibleRig(f"rig '{config.name}' has several sensors; name one of them: {names}")
        self.name = next(iter(config.sensors)) if sensor is None else sensor
        if self.name not in config.sensors:
            raise IncompatibleRig(f"rig '{config.name}' has no sensor '{self.name}'; it has {names}")
        found = parts_of(config.sensors, CameraSensorConfig).get(self.name)
        if found is None:
            driver = config.sensors[self.name].driver
            raise IncompatibleRig(f"sensor '{self.name}' of rig '{config.name}' is {driver}, not a camera")
        if found.is_mock:
            raise IncompatibleRig(
                f"sensor '{self.name}' of rig '{config.name}' is a mock that its whole rig starts; name a camera with "
                "its own driver"
            )
        self.fps: float = found.fps  # requested from the camera
        self.shape = picture_shape(config.canonical)  # of a picture: rows, columns, 3
        self._config = found
        self._normaliser = sensor_of(config, self.name).normaliser()
        self._camera: Camera | None = None
        self._last_index = -1  # index of the frame that `read_new` gave last

    @property
    def connected(self) -> bool:
        return self._camera is not None

    def connect(self) -> None:
        """Opens the camera and takes its reference image: nothing may touch the gel.

        Raises DeviceError, and RuntimeError if it is connected already.
        """
        picture_timeout = 5.0  # for the reference image [s]
        if self._camera is not None:
            raise RuntimeError(f"sensor '{self.name}' is connected already")
        with ExitStack() as stack:
            camera = stack.enter_context(Camera(self._config, self.name))
            self._normaliser.take_reference(camera.read(picture_timeout))
            stack.pop_all()
        self._camera, self._last_index = camera, -1

    def read(self, timeout: float = 1.0) -> NDArray[np.uint8]:
        """The newest canonical picture, (H, W, 3) RGB. Raises TimeoutError if none is younger than max_age of the
        sensor, and RuntimeError if it is not connected."""
        frame = self._opened().read(timeout)
        self._last_index = frame.index
        return self._normaliser(frame, frame.time).image

    def read_new(self, timeout: float) -> NDArray[np.uint8]:
        """The next picture that was not read before. Raises the errors of `read`."""
        poll_interval = 2e-3  # between two polls for a new picture [s]
        camera, deadline = self._opened(), time.monotonic() + timeout
        while camera.read(max(0.0, deadline - time.monotonic())).index == self._last_index:
            if time.monotonic() >= deadline:
                raise StaleFrame(f"sensor '{self.name}': no new picture within {timeout:.3g} s")
            time.sleep(poll_interval)
        return self.read(timeout)

    def age(self) -> float:
        """Time since the exposure of the newest picture [s]. Raises RuntimeError if it is not connected."""
        age = self._opened().status.age
        return float("inf") if age is None else age

    def close(self) -> None:
        """Releases the camera. A second call does nothing."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()

    def _opened(self) -> Camera:
        if self._camera is None:
            raise RuntimeError(f"sensor '{self.name}' is not connected: call connect() first")
        return self._camera


class Jog:
    """Steps along the axes of the sensors at reset, without rotation, as actions of a `LeRobotRig`. z points into the
    object.

    Args:
        rig: for which the actions are made; it need not be connected.
        step: length at full deflection [m].
        arms: that move, each along the axes of its sensor; empty: all.

    Raises:
        IncompatibleRig: the rig has no arm of this name, or it has a gripper, which small steps do not move.
        ValueError: the step is not between 0 and 10 mm.
    """

    def __init__(self, rig: LeRobotRig, step: float, arms: Sequence[str] = ()) -> None:
        names = rig.config.arms
        if unknown := sorted(set(arms) - set(names)):
            raise IncompatibleRig(f"rig '{rig.config.name}' has no arm '{unknown[0]}'; it has {', '.join(names)}")
        if rig.config.grippers:
            raise IncompatibleRig(
                f"rig '{rig.config.name}' has a gripper; small steps by keys or a gamepad move arms only"
            )
        if not 0.0 < step < 0.01:
            raise ValueError(f"step must be a length below 10 mm, in m, got {step!r}")
        self.names = tuple(rig.action_features)
        self._step, self._arms = step, tuple(arms or names)
        self._displacement = np.zeros(3)  # [m]

    def __call__(self, deflections: Sequence[float]) -> dict[str, float]:
        """The action after another step by deflections (x, y, z), each from -1 to 1."""
        self._displacement = self._displacement + self._step * np.clip(np.asarray(deflections, np.float64), -1.0, 1.0)
        action = dict.fromkeys(self.names, 0.0)
        for arm in self._arms:
            for axis, displacement in zip("xyz", self._displacement / SCALES["moved"], strict=True):
                action[f"moved_{axis}_{arm}.pos"] = float(displacement)
        return action

    def reset(self) -> None:
        """Continues from the pose at reset."""
        self._displacement = np.zeros(3)
