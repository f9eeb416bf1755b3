"""Recorded sensors, arms and grippers as parts of a rig. Frame k of every source belongs to tick k of one clock.

Times are on the replay's clock: a picture that was exposed 20 ms before its step is 20 ms old in the replay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tacsim.interface import (
    ArmState,
    EndOfEpisode,
    GripperState,
    GripperTarget,
    Image,
    Pose,
    SensorSpec,
    TactileFrame,
)
from tacsim.models.rig import ReplayArmConfig, ReplayGripperConfig, ReplaySensorConfig
from tacsim.models.text import suggest_file
from tacsim.record.episode import EpisodeError
from tacsim.record.images import read_image, reference_image
from tacsim.record.numbering import Numbering, match_numbers, numbers_in_names
from tacsim.record.ros_bag import PictureTopic, is_ros_bag, open_topic
from tacsim.record.sources import (
    EPISODES,
    VIDEOS,
    Cursor,
    T,
    episode_frames,
    episode_gripper_states,
    episode_meta,
    episode_states,
    finger_states,
    folder_images,
    list_pictures,
    read_table,
    select_name,
    unknown_source_error,
    video_images,
    video_length,
    video_rate,
)


class ReplayClock:
    """Clock with one recorded frame a tick. `period`: time between two frames [s]; `index`: number of the frame, from
    0.
    """

    def __init__(self, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"the period of a replay must be above 0 s, got {period}")
        self.period = period
        self.index = 0

    def now(self) -> float:
        return self.index * self.period

    def tick(self) -> None:
        self.index += 1

    def rewind(self) -> None:
        """Goes back to the first frame."""
        self.index = 0


class ReplaySensor:
    """Recorded frames as a TactileSource.

    The source is an episode (the sensor of this name, or its only one), a folder of pictures of one size, a video, or a
    ROS 2 bag in MCAP (one topic of compressed pictures).
    `spec` has height and flow if the recorded frames have them; robot.open adds the outputs of the normaliser.

    Raises EpisodeError if the source is missing, empty, unreadable, too large, or has no such sensor.
    """

    def __init__(self, config: ReplaySensorConfig, name: str, clock: ReplayClock) -> None:
        self._config, self._name, self._clock = config, name, clock
        self._path = _require_source(config.source, f"sensors.{name}")
        self._reference = None if config.reference is None else read_image(Path(config.reference))
        self._pictures: list[Path] | None = None  # of a folder
        self._topic = _bag_topic(config, self._path, name)
        self._frames = Cursor(self._frame_starter(), str(self._path))
        self._first, _ = _first_item(self._frames, self._path)
        rows, columns, _ = self._first.image.shape
        if self._reference is not None and self._reference.shape[:2] != (rows, columns):
            self.close()
            raise EpisodeError(
                f"sensors.{name}.reference: {self._reference.shape[1]} x {self._reference.shape[0]} pixels, "
                f"but the frames of {self._path} have {columns} x {rows}"
            )
        surface = self._first.surface
        flow = surface is not None and surface.flow is not None
        self.spec = SensorSpec(
            image_shape=(rows, columns), height=surface is not None, flow=flow, arm=config.arm, gripper=config.gripper
        )

    def read(self, timeout: float) -> TactileFrame:
        """The frame of this tick, without waiting. Raises EndOfEpisode after the last, EpisodeError for an unreadable
        one."""
        frame, age = self._frames.seek(self._clock.index)
        if frame.image.shape[:2] != self.spec.image_shape:
            raise EpisodeError(
                f"{self._path}: frame {self._clock.index} has {frame.image.shape[:2]} rows and columns, "
                f"the first has {self.spec.image_shape}"
            )
        return replace(frame, time=self._clock.now() - age)

    def reference(self) -> TactileFrame:
        """A frame without contact: the `reference` of the rig file, or that of the episode, or the first frame."""
        if self._reference is None:
            return replace(self._first, time=self._clock.now())
        return TactileFrame(image=self._reference, time=self._clock.now(), index=self._first.index)

    def numbering(self, expected: int | None) -> Numbering | None:
        """Numbers of its frames; None for an episode, whose steps are complete and numbered from 0. expected: count of
        the other sources, None if none has a count. Raises EpisodeError."""
        if self._topic is not None:
            return Numbering(f"{self._path}: {self._topic.topic}", self._topic.count(), None)
        if self._pictures is not None:
            given = None if self._config.reference is None else Path(self._config.reference).resolve()
            places = [k for k, path in enumerate(self._pictures) if path.resolve() == given]
            numbers = numbers_in_names([path.stem for path in self._pictures])
            return Numbering(str(self._path), len(self._pictures), numbers, places[0] if places else None)
        if self._path.suffix.lower() in EPISODES:
            return None
        count = video_length(self._path, -1 if expected is None else expected)
        return Numbering(str(self._path), count, tuple(range(count)))

    def select_places(self, places: Sequence[int]) -> None:
        """Uses only the pictures at these positions of the folder as frames."""
        if self._pictures is None or list(places) == list(range(len(self._pictures))):
            return
        self._frames.close()
        self._pictures = [self._pictures[place] for place in places]
        self._first, _ = _first_item(self._frames, self._path)

    def close(self) -> None:
        self._frames.close()

    def _frame_starter(self) -> Callable[[], Iterator[tuple[TactileFrame, float]]]:
        """A function that starts an iterator of frames, each with its age at its step [s]; 0 for pictures and
        videos."""
        path = self._path
        if (topic := self._topic) is not None:
            return lambda: ((frame, 0.0) for frame in topic.frames())
        if path.is_dir():
            self._pictures = list_pictures(path)
            return lambda: _number_images(folder_images(self._pictures or []))
        if path.suffix.lower() in VIDEOS and path.is_file():
            return lambda: _number_images(video_images(path))
        if path.suffix.lower() not in EPISODES or not path.is_file():
            raise unknown_source_error(path)
        meta = episode_meta(path)
        sensor = select_name(list(meta.spec.sensors), self._name, path, "sensor")
        if self._reference is None:
            self._reference = reference_image(meta.attachments, sensor)
        return lambda: ((frame, time - frame.time) for frame, time in episode_frames(path, sensor))


class ReplayArm:
    """Recorded states as an Arm that executes nothing.

    The source is an episode (the arm of this name, or its only one), or the CSV file of a parallel gripper with one row
    for each frame (frames and signs: :func:`tacsim.record.sources.finger_states`). The arm called "lower" is the lower
    finger, all others are the upper one.

    Raises EpisodeError if the source is missing, empty, unreadable, or has no such arm or column.
    """

    def __init__(self, config: ReplayArmConfig, name: str, clock: ReplayClock) -> None:
        self._config, self._name, self._clock = config, name, clock
        self._path = _require_source(config.source, f"arms.{name}")
        self._rows: list[ArmState] | None = None  # of a table
        self._numbers: tuple[int, ...] | None = None  # of its rows
        self._states = Cursor(self._state_starter(), str(self._path))
        _first_item(self._states, self._path)

    def state(self, at: float | None = None) -> ArmState:
        """The state of this tick. Raises EndOfEpisode after the last."""
        state, age = self._states.seek(self._clock.index)
        return replace(state, time=self._clock.now() - age)

    def command(self, target: Pose | None) -> Pose | None:
        """Executes nothing and returns None."""
        return None

    def stop(self) -> None:
        """Has no effect: nothing moves."""

    def recover(self) -> None:
        """Has no effect: there are no faults."""

    def numbering(self) -> Numbering | None:
        """Numbers of a table's rows; None for an episode, whose steps are complete and numbered from 0."""
        return None if self._rows is None else Numbering(str(self._path), len(self._rows), self._numbers)

    def select_places(self, places: Sequence[int]) -> None:
        """Uses only the table's rows at these positions as states."""
        if self._rows is not None:
            self._states.close()
            self._rows = [replace(self._rows[place], time=k * self._clock.period) for k, place in enumerate(places)]

    def close(self) -> None:
        self._states.close()

    def _state_starter(self) -> Callable[[], Iterator[tuple[ArmState, float]]]:
        """A function that starts an iterator of states, each with its age at its step [s]."""
        path = self._path
        if path.suffix.lower() in EPISODES and path.is_file():
            arm = select_name(list(episode_meta(path).spec.arms), self._name, path, "arm")
            return lambda: ((state, time - state.time) for state, time in episode_states(path, arm))
        if not path.is_file():
            raise EpisodeError(f"{path}: no such file{suggest_file(path, (*EPISODES, '.csv'))}")
        if path.suffix.lower() != ".csv":
            raise EpisodeError(f"{path}: no record of an arm; give an episode ({', '.join(EPISODES)}) or a .csv file")
        columns = [self._config.force_column]
        columns += [] if self._config.width_column is None else [self._config.width_column]
        rows, self._numbers = read_table(path, columns)
        self._rows = finger_states(rows, self._clock.period, self._name == "lower", self._numbers)
        return lambda: ((state, 0.0) for state in self._rows or [])


class ReplayGripper:
    """The recorded states of a gripper as a Gripper that executes nothing. The source is an episode (the gripper of
    this name, or its only one).

    Raises EpisodeError if the source is missing, empty, unreadable, or has no such gripper.
    """

    width_range = force_range = (0.0, math.inf)

    def __init__(self, config: ReplayGripperConfig, name: str, clock: ReplayClock) -> None:
        self._clock, path = clock, _require_source(config.source, f"grippers.{name}")
        gripper = select_name(list(episode_meta(path).spec.grippers), name, path, "gripper")
        self._states = Cursor(
            lambda: ((state, time - state.time) for state, time in episode_gripper_states(path, gripper)), str(path)
        )
        _first_item(self._states, path)

    def state(self) -> GripperState:
        """The state of this tick. Raises EndOfEpisode after the last."""
        state, age = self._states.seek(self._clock.index)
        return replace(state, time=self._clock.now() - age)

    def command(self, target: GripperTarget | None) -> GripperTarget | None:
        """Executes nothing and returns None."""
        return None

    def stop(self) -> None:
        """Has no effect: nothing moves."""

    def recover(self) -> None:
        """Has no effect: there are no faults."""

    def close(self) -> None:
        self._states.close()


def match_sources(sensors: Mapping[str, ReplaySensor], arms: Mapping[str, ReplayArm]) -> None:
    """Selects frames and rows so that those of one tick belong together, by their numbers if all have numbers. Raises
    EpisodeError if the relation is not known."""
    of_arms = {name: found for name, arm in arms.items() if (found := arm.numbering()) is not None}
    if len(sensors) + len(of_arms) < 2:
        return
    expected = next((each.count for each in of_arms.values()), None)
    of_sensors = {name: found for name, each in sensors.items() if (found := each.numbering(expected)) is not None}
    if not of_sensors:
        return
    for name, places in match_numbers(of_sensors, of_arms).items():
        (sensors[name] if name in of_sensors else arms[name]).select_places(places)


def recorded_period(config: ReplaySensorConfig, name: str) -> float:
    """Time between two frames of a recording [s], which sets the rig's period. Raises EpisodeError.

    Episodes, bags and most videos contain it; otherwise it is taken from `fps` of the rig file.
    """
    path = _require_source(config.source, f"sensors.{name}")
    if (topic := _bag_topic(config, path, name)) is not None:
        return topic.period() or 1.0 / config.fps
    if path.suffix.lower() in EPISODES:
        return episode_meta(path).spec.period
    rate = video_rate(path) if path.suffix.lower() in VIDEOS and path.is_file() else None
    return 1.0 / (config.fps if rate is None else rate)


def _bag_topic(config: ReplaySensorConfig, path: Path, name: str) -> PictureTopic | None:
    """The topic of a ROS 2 bag; None for another recording. Raises EpisodeError."""
    option = f"sensors.{name}.topic"
    if is_ros_bag(path):
        return open_topic(path, config.topic, option)
    if config.topic is not None:
        raise EpisodeError(f"{option}: a topic is one of a ROS 2 bag in MCAP, and {path} is none; leave it out")
    return None


def _first_item(cursor: Cursor[T], path: Path) -> T:
    try:
        return cursor.seek(0)
    except EndOfEpisode:
        raise EpisodeError(f"{path}: a recording without frames") from None


def _number_images(images: Iterator[Image]) -> Iterator[tuple[TactileFrame, float]]:
    for index, image in enumerate(images):
        yield TactileFrame(image=image, time=0.0, index=index), 0.0


def _require_source(source: str | None, key: str) -> Path:
    if source is None:
        raise EpisodeError(f"{key}.source: no recording given; name one with --set {key}.source=PATH")
    return Path(source)
