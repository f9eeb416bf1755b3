"""Recorded presses and squeezes from files: episodes of any rig, or CSV tables of poses and forces."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.errors import CalibrationError
from calibration.materials.fit import Press
from robot.rig.replay_rig import open_replay, recorded_rig
from robot.studies.identify.simulation import SensorView, shape_signals
from tacsim import pose as se3
from tacsim.geometry.shapes import depth_below_centre
from tacsim.interface import Action, EndOfEpisode, FloatArray, Observation, Pose
from tacsim.models.hardware import UrArmConfig, parts_of
from tacsim.models.rig import ReplayArmConfig, ReplaySensorConfig, RigConfig
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid, Markers
from tacsim.models.text import suggest_file
from tacsim.physics.worlds.tuning import INITIAL_GAP
from tacsim.record.reader import EpisodeFile
from tacsim.record.sources import read_columns

TABLE, EPISODE = ".csv", ".mcap"
FORCES = ("fx", "fy", "fz")


class BadRecording(CalibrationError):
    """A recording does not contain a press or squeeze of this scene."""


class Recordings:
    """Presses read for one scene, and the views of their sensors.

    Args:
        scene: with the shapes that were pressed; its materials are not used here.
        indenter: pose of its centre in the world, for rigs that move the sensor to it; None: as in the scene.
        balls: radius of the pressed ball by name of the recording [m]; other recordings use the scene's indenter.
    """

    def __init__(self, scene: Scene, indenter: Pose | None = None, balls: Mapping[str, float] | None = None) -> None:
        self.scene, self._indenter, self._balls = scene, indenter, dict(balls or {})
        self.sensor_views: dict[str, SensorView] = {}
        self.from_ur = False  # at least one was recorded with the force sensor of a UR arm
        self.scene_sensors = scene.sensors

    def require(self, names: Iterable[str]) -> None:
        """Raises BadRecording for a ball that belongs to none of the recordings `names`."""
        known_names = list(names)
        for name in self._balls:
            if name not in known_names:
                raise BadRecording(
                    f"no recording '{name}' that a ball belongs to; the recordings are {', '.join(known_names)}"
                )

    def read(self, path: Path) -> Press:
        """Raises BadRecording, EpisodeError."""
        min_moments = 3  # of a press
        press = self._read_table(path) if path.suffix.lower() == TABLE else self._read_episode(path)
        if len(press.time) < min_moments:
            raise BadRecording(f"{path}: {len(press.time)} moments; a press needs at least {min_moments}")
        if not any(name.rpartition(".")[2] in FORCES for name in press.readings):
            raise BadRecording(
                f"{path}: no forces; give a recording with an arm that measures them, or columns fx, fy, fz"
            )
        return replace(press, ball=self._balls.get(press.name))

    def _half_height(self, path: Path) -> float:
        """From the lowest point of the indenter to its centre [m]."""
        assert self.scene.indenter is not None
        indenter = self.scene.indenter
        own = depth_below_centre(
            indenter.geometry, indenter.turn, indenter.effective_edge_radius(self.scene.effective_element_size)
        )
        return self._balls.get(_recording_name(path), own)

    # ------------------------------------------------------------------ tables

    def _read_table(self, path: Path) -> Press:
        """Reads a CSV file: x, y, z [m], fx, fy, fz [N] on the sensor `lower`, in its axes, and optionally time [s].

        z: height of the lowest point of the indenter above the untouched gel, or the gap between the two gels.
        """
        columns = _read_header(path)
        forces = [name for name in FORCES if name in columns]
        timed = ["time"] if "time" in columns else []
        rows = np.array(read_columns(path, ["x", "y", "z", *timed, *forces]))
        self._require_metres(path, rows[:, 2])
        time = rows[:, 3] if timed else np.arange(len(rows), dtype=np.float64)
        if (np.diff(time) < 0).any():
            raise BadRecording(f"{path}: column 'time' goes back; give the moments in their order")
        if self.scene.indenter is not None:
            up = np.array([0.0, 0.0, self._half_height(path)])
            turned = self.scene.indenter.turn
            poses = {"indenter": tuple(Pose(row[:3] + up, turned) for row in rows)}
        else:
            poses = {
                "lower": (Pose(),) * len(rows),
                "upper": tuple(Pose(row[:3], se3.HALF_TURN_X.quaternion) for row in rows),
            }
        readings = {f"lower.{name}": rows[:, 3 + len(timed) + k] for k, name in enumerate(forces)}
        return Press(_recording_name(path), poses, readings, time, np.ones(len(rows), np.int64))

    def _require_metres(self, path: Path, z: FloatArray) -> None:
        """Raises BadRecording for an indenter below the gel, or for gels that intersect: probably not in metres."""
        thickness, lowest = self.scene.gel.size[2], float(z.min())
        if self.scene.indenter is not None and lowest <= -thickness:
            raise BadRecording(
                f"{path}: z goes down to {lowest:g} m, through the gel of {thickness:g} m; give it in metres, 0 at the "
                "first contact of indenter and gel"
            )
        if self.scene.indenter is None and lowest <= 0.0:
            raise BadRecording(f"{path}: z goes down to {lowest:g} m; it is the gap between the gels, in metres")

    # ------------------------------------------------------------------ episodes

    def _read_episode(self, path: Path) -> Press:
        with EpisodeFile(path) as file:
            meta = file.meta
        original = recorded_rig(path)
        sensor_arms = {name: sensor.arm for name, sensor in meta.spec.sensors.items()}
        config = RigConfig(
            name="recorded",
            clock="replay",
            arms={name: ReplayArmConfig(driver="replay", source=str(path)) for name in meta.spec.arms},
            sensors={
                name: ReplaySensorConfig(driver="replay", source=str(path), arm=arm)
                for name, arm in sensor_arms.items()
            },
            canonical=CanonicalGrid() if original is None else original.canonical,
        )
        self.from_ur |= original is not None and any(
            arm.is_real for arm in parts_of(original.arms, UrArmConfig).values()
        )
        roles = self._assign_sensors(path, list(sensor_arms))
        with open_replay(config) as rig:
            observations = [rig.reset()]
            while True:
                try:
                    observations.append(rig.step(Action())[0])
                except EndOfEpisode:
                    break
        readings: dict[str, list[float]] = {}
        for role, sensor in roles.items():
            arm = sensor_arms[sensor]
            self._store_sensor_view(role, sensor, observations[0], config.canonical, original)
            for observation in observations:
                for channel, value in self._tactile_readings(role, sensor, arm, observation).items():
                    readings.setdefault(channel, []).append(value)
        whole = {key: np.array(values) for key, values in readings.items() if len(values) == len(observations)}
        poses = self._relative_poses(path, roles, sensor_arms, observations, original)
        time = np.array([each.time for each in observations])
        return Press(_recording_name(path), poses, whole, time, np.ones(len(time), np.int64))

    def _assign_sensors(self, path: Path, sensors: Sequence[str]) -> dict[str, str]:
        """The recorded sensor of each gel of the scene."""
        wanted = self.scene.sensors
        if len(wanted) == 1 and len(sensors) == 1:
            return {wanted[0]: sensors[0]}
        missing = [name for name in wanted if name not in sensors]
        if missing:
            raise BadRecording(
                f"{path}: recorded with the sensors {', '.join(sensors)}; scene '{self.scene.name}' needs "
                f"{', '.join(wanted)}"
            )
        return {name: name for name in wanted}

    def _store_sensor_view(
        self, role: str, sensor: str, first: Observation, grid: CanonicalGrid, original: RigConfig | None
    ) -> None:
        touch = first.tactile[sensor]
        if touch.height is None:
            return
        config = None if original is None else original.sensors.get(sensor)
        model = config.sensor_model if config is not None and config.is_simulated else None
        markers: Markers | None = None if model is None else model.markers
        self.sensor_views[role] = SensorView(grid, markers, touch.valid)

    def _tactile_readings(self, role: str, sensor: str, arm: str | None, now: Observation) -> dict[str, float]:
        min_depth = 0.2e-3  # of a dent whose width is above noise and mesh error [m]
        readings = {}
        if arm is not None and arm in now.arms:
            wrench = now.arms[arm].wrench
            readings = {f"{role}.{name}": float(wrench[k]) for k, name in enumerate(FORCES)}
        elif "indenter" in now.arms:
            readings = {f"{role}.{name}": -float(now.arms["indenter"].wrench[k]) for k, name in enumerate(FORCES)}
        touch = now.tactile[sensor]
        if role in self.sensor_views:
            flow = touch.flow if self.sensor_views[role].markers is not None else None
            readings |= shape_signals(role, touch.height, flow, touch.valid, self.sensor_views[role].grid.pitch)
            if self.scene.indenter is None:  # the width identifies an indenter; for a body it depends on mesh and edges
                readings.pop(f"{role}.width", None)
            elif touch.height is not None and np.abs(touch.height[touch.valid]).max(initial=0.0) < min_depth:
                readings[f"{role}.width"] = math.nan
        return readings

    def _relative_poses(
        self,
        path: Path,
        roles: dict[str, str],
        sensor_arms: dict[str, str | None],
        observations: Sequence[Observation],
        original: RigConfig | None,
    ) -> dict[str, tuple[Pose, ...]]:
        if self.scene.indenter is None:
            arms = {role: sensor_arms[sensor] for role, sensor in roles.items()}
            without = [role for role, arm in arms.items() if arm is None]
            if without:
                raise BadRecording(f"{path}: sensor '{without[0]}' was on no arm, so its pose is not known")
            return {
                role: tuple(each.arms[arm].pose for each in observations)
                for role, arm in arms.items()
                if arm is not None
            }
        arm = sensor_arms[roles["lower"]]
        found = []
        for each in observations:
            sensor = Pose() if arm is None or arm not in each.arms else each.arms[arm].pose
            indenter = each.arms["indenter"].pose if "indenter" in each.arms else self._indenter_pose(path, original)
            found.append(se3.relative_pose(sensor, indenter))
        return {"indenter": tuple(found)}

    def _indenter_pose(self, path: Path, original: RigConfig | None) -> Pose:
        """Pose of an indenter that is not on an arm."""
        if self._indenter is not None:
            return self._indenter
        if original is None or original.scene is None or original.clock != "sim":
            raise BadRecording(
                f"{path}: the position of the indenter is not known; give its centre by --indenter X,Y,Z (the world of "
                "the rig; `tacsim calibrate touch` finds it)"
            )
        assert self.scene.indenter is not None
        height = self._half_height(path) + INITIAL_GAP
        return Pose(np.array([0.0, 0.0, height]), self.scene.indenter.turn)


def _recording_name(path: Path) -> str:
    """Name of a recording: that of its file, or of the folder of a run."""
    return path.parent.name if path.name == f"episode{EPISODE}" else path.stem


def _read_header(path: Path) -> list[str]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise BadRecording(f"{path}: no readable CSV file: {failure}") from failure


def find_recordings(sources: Sequence[Path]) -> list[Path]:
    """The named files, and those in the named folders (episode.mcap of a run, *.csv), each once.

    Raises BadRecording.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            inside = sorted(
                path
                for pattern in ("*", "*/episode.mcap")
                for path in source.glob(pattern)
                if path.is_file() and path.suffix.lower() in (TABLE, EPISODE) and not path.name.startswith(".")
            )
            if not inside:
                raise BadRecording(f"{source}: no recordings in this folder ({TABLE} or {EPISODE})")
            found += inside
        elif not source.is_file():
            raise BadRecording(f"{source}: no such file or folder{suggest_file(source, (TABLE, EPISODE))}")
        elif source.suffix.lower() not in (TABLE, EPISODE):
            raise BadRecording(f"{source}: no recording; allowed: {TABLE}, {EPISODE}, or a folder of them")
        else:
            found.append(source)
    return list(dict.fromkeys(found))


def read_all(
    recordings: Recordings, paths: Sequence[Path], on_file: Callable[[int, int], None] = lambda done, total: None
) -> tuple[Press, ...]:
    """Reads all presses. Raises BadRecording, also for a ball whose recording is missing; EpisodeError."""
    presses = []
    recordings.require(_recording_name(path) for path in paths)
    for index, path in enumerate(paths):
        on_file(index, len(paths))
        presses.append(recordings.read(path))
    return tuple(presses)
