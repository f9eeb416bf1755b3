"""A rig, and one tactile camera of it, as LeRobot has robots and cameras; small steps by keys or a gamepad.

A robot is flat dictionaries of numbers and pictures, without a call for a reset. What the numbers are, and what they
are called, stands in `robot.export.lerobot_mapping`.
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
from robot.rig.clock import WallClock
from robot.rig.parts import sensor_of
from tacsim.gym.features import SCALES
from tacsim.interface import IncompatibleRig, Observation, Pose
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig, parts_of
from tacsim.models.rig import RigConfig, TaskConfig
from tacsim.models.sensor import CanonicalGrid
from tacsim.rig import Rig

Values = dict[str, float | NDArray[np.uint8]]

LOOKS = 10  # so many looks in a row, each after less than this share of a period, are another rate


log = logging.getLogger(__name__)


def ask_at_terminal(question: str) -> bool:
    """A person's yes at the terminal; without one there is nobody to give it: False."""
    if not sys.stdin.isatty():
        return False
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def require_rate(config: RigConfig, fps: float) -> None:
    """Raises IncompatibleRig where LeRobot would go by another period than the rig."""
    max_rate_error = 1e-3  # share by which a rate may differ from that of the rig
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
    """A rig that is reset once, when it is connected: all poses are relative to that moment, all pictures to the ones
    taken then, of however many episodes.

    LeRobot's loop is the clock of hardware. Where time is simulated, and in lock step, each action lets one control
    period pass.

    Args:
        rig, task, overrides: as for `open_rig`; task and overrides not for a configuration.
        fps: LeRobot's rate, which must be that of the rig; None: not known.

    Raises what `open_rig` raises for a file, a calibration or a recording, and IncompatibleRig for a rig without a
    sensor or an arm, or of another rate. Nothing is opened.
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
        self._mapping = LeRobotMapping(rig_spec(self.config), self.config.canonical, maps=False)
        self._rig: Rig | None = None
        self._poses: Mapping[str, Pose] = {}  # measured last
        self._looked = False  # since the last action
        self._looks: deque[float] = deque(maxlen=LOOKS + 1)  # when [s]

    @property
    def observation_features(self) -> dict[str, type[float] | tuple[int, int, int]]:
        """Of what `observe` returns: float, or the shape of a picture."""
        shape = picture_shape(self.config.canonical)
        return dict.fromkeys(self._mapping.state.names, float) | dict.fromkeys(self.config.sensors, shape)

    @property
    def action_features(self) -> dict[str, type[float]]:
        """Of what `send` takes and returns."""
        return dict.fromkeys(self._mapping.action.names, float)

    @property
    def connected(self) -> bool:
        return self._rig is not None

    def connect(self, confirm: Callable[[str], bool] = ask_at_terminal) -> None:
        """Opens the rig and resets it: the arms go to their start and approach until they touch.

        confirm: asks a person; real arms approach nothing without a yes. Raises what `open_rig` and `Rig.reset` raise,
        and RuntimeError when it is connected already.
        """
        if self._rig is not None:
            raise RuntimeError(f"rig '{self.config.name}' is connected already")
        with ExitStack() as stack:
            rig = stack.enter_context(open_rig(self.config, confirm=confirm))
            self._see(rig.reset(), first=True)
            stack.pop_all()
        self._rig = rig
        self._looks = deque(maxlen=LOOKS + 1)
        rate = 1.0 / self.config.period
        log.info("rig '%s' is ready; it goes at %g frames a second: --dataset.fps=%g", rig.name, rate, rate)

    def observe(self) -> Values:
        """The state, number by number, and the canonical picture of each sensor, (H, W, 3) uint8.

        Raises as `Rig.observe`, and RuntimeError when it is not connected.
        """
        self._watch_rate()
        return self._see(self._opened().observe())

    def send(self, action: Mapping[str, float]) -> dict[str, float]:
        """Asks the arms to go where `action` says. Returns where they were really sent, after all limits; an arm that
        was sent nowhere stays where it was measured last.

        Raises as `Rig.command` and, where time passes here, as `Rig.step`; ActionError for what is no action.
        """
        rig, names = self._opened(), self._mapping.action.names
        if set(action) != set(names):
            wrong = sorted(set(names) ^ set(action))[0]
            found = "is missing" if wrong in names else "is none of them"
            raise ActionError(f"an action has the numbers of action_features, but {wrong} {found}")
        asked = self._mapping.decoded(np.array([float(action[name]) for name in names]))
        if not self._looked:  # LeRobot drives back to the start without a look; arms follow nobody who does not look
            self._see(rig.observe())
        sent = rig.command(asked)
        if not isinstance(rig.clock, WallClock):
            rig.tick()
        self._looked = False
        poses = {name: sent.get(name) or pose for name, pose in self._poses.items()}
        return dict(zip(names, self._mapping.encoded(poses).tolist(), strict=True))

    def close(self) -> None:
        """Stops the arms and closes the rig. A second call does nothing."""
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()

    def _opened(self) -> Rig:
        if self._rig is None:
            raise RuntimeError(f"rig '{self.config.name}' is not connected: call connect() first")
        return self._rig

    def _see(self, observation: Observation, *, first: bool = False) -> Values:
        row = self._mapping.begin(observation) if first else self._mapping.observed(observation)
        self._poses = {name: arm.pose for name, arm in observation.arms.items()}
        self._looked = True
        values: Values = dict(zip(self._mapping.state.names, row[STATE].tolist(), strict=True))
        return values | {name: row[IMAGE + name] for name in observation.tactile}

    def _watch_rate(self) -> None:
        """Says it once when LeRobot goes faster than the rig; that it goes slower may be the machine's fault."""
        min_period_share = 0.75  # so many looks in a row, each after less than this share of a period, are another rate
        self._looks.append(time.monotonic())
        longest = float(np.diff(self._looks).max()) if len(self._looks) > LOOKS else math.inf
        if longest < min_period_share * self.config.period:
            self._looks = deque([math.inf], maxlen=1)
            log.warning(
                "LeRobot looks every %.0f ms, but the control period of rig '%s' is %g ms: what is recorded has wrong "
                "times. Give both the same rate: --dataset.fps=%g",
                *(1e3 * longest, self.config.name, 1e3 * self.config.period, 1.0 / self.config.period),
            )


class TactileCamera:
    """One camera of a rig file. Its arms, if it has some, are left alone.

    sensor: its name in the file; None: the only one. Raises what loading the file and its calibration raise, and
    IncompatibleRig for a sensor that is no camera. Nothing is opened.
    """

    def __init__(self, rig: str | Path, sensor: str | None = None, overrides: Sequence[str] = ()) -> None:
        config = load_with_task(rig, None, overrides).config
        there = ", ".join(config.sensors)
        if sensor is None and len(config.sensors) > 1:
            raise IncompatibleRig(f"rig '{config.name}' has several sensors; name one of them: {there}")
        self.name = next(iter(config.sensors)) if sensor is None else sensor
        if self.name not in config.sensors:
            raise IncompatibleRig(f"rig '{config.name}' has no sensor '{self.name}'; it has {there}")
        found = parts_of(config.sensors, CameraSensorConfig).get(self.name)
        if found is None:
            driver = config.sensors[self.name].driver
            raise IncompatibleRig(f"sensor '{self.name}' of rig '{config.name}' is {driver}, not a camera")
        if found.is_mock:
            raise IncompatibleRig(
                f"sensor '{self.name}' of rig '{config.name}' is a mock that its whole rig starts; name a camera that "
                "runs by itself"
            )
        self.fps: float = found.fps  # that the camera is asked for
        self.shape = picture_shape(config.canonical)  # of a picture: rows, columns, 3
        self._config = found
        self._normaliser = sensor_of(config, self.name).normaliser()
        self._camera: Camera | None = None
        self._seen = -1  # index of the frame that `read_new` gave last

    @property
    def connected(self) -> bool:
        return self._camera is not None

    def connect(self) -> None:
        """Opens the camera and takes its picture now as that without contact: nothing may touch the gel.

        Raises DeviceError, and RuntimeError when it is connected already.
        """
        picture_timeout = 5.0  # longest wait for the picture without contact [s]
        if self._camera is not None:
            raise RuntimeError(f"sensor '{self.name}' is connected already")
        with ExitStack() as stack:
            camera = stack.enter_context(Camera(self._config, self.name))
            self._normaliser.take_reference(camera.read(picture_timeout))
            stack.pop_all()
        self._camera, self._seen = camera, -1

    def read(self, timeout: float = 1.0) -> NDArray[np.uint8]:
        """The newest canonical picture, (H, W, 3) RGB. Raises TimeoutError without one within the sensor's max_age, and
        RuntimeError when it is not connected."""
        frame = self._opened().read(timeout)
        self._seen = frame.index
        return self._normaliser(frame, frame.time).image

    def read_new(self, timeout: float) -> NDArray[np.uint8]:
        """One that was not read before. Raises as `read`."""
        poll_interval = 2e-3  # between two looks for a new picture [s]
        camera, deadline = self._opened(), time.monotonic() + timeout
        while camera.read(max(0.0, deadline - time.monotonic())).index == self._seen:
            if time.monotonic() >= deadline:
                raise StaleFrame(f"sensor '{self.name}': no new picture within {timeout:.3g} s")
            time.sleep(poll_interval)
        return self.read(timeout)

    def age(self) -> float:
        """Of the newest picture, since its exposure [s]. Raises RuntimeError when it is not connected."""
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
    """Steps along the axes of the sensors at reset, as actions of a `LeRobotRig`; none turns. z is into what is felt.

    Args:
        rig: that the actions are for; it need not be connected.
        step: of a full stroke [m].
        arms: that move, each along its own sensor's axes; none named: all.

    Raises IncompatibleRig for an arm that the rig has not, ValueError for a step that is none.
    """

    def __init__(self, rig: LeRobotRig, step: float, arms: Sequence[str] = ()) -> None:
        there = rig.config.arms
        if unknown := sorted(set(arms) - set(there)):
            raise IncompatibleRig(f"rig '{rig.config.name}' has no arm '{unknown[0]}'; it has {', '.join(there)}")
        if not 0.0 < step < 0.01:
            raise ValueError(f"step must be a length below 10 mm, in m, got {step!r}")
        self.names = tuple(rig.action_features)
        self._step, self._arms = step, tuple(arms or there)
        self._gone = np.zeros(3)  # [m]

    def __call__(self, strokes: Sequence[float]) -> dict[str, float]:
        """The action after one more step of (x, y, z) strokes, each within -1 and 1."""
        self._gone = self._gone + self._step * np.clip(np.asarray(strokes, np.float64), -1.0, 1.0)
        action = dict.fromkeys(self.names, 0.0)
        for arm in self._arms:
            for axis, gone in zip("xyz", self._gone / SCALES["moved"], strict=True):
                action[f"moved_{axis}_{arm}.pos"] = float(gone)
        return action

    def reset(self) -> None:
        """Starts again from the pose at reset."""
        self._gone = np.zeros(3)
