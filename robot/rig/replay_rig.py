"""Recorded rigs: episodes, folders of images and videos."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from calibration.errors import error_context
from robot.rig import RIG_ATTACHMENT, CannotOpen
from tacsim.config import load_rig
from tacsim.interface import Normaliser, TactileFrame
from tacsim.models.driver import sensor_part
from tacsim.models.hardware import parts_of
from tacsim.models.rig import ReplayArmConfig, ReplayGripperConfig, ReplaySensorConfig, RigConfig
from tacsim.record.episode import EpisodeMeta
from tacsim.record.replay import (
    ReplayArm,
    ReplayClock,
    ReplayGripper,
    ReplaySensor,
    match_sources,
    recorded_period,
)
from tacsim.record.ros_bag import is_ros_bag
from tacsim.record.sources import EPISODES, episode_meta
from tacsim.rig import Rig


class ReplayReset:
    """The reset of a recorded rig: returns to the first frame; nothing moves."""

    def __init__(self, clock: ReplayClock, sensors: Mapping[str, ReplaySensor]) -> None:
        self._clock, self._sensors = clock, sensors

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        self._clock.rewind()
        return {name: sensor.reference() for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Does nothing: a recording does not change."""


def open_replay(config: RigConfig) -> Rig:
    """Recorded sensors, arms and grippers. The control period is that of the recording. Raises CannotOpen and
    EpisodeError."""
    recorded_arms = {
        name: arm for name, arm in parts_of(config.arms, ReplayArmConfig).items() if arm.source is not None
    }
    recorded_grippers = {
        name: gripper
        for name, gripper in parts_of(config.grippers, ReplayGripperConfig).items()
        if gripper.source is not None
    }
    recorded = {
        name: sensor.model_copy(
            update={
                "arm": sensor.arm if sensor.arm in recorded_arms else None,
                "gripper": sensor.gripper if sensor.gripper in recorded_grippers else None,
            }
        )
        for name, sensor in parts_of(config.sensors, ReplaySensorConfig).items()
    }
    clock = ReplayClock(_common_period(config.name, recorded))
    with ExitStack() as stack:
        sensors: dict[str, ReplaySensor] = {}
        normalisers: dict[str, Normaliser] = {}
        for name, sensor in recorded.items():
            sensors[name] = source = ReplaySensor(sensor, name, clock)
            stack.callback(source.close)
            with error_context(f"sensors.{name}"):
                normaliser = sensor_part(sensor, name, config.canonical).normaliser(source.reference().image)
            if not source.spec.height:  # the frames contain no surface: the normaliser estimates it
                source.spec = replace(source.spec, height=normaliser.finds_height, flow=normaliser.finds_flow)
            normalisers[name] = normaliser
        arms: dict[str, ReplayArm] = {}
        for name, arm in recorded_arms.items():
            arms[name] = ReplayArm(arm, name, clock)
            stack.callback(arms[name].close)
        grippers: dict[str, ReplayGripper] = {}
        for name, gripper in recorded_grippers.items():
            grippers[name] = ReplayGripper(gripper, name, clock)
            stack.callback(grippers[name].close)
        match_sources(sensors, arms)
        rig = Rig(
            name=config.name,
            sensors=sensors,
            arms=dict(arms),
            clock=clock,
            normalisers=normalisers,
            reset=ReplayReset(clock, sensors),
            grippers=dict(grippers),
        )
        stack.pop_all()
        return rig


def _common_period(rig: str, sensors: Mapping[str, ReplaySensorConfig]) -> float:
    periods = {name: recorded_period(sensor, name) for name, sensor in sensors.items()}
    shortest, longest = min(periods, key=periods.__getitem__), max(periods, key=periods.__getitem__)
    if periods[longest] > periods[shortest] * 1.01:
        raise CannotOpen(
            f"rig '{rig}': recordings are replayed frame by frame, but sensors.{shortest} has one every "
            f"{periods[shortest]:.4g} s and sensors.{longest} every {periods[longest]:.4g} s; use one rate"
        )
    return periods[shortest]


def recorded_rig(source: Path) -> RigConfig | None:
    """The rig that an episode was recorded with; None if it is unknown."""
    if source.suffix.lower() not in EPISODES or is_ros_bag(source):
        return None
    return rig_of(episode_meta(source))


def rig_of(meta: EpisodeMeta) -> RigConfig | None:
    """The rig that an episode with this description was recorded with; None if it is unknown."""
    text = meta.attachments.get(RIG_ATTACHMENT)
    if text is None:
        return None
    with tempfile.TemporaryDirectory() as folder:  # an empty folder: the text cannot refer to other files
        path = Path(folder) / RIG_ATTACHMENT
        path.write_bytes(text)
        return load_rig(path).config
