"""The simulated cell's process: what it answers, and how it fails."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import numpy as np
import pytest

from robot.mock.cell.sim_server import SimServer, SimServerError
from tacsim.config import load_rig
from tacsim.interface import Pose
from tacsim.models.rig import RigConfig, SimSensorConfig

SMALL = [
    "canonical.rows=16",
    "canonical.columns=16",
    "canonical.pitch=0.5 mm",
    "scene.body.geometry.size=[4 mm, 4 mm, 4 mm]",
    "scene.gel.size=[8 mm, 8 mm, 2 mm]",
    *(
        f"sensors.{name}.model.geometry.{key}={value}"
        for name in ("lower", "upper")
        for key, value in (("width", 40), ("height", 30), ("pixel_pitch", "0.2 mm"))
    ),
]


@pytest.fixture(scope="module")
def config() -> RigConfig:
    return load_rig("mock", overrides=SMALL).config


@pytest.fixture(scope="module")
def sim_server(config: RigConfig) -> Iterator[SimServer]:
    assert config.scene is not None
    models = {
        name: sensor.model
        for name, sensor in config.sensors.items()
        if not isinstance(sensor, SimSensorConfig) and sensor.model is not None  # type: ignore[union-attr]
    }
    with SimServer(config.scene, models, config.canonical) as running:
        yield running


def closer(sim_server: SimServer, path_length: float) -> dict[str, Pose]:
    """Both sensors moved along their own z [m]."""
    signs = {"lower": 1.0, "upper": -1.0}
    return {
        name: Pose(pose.position + [0, 0, signs[name] * path_length], pose.quaternion)
        for name, pose in sim_server.initial.items()
    }


def touching(sim_server: SimServer) -> float:
    """How far both must come from their start until they touch [m]: half of what is between gels and body."""
    return 0.5 * (sim_server.initial["upper"].position[2] - sim_server.initial["lower"].position[2] - 4e-3)


@pytest.mark.slow
def test_sim_server_returns_images_surfaces_forces_and_truth(sim_server: SimServer, config: RigConfig) -> None:
    clear = sim_server.place(sim_server.initial)
    assert set(clear.images) == set(clear.surfaces) == set(clear.wrenches) == {"lower", "upper"}
    assert clear.images["upper"].shape == (30, 40, 3)
    assert clear.surfaces["upper"].height.shape == (16, 16)
    assert max(float(np.abs(wrench).max()) for wrench in clear.wrenches.values()) < 0.05
    pressed = sim_server.move(closer(sim_server, touching(sim_server) + 0.1e-3))
    assert pressed.index == clear.index + 1 and pressed.time > clear.time
    assert all(wrench[2] < -0.05 for wrench in pressed.wrenches.values())  # the object pushes back
    assert float(pressed.surfaces["upper"].height.max()) > 20e-6
    assert clear.truth is not None and pressed.truth is not None
    assert pressed.truth.height < clear.truth.height
    fresh = sim_server.place(sim_server.initial)
    assert fresh.truth is not None and fresh.truth.height == pytest.approx(clear.truth.height)


def test_sim_server_refused_motion_keeps_cell_running(sim_server: SimServer) -> None:
    sim_server.place(sim_server.initial)
    with pytest.raises(SimServerError, match=r"simulated cell: .*third"):
        sim_server.move({**sim_server.initial, "third": Pose()})
    assert np.isfinite(sim_server.place(sim_server.initial).wrenches["upper"]).all()


def test_killed_sim_server_is_reported_and_closes(sim_server: SimServer) -> None:
    """The last test of this process."""
    os.kill(sim_server.pid, signal.SIGKILL)
    with pytest.raises(SimServerError, match=rf"process {sim_server.pid}.*open the rig again"):
        sim_server.move(sim_server.initial)
    sim_server.close()
