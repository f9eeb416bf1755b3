"""A recorded episode as its policy saw it: its native frames normalised anew, as the rig did that recorded it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from calibration.errors import error_context
from calibration.normaliser import FrameNormaliser
from robot.rig.replay_rig import recorded_normaliser, recorded_rig
from tacsim.interface import Observation, TactileFrame
from tacsim.models.rig import ReplaySensorConfig, RigConfig
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import Episode, EpisodeError, Step
from tacsim.record.images import reference_image
from tacsim.record.reader import read_episode


@dataclass(frozen=True, slots=True, eq=False)
class ObservedEpisode:
    """The recording at `path`, and how to see it."""

    path: Path
    episode: Episode
    rig: RigConfig | None  # that recorded it, where it is known

    @property
    def canonical(self) -> CanonicalGrid:
        return CanonicalGrid() if self.rig is None else self.rig.canonical

    def steps(self) -> Iterator[tuple[Step, Observation]]:
        """Each step and what was observed after it, one at a time in memory.

        Raises EpisodeError for a step that lacks a frame or an arm, or cannot be read; ValueError and
        calibration.errors.CalibrationError where a frame cannot be normalised.
        """
        spec = self.episode.meta.spec
        normalisers: dict[str, FrameNormaliser] = {}
        for step in self.episode.steps:
            lacking = [*(set(spec.sensors) - set(step.frames)), *(set(spec.arms) - set(step.arms))]
            if lacking:
                raise EpisodeError(f"{self.path}: step {step.index} has nothing of '{sorted(lacking)[0]}'")
            frames = {name: step.frames[name] for name in spec.sensors}
            if not normalisers:
                normalisers = {name: self._normaliser(name, frame) for name, frame in frames.items()}
            tactile = {name: normalisers[name](frame, step.time) for name, frame in frames.items()}
            yield step, Observation(tactile, {name: step.arms[name] for name in spec.arms}, step.time)

    def _normaliser(self, name: str, first: TactileFrame) -> FrameNormaliser:
        """With the episode's picture without contact as its reference; without one, the first frame."""
        config = ReplaySensorConfig(driver="replay", source=str(self.path))
        rows, columns, _ = first.image.shape
        with error_context(f"{self.path}: sensor '{name}'"):
            found = recorded_normaliser(config, name, (rows, columns), self.canonical)
            reference = reference_image(self.episode.meta.attachments, name)
            found.take_reference(first if reference is None else TactileFrame(reference, first.time, first.index))
        return found


def observe_episode(path: Path) -> ObservedEpisode:
    """The episode in a file, seen on the canonical grid that it was recorded with. Raises EpisodeError, ConfigError."""
    return ObservedEpisode(path, read_episode(path), recorded_rig(path))
