"""Observations of a recorded episode: its native frames, normalised again as in the rig that recorded it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import read_sensor_model
from calibration.errors import CalibrationError, error_context
from calibration.markers.dots import NoLattice
from calibration.markers.flow import TooFewMarkers, find_markers
from calibration.reference import StaleReference
from robot.rig.parts import sensor_of
from robot.rig.replay_rig import recorded_rig, rig_of
from tacsim.config import ConfigError
from tacsim.interface import Normaliser, Observation, SurfaceMap, TactileFrame, TactileObservation
from tacsim.models.driver import sensor_part
from tacsim.models.hardware import SensorConfig
from tacsim.models.rig import ReplaySensorConfig, RigConfig
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import Episode, EpisodeError, EpisodeMeta, Step
from tacsim.record.images import reference_image
from tacsim.record.reader import read_episode
from tacsim.report.section import GelShape


@dataclass(frozen=True, slots=True, eq=False)
class ObservedEpisode:
    """The recording at `path`, and the rig to normalise it with."""

    path: Path
    episode: Episode
    rig: RigConfig | None  # with which it was recorded; None if unknown

    @property
    def canonical(self) -> CanonicalGrid:
        return CanonicalGrid() if self.rig is None else self.rig.canonical

    def steps(self) -> Iterator[tuple[Step, Observation]]:
        """Yields each step with the observation after it; one step is in memory at a time.

        Raises EpisodeError for a step that lacks a frame or an arm or cannot be read; ValueError and
        calibration.errors.CalibrationError for a frame that cannot be normalised.
        """
        spec = self.episode.meta.spec
        normalisers: dict[str, Normaliser] = {}
        for step in self.episode.steps:
            lacking = [*(set(spec.sensors) - set(step.frames)), *(set(spec.arms) - set(step.arms))]
            if lacking:
                raise EpisodeError(f"{self.path}: step {step.index} has no data of '{sorted(lacking)[0]}'")
            frames = {name: step.frames[name] for name in spec.sensors}
            if not normalisers:
                normalisers = {name: self._normaliser(name, frame) for name, frame in frames.items()}
            tactile = {name: normalisers[name](frame, step.time) for name, frame in frames.items()}
            arms = {name: step.arms[name] for name in spec.arms}
            grippers = {name: step.grippers[name] for name in spec.grippers}
            yield step, Observation(tactile, arms, step.time, grippers)

    def _normaliser(self, name: str, first: TactileFrame) -> Normaliser:
        """With the episode's reference image, or else with the first frame as reference."""
        config = ReplaySensorConfig(driver="replay", source=str(self.path))
        with error_context(f"{self.path}: sensor '{name}'"):
            reference = reference_image(self.episode.meta.attachments, name)
            untouched = first if reference is None else TactileFrame(reference, time=first.time, index=first.index)
            normaliser = sensor_part(config, name, self.canonical).normaliser(untouched.image)
            normaliser.take_reference(untouched)
        return normaliser


class RecordedSurfaces:
    """Surfaces of an episode's gels, called with sensor and frame: the frame's own surface, or one that the sensor's
    normaliser in the episode's rig estimates from the image; None if neither exists.

    Frames of a sensor may be skipped, but not go back in time. `notes`: texts about what a sensor lacks. `gels`: the
    shape of each simulated gel.
    """

    def __init__(self, meta: EpisodeMeta) -> None:
        """Raises EpisodeError for a reference image that cannot be read. An unreadable rig file is noted in `notes`."""
        self._normalisers: dict[str, Normaliser] = {}
        self.notes: list[str] = []
        self.gels: dict[str, GelShape] = {}
        try:
            rig = rig_of(meta)
        except ConfigError as why:
            first = why.problems[0]
            text = f"{first.key}: {first.text}" if first.key else first.text
            self.notes.append(f"its rig file does not fit this tacsim ({text}), so only what was recorded is shown")
            return
        if rig is None:
            return
        if rig.scene is not None:
            self.gels = {
                name: GelShape(rig.scene.gel_of(name).size, rig.canonical.pitch, spec.arm)
                for name, spec in meta.spec.sensors.items()
                if spec.arm is not None
            }
        for name, sensor in rig.sensors.items():
            untouched = reference_image(meta.attachments, name)
            if untouched is None or sensor.is_simulated or name not in meta.spec.sensors:
                continue
            try:
                normaliser = sensor_of(rig, name).normaliser(untouched)
                if normaliser.finds_height or normaliser.finds_flow:
                    normaliser.take_reference(TactileFrame(untouched, time=0.0, index=0))
                    self._normalisers[name] = normaliser
                    self.notes += _describe_untrusted_calibration(sensor, name)
                    visible_size: tuple[float, float] | None = getattr(normaliser, "visible_size", None)
                    if visible_size is not None and sensor.sensor_model is None:
                        self.notes += _describe_partial_maps(name, visible_size, rig.canonical)
                elif not meta.spec.sensors[name].height:
                    self.notes += _describe_printed_dots(untouched, name)
            except (CalibrationError, ValueError) as why:
                self.notes.append(f"sensor {name}: no height is shown: {why}")

    def __call__(self, sensor: str, frame: TactileFrame) -> SurfaceMap | TactileObservation | None:
        normalise = self._normalisers.get(sensor)
        if frame.surface is not None or normalise is None:
            return frame.surface
        try:
            return normalise(frame, frame.time)
        except (StaleReference, TooFewMarkers, ValueError):  # the steps report it
            return None


def _describe_untrusted_calibration(sensor: SensorConfig, name: str) -> list[str]:
    """A note about a calibration whose own verdict is not to trust it."""
    path = sensor.bundle
    if path is None or not read_sensor_model(Path(path)).caution:
        return []
    return [
        f"sensor {name}: the verdict on {path} is 'do not trust', so do not trust its heights; see verdict.html there"
    ]


def _describe_partial_maps(name: str, visible_size: tuple[float, float], grid: CanonicalGrid) -> list[str]:
    """A note about maps that are smaller than the visible part `visible_size` of the gel (x, y) [m]."""
    maps = grid.columns * grid.pitch, grid.rows * grid.pitch
    more = [
        f"--set canonical.{key}={2 * math.ceil(there / grid.pitch / 2 - 1e-6)}"
        for key, there, mapped in zip(("columns", "rows"), visible_size, maps, strict=True)
        if there > mapped + grid.pitch
    ]
    if not more:
        return []
    middle, whole = (
        " x ".join(f"{length * 1e3:.3g}" for length in size)
        for size in ((min(maps[0], visible_size[0]), min(maps[1], visible_size[1])), visible_size)
    )
    words = f"maps show the middle {middle} mm of {whole} mm of gel; for all of it: tacsim run ... {' '.join(more)}"
    return [f"sensor {name}: {words}"]


def _describe_printed_dots(untouched: NDArray[np.uint8], sensor: str) -> list[str]:
    """A note about printed dots, if the image shows dots and the rig file gives no marker pitch."""
    try:
        lattice, _ = find_markers(untouched)
    except NoLattice:
        return []
    rows, columns = lattice.present.shape
    return [
        f"sensor {sensor} shows {rows} x {columns} dark dots: give their distance, "
        f"--set 'sensors.{sensor}.marker_pitch=1.5 mm', and tactile flow is measured by them; for height calibrate the "
        "sensor with --markers"
    ]


def observe_episode(path: Path) -> ObservedEpisode:
    """The episode in a file, on the canonical grid with which it was recorded. Raises EpisodeError, ConfigError."""
    return ObservedEpisode(path, read_episode(path), recorded_rig(path))
