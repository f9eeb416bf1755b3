"""A complete mock cell: controllers, cameras, and the simulated gels and body in front of them.

The simulator gets the poses of the mock arms; the arms get contact forces, and the cameras tactile images. In a rig
without a scene nothing is simulated, and only the controllers run.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from robot.common import Closing
from robot.common.kinematics import Kinematics, matrix
from robot.common.tcp import ArmFrames, pose_of
from robot.errors import DeviceError
from robot.mock.camera.camera import MockCamera
from robot.mock.cell.sim_server import SceneFrame, SimServer
from robot.mock.ur.fault_client import FaultClient
from robot.mock.ur.handle import MockArms
from robot.mock.ur.machine.state import VERSION, Version, parse_version
from tacsim import pose as se3
from tacsim.config import load_sensor
from tacsim.interface import FloatArray, Pose, SensorSpec, TactileFrame, Truth
from tacsim.models.hardware import CameraSensorConfig, MockCameraConfig, UrArmConfig, parts_of
from tacsim.models.rig import RigConfig
from tacsim.models.sensor import SensorModel
from tacsim.sim.mount import elastic_mounts

MIN_STEP_INTERVAL = 5e-3  # between two steps in `run_free` [s]


class MockCell(Closing):
    """Starts the mocks of a rig file. A context manager; `close` ends every process.

    Attributes:
        faults: fault client of each controller, by arm.
        cameras: by sensor.
        start_poses: world_from_sensor of each mock arm where an episode begins.
    """

    def __init__(self, config: RigConfig) -> None:
        """Raises DeviceError (MockError, SimServerError) when a mock cannot be started."""
        self._config = config
        self._arms = {name: arm for name, arm in parts_of(config.arms, UrArmConfig).items() if arm.mock is not None}
        cameras = _mock_cameras(config)
        self._frames = {name: _actual_frames(arm) for name, arm in self._arms.items()}
        self._sensor_on: dict[str, str] = {}  # by arm: the sensor on it
        for name, sensor in config.sensors.items():
            if sensor.arm in self._arms:
                self._sensor_on.setdefault(sensor.arm, name)
        self.faults: dict[str, FaultClient] = {}
        self.cameras: dict[str, MockCamera] = {}
        self._sim_server: SimServer | None = None
        self._delays = {name: mock.delay for name, (_, mock) in cameras.items()}
        self._scene_frame: SceneFrame | None = None
        self._placed: dict[str, Pose] = {}  # world_from_sensor of the simulated sensors after the last motion
        mounts = elastic_mounts({name: arm.mock.mount for name, arm in self._arms.items() if arm.mock}, config.period)
        self._mounts = {name: mount for name, mount in mounts.items() if mount is not None}
        self._pushed: dict[str, tuple[NDArray[np.uint8], int]] = {}  # by camera: its image, and the number of the image
        self._late: dict[str, deque[NDArray[np.uint8]]] = {}  # by camera: the last images, oldest first
        self._lock = threading.Lock()  # held while results of a step are distributed
        self._stop = threading.Event()
        self._follower: threading.Thread | None = None  # thread of `run_free`
        self._failure: Exception | None = None  # error of that thread
        self._steps = 0  # steps of that thread
        with ExitStack() as stack:
            models = _sensor_models(config)
            if config.scene is not None and models:
                self._sim_server = stack.enter_context(
                    SimServer(config.scene, models, config.canonical, config.contact)
                )
            for name, (camera, mock) in cameras.items():
                self.cameras[name] = stack.enter_context(_start_camera(name, camera, mock))
            self.start_poses = {name: self._start_pose(name, arm) for name, arm in self._arms.items()}
            if self._arms:
                controllers = MockArms(
                    [arm.host for arm in self._arms.values()],
                    model=[arm.model for arm in self._arms.values()],
                    joints=[self._initial_joints(name, arm) for name, arm in self._arms.items()],
                    payload=[(arm.payload.mass, *arm.payload.centre) for arm in self._arms.values()],
                    version=[_polyscope_version(arm) for arm in self._arms.values()],
                    realtime=any(arm.mock is not None and arm.mock.realtime for arm in self._arms.values()),
                )
                self._controllers = stack.enter_context(controllers)
                self.faults = dict(zip(self._arms, controllers.fault_clients, strict=True))
            self._mocks = stack.pop_all()

    def _start_pose(self, name: str, arm: UrArmConfig) -> Pose:
        """From the rig file, or else the initial pose of the arm's sensor in the scene."""
        if arm.start is not None:
            return arm.start.pose
        initial = {} if self._sim_server is None else self._sim_server.initial
        if self._sensor_on.get(name) not in initial:
            raise DeviceError(
                f"arms.{name}.start is missing, and no scene defines it: give the sensor's world pose at the start of "
                "an episode"
            )
        return initial[self._sensor_on[name]]

    def _initial_joints(self, name: str, arm: UrArmConfig) -> Sequence[float]:
        """Joints at power-on [rad]: from the rig file, or else the posture with the sensor at its start that is
        farthest from a singularity."""
        posture = (0.0, -1.5, 1.5, -1.5, -1.5, 0.0)  # seed of the joints at power-on: elbow up [rad]
        if arm.mock is not None and arm.mock.joints is not None:
            return arm.mock.joints
        kinematics = Kinematics(arm.model)
        start = self.start_poses[name]
        postures = kinematics.solutions(self._frames[name].flange(se3.to_matrix(start)), np.array(posture))
        if not postures:
            raise DeviceError(
                f"arms.{name}: its start {np.round(start.position, 4).tolist()} m is out of reach of a "
                f"{arm.model} whose base stands at {list(arm.world_from_base.position)} m"
            )
        chosen: list[float] = max(postures, key=lambda q: round(kinematics.singularity(q), 6)).tolist()
        return chosen

    # -------------------------------------------------------------- the scene

    @property
    def is_simulated(self) -> bool:
        return self._sim_server is not None

    @property
    def picture_sources(self) -> Collection[str]:
        return self.cameras.keys()

    def sensor(self, name: str, spec: SensorSpec) -> CellSensor:
        return CellSensor(self, name, spec)

    @staticmethod
    def has_simulated_body(config: RigConfig) -> bool:
        """True if the cell of a rig file has a simulated body."""
        body = None if config.scene is None else config.scene.body
        return body is not None and config.contact == "simulated" and bool(_sensor_models(config))

    @property
    def scene_frame(self) -> SceneFrame | None:
        """The scene after the last step; None before the first. Raises DeviceError if the steps have ended."""
        self.check()
        return self._scene_frame

    def truth(self) -> Truth | None:
        return None if self._scene_frame is None else self._scene_frame.truth

    def diagnostics(self) -> Mapping[str, float]:
        """Statistics of the last simulated motion, and its duration [s]."""
        if self._scene_frame is None:
            return {}
        return {**self._scene_frame.stats, "twin_seconds": self._scene_frame.seconds}

    def poses(self) -> dict[str, Pose]:
        """world_from_sensor of the sensor on each mock arm, from the poses of the controllers."""
        found = {}
        for arm, sensor in self._sensor_on.items():
            frames, tool = self._frames[arm], matrix(np.array(self.faults[arm].state().pose))
            found[sensor] = pose_of(frames.world_from_base @ tool @ frames.tool_from_sensor)
        return found

    def place(self) -> None:
        """Puts a fresh body between the sensors, as the operator does at a real rig. Raises SimServerError."""
        if self._sim_server is not None:
            with self._lock:
                self._late.clear()
                for mount in self._mounts.values():
                    mount.begin()
                self._placed = self.poses()
                self._distribute(self._sim_server.place(self._placed))

    def step(self, pause: float = 0.0) -> Mapping[str, int]:
        """Moves the simulated sensors to the poses of the arms. Sends forces to the controllers and, after a `pause`
        [s], images to the cameras.

        Returns the number of each camera's newest image. Raises SimServerError.
        """
        if self._sim_server is None:
            return {}
        with self._lock:
            self._placed = self._poses_of_sensors()
            return self._distribute(self._sim_server.move(self._placed), pause)

    def _poses_of_sensors(self) -> dict[str, Pose]:
        """As `poses`, where the mounts have given way under the present forces."""
        poses = self.poses()
        if self._scene_frame is None:  # nothing was touched yet
            return poses
        for arm, mount in self._mounts.items():
            sensor = self._sensor_on[arm]
            held, here = poses[sensor], self._placed[sensor]
            force = se3.rotate(here, self._scene_frame.wrenches[sensor][:3])
            opposite = [pose.position for name, pose in self._placed.items() if name != sensor]
            moved = mount.move_arm(held.position, here.position, force, opposite)
            poses[sensor] = Pose(moved, held.quaternion)
        return poses

    def _distribute(self, scene_frame: SceneFrame, pause: float = 0.0) -> Mapping[str, int]:
        self._scene_frame = scene_frame
        for arm, sensor in self._sensor_on.items():
            if sensor in scene_frame.wrenches:
                self.faults[arm].wrench(self._at_tool(arm, scene_frame.wrenches[sensor]).tolist())
        time.sleep(pause)
        for name, camera in self.cameras.items():  # cameras repeat their last image
            late = self._late.setdefault(name, deque(maxlen=1 + self._delays[name]))
            late.append(scene_frame.images[name])
            picture = late[0]
            if name not in self._pushed or not np.array_equal(self._pushed[name][0], picture):
                self._pushed[name] = picture, camera.push(picture)
        return {name: number for name, (_, number) in self._pushed.items()}

    def _at_tool(self, arm: str, wrench: FloatArray) -> FloatArray:
        """Converts a wrench (6,) about the sensor in its axes to the controller's: about the TCP, in base axes."""
        at_tool = se3.transform_wrench(se3.from_matrix(self._frames[arm].tool_from_sensor), wrench)
        turn = matrix(np.array(self.faults[arm].state().pose))[:3, :3]
        return np.concatenate([turn @ at_tool[:3], turn @ at_tool[3:]])

    # ---------------------------------------------------------- running free

    def run_free(self) -> None:
        """Starts a thread that moves the simulation to the poses of the arms, as fast as it can."""
        if self._sim_server is not None and self._follower is None:
            self._follower = threading.Thread(target=self._follow_arms, name="mock cell", daemon=True)
            self._follower.start()

    def wait_for_fresh_step(self) -> None:
        """After `run_free`: waits for a complete step that begins after this call. Otherwise an approach would continue
        while the simulator still computes the first touch.

        Raises DeviceError if the steps have ended.
        """
        wanted = self._steps + 2  # the present step may have begun before this call
        while self._steps < wanted:
            self.check()
            time.sleep(MIN_STEP_INTERVAL)

    def check(self) -> None:
        """Raises DeviceError if the thread of `run_free` has failed."""
        if self._failure is not None:
            raise DeviceError(f"the simulation of the mock cell stopped: {self._failure}") from self._failure

    def _follow_arms(self) -> None:
        try:
            while not self._stop.wait(MIN_STEP_INTERVAL):
                self.step()
                self._steps += 1
        except Exception as failure:
            if not self._stop.is_set():
                self._failure = failure

    def close(self) -> None:
        """Ends all mocks; a second call does nothing."""
        self._stop.set()
        if self._follower is not None:
            self._follower.join(5.0)
        self._mocks.close()  # closes each mock even if another one fails


def _actual_frames(arm: UrArmConfig) -> ArmFrames:
    """Frames of the mock arm: with an `error` in its file, the sensor is not at the configured pose."""
    configured = ArmFrames.of(arm)
    assert arm.mock is not None
    sensor = configured.tool_from_sensor @ np.linalg.inv(se3.to_matrix(arm.mock.error.pose))
    return ArmFrames(configured.world_from_base, configured.flange_from_tool, sensor)


def _sensor_models(config: RigConfig) -> dict[str, SensorModel]:
    """Models of the simulated sensors: with a mock camera, or read without a camera."""
    models = {name: sensor.rendered_model(load_sensor) for name, sensor in config.sensors.items()}
    return {name: model for name, model in models.items() if model is not None}


def _mock_cameras(config: RigConfig) -> dict[str, tuple[CameraSensorConfig, MockCameraConfig]]:
    cameras = parts_of(config.sensors, CameraSensorConfig)
    return {name: (camera, camera.mock) for name, camera in cameras.items() if camera.mock is not None}


def _polyscope_version(arm: UrArmConfig) -> Version:
    text = arm.mock.version if arm.mock is not None else None
    return VERSION if text is None else parse_version(text)


def _start_camera(name: str, config: CameraSensorConfig, mock: MockCameraConfig) -> MockCamera:
    url = urlsplit(config.source)
    if url.scheme != "http" or url.hostname is None or url.port is None:
        raise DeviceError(
            f"sensors.{name}.source: a mock camera needs an address on loopback such as "
            f"http://127.0.0.2:8081/?action=stream, got {config.source}"
        )
    size = config.width, config.height
    return MockCamera(url.hostname, url.port, *size, mock.fps, mock.quality, stamped=config.stamped)


class CellSensor:
    """A simulated sensor on a real or mock arm, without a camera: its gel is at the arm's measured pose."""

    def __init__(self, cell: MockCell, name: str, spec: SensorSpec) -> None:
        self._cell, self._name, self.spec = cell, name, spec

    def read(self, timeout: float) -> TactileFrame:
        """The image of the newest simulated state. Raises TimeoutError if there is none within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while (frame := self._cell.scene_frame) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"sensor '{self._name}': the mock cell has simulated nothing within {timeout:g} s")
            time.sleep(1e-3)
        name = self._name
        return TactileFrame(frame.images[name], time=frame.time, index=frame.index, surface=frame.surfaces[name])

    def close(self) -> None:
        """Does nothing: the rig closes the cell."""
