"""A whole rig with one camera whose gel has printed dots: from the file over HTTP to flow, record and report."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibration.reference import UnusableReference
from robot.deploy.control_loop import run_episode
from robot.fixtures import mock_host
from robot.mock import MockCamera
from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import Action, Observation
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder
from tacsim.report.report import summarise, summary_table
from tacsim.report.series import Series, sensor_diagnostics
from tacsim.rig import Rig
from tacsim.tasks.squeeze import Grip
from tests.tacsim.optics.surfaces import dent, flat

RIG = """
name: marked
clock: wall
period: 50 ms
sensors:
  finger:
    {{ driver: camera, source: '{source}', width: 320, height: 240, fps: 60, max_age: 10 s, model: ideal-markers,
       size: [20 mm, 15 mm] }}
"""
PATIENCE = 60.0  # [s]


class Gel:
    """What stands before the camera."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "marked.yaml"
        self.camera = MockCamera(mock_host(71), fps=60.0, quality=95, stamped=False)
        self.path.write_text(RIG.format(source=self.camera.url))
        config = load_rig(self.path).config.sensors["finger"]
        assert isinstance(config, CameraSensorConfig) and config.model is not None
        self.model: SensorModel = config.model
        self._draw = Renderer(self.model, config.size)
        self.show(flat())

    def show(self, surface: GelSurface) -> None:
        self.camera.push(self._draw(surface))


@pytest.fixture(scope="module")
def gel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gel]:
    made = Gel(tmp_path_factory.mktemp("marked"))
    yield made
    made.camera.close()


@pytest.fixture
def rig(gel: Gel) -> Iterator[Rig]:
    gel.camera.brightness(1.0)
    gel.show(flat())
    time.sleep(0.1)  # so no picture of the previous test is in transit
    with open_rig(gel.path) as opened:
        yield opened


def seen(rig: Rig, wanted) -> Observation:  # type: ignore[no-untyped-def]
    """The first observation for which `wanted` is true; a picture takes some frames to arrive."""
    deadline = time.monotonic() + PATIENCE
    while True:
        observation, _ = rig.step(Action())
        if wanted(observation.tactile["finger"]):
            return observation
        assert time.monotonic() < deadline, "not seen"


def test_marked_camera_spec_promises_flow(gel: Gel, rig: Rig) -> None:
    spec = rig.spec.sensors["finger"]
    assert spec.flow and spec.height
    first = rig.reset().tactile["finger"]
    assert first.flow is not None and first.flow.shape == (9, 11, 2) and first.flow.dtype == np.float32
    assert np.abs(first.flow).max() < 20e-6
    told = rig.diagnostics()
    assert told["stale_finger"] == 0.0 and told["kept_finger"] == 1.0 and told["background_finger"] < 0.5

    slid = dent(depth=0.3e-3, slide=(0.3e-3, -0.2e-3))
    gel.show(slid)
    touch = seen(rig, lambda touch: touch.height.max() > 0.2e-3).tactile["finger"]
    true = surface_map(slid, load_rig(gel.path).config.canonical, gel.model.markers)
    assert true.flow is not None and np.abs(true.flow).max() > 0.15e-3
    dots = rig.normalisers["finger"].visible_markers  # type: ignore[attr-defined]
    assert dots.mean() > 0.9
    off = np.linalg.norm(touch.flow - true.flow, axis=-1)[dots]
    assert np.median(off) < 15e-6 and off.max() < 80e-6
    assert float(touch.height.max()) == pytest.approx(0.3e-3, rel=0.1)

    gel.show(flat())
    back = seen(rig, lambda touch: touch.height.max() < 50e-6).tactile["finger"]
    assert np.abs(back.flow).max() < 20e-6


def test_marked_camera_fading_light_is_recorded(gel: Gel, rig: Rig, tmp_path: Path) -> None:
    gel.show(flat())
    recorders: list[Recorder] = []

    def fade(step) -> None:  # type: ignore[no-untyped-def]
        if step.index == 2:
            gel.camera.brightness(0.8)
            time.sleep(0.3)

    episode = run_episode(
        rig, Grip(rig.spec), None, 6, on_step=fade,
        recorder=lambda meta: recorders.append(Recorder(tmp_path / "e.mcap", meta)) or recorders[0],  # type: ignore[func-returns-value]
    )  # fmt: skip
    recorders[0].close()
    told = sensor_diagnostics(Series.from_episode(read_episode(tmp_path / "e.mcap")))
    assert told is not None and told == sensor_diagnostics(Series.from_episode(episode))
    assert 1 <= told["finger"]["stale"] < told["finger"]["steps"] == 7
    assert told["finger"]["drift"] == pytest.approx(0.2, abs=0.03)
    shown = [str(cell) for cell in summary_table(summarise(Series.from_episode(episode)), []).columns[1].cells]
    assert any(cell.startswith("finger: stale reference in") for cell in shown)


def test_marked_camera_dots_unlike_model_raise(gel: Gel) -> None:
    gel.camera.brightness(1.0)
    gel.show(flat())
    time.sleep(0.1)
    plain = SensorModel()
    with (
        open_rig(gel.path, overrides=["sensors.finger.model=ideal"]) as rig,
        pytest.raises(UnusableReference, match=r"dots|markers"),
    ):
        rig.reset()
    gel.camera.push(Renderer(plain, (20e-3, 15e-3))(flat()))
    time.sleep(0.1)
    with open_rig(gel.path) as rig, pytest.raises(UnusableReference, match="not a lattice of 9 x 11 dots"):
        rig.reset()
