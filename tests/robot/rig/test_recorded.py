"""A recording is seen as the rig saw it that made it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot.rig.parts import sensor_of
from robot.rig.recorded import observe_episode
from tacsim.config import load_rig
from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.images import reference_attachments
from tacsim.record.writer import Recorder


def test_recorded_camera_images_use_their_own_model(tmp_path: Path) -> None:
    """Heights and all, as on the rig; before, a recording of hardware was seen as a whole picture, without heights."""
    loaded = load_rig("mock")
    camera = loaded.config.sensors["upper"]
    assert isinstance(camera, CameraSensorConfig) and camera.model is not None
    rows, columns = camera.height, camera.width
    across = np.linspace(-1.0, 1.0, columns) ** 2 + np.linspace(-1.0, 1.0, rows)[:, None] ** 2
    untouched = np.full((rows, columns, 3), 120, np.uint8)
    pressed = untouched + (40 * np.exp(-20 * across)[..., None] * (1.0, -0.5, 0.2)).astype(np.uint8)
    frames = [TactileFrame(image, time=0.1 * k, index=k) for k, image in enumerate((untouched, pressed))]
    spec = RigSpec({"upper": SensorSpec((rows, columns), height=True, flow=False, arm=None)}, (), False, 0.1)
    attachments = {"rig.yaml": loaded.text.encode(), **reference_attachments({"upper": frames[0]})}
    path = tmp_path / "e.mcap"
    with Recorder(path, EpisodeMeta("mock", None, "p", 0, spec, {}, attachments)) as recorder:
        for frame in frames:
            recorder.write(Step(frame.index, frame.time, {"upper": frame}, {}))
    own = sensor_of(loaded.config, "upper").normaliser()
    own.take_reference(frames[0])
    for frame, (_, observation) in zip(frames, observe_episode(path).steps(), strict=True):
        wanted, found = own(frame, frame.time), observation.tactile["upper"]
        assert wanted.height is not None and found.height is not None
        assert np.array_equal(wanted.height, found.height) and np.array_equal(wanted.image, found.image)
    assert np.ptp(found.height) > 0.0
