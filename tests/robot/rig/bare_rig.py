"""Rigs of hardware over mocks, for tests: opened with the cell behind them, and what they leave.

BARE is two arms and two cameras with nothing simulated before them, which opens in a second.
"""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import robot.mock.cell.cell
from robot.deploy.control_loop import EpisodeFailed, run_episode
from robot.fixtures import mock_host
from robot.mock.camera.camera import MockCamera
from robot.mock.cell.cell import MockCell
from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import Action, Needs, Observation
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

BARE = """
name: bare
clock: wall
period: 50 ms
arms:
  LEFT:
    driver: ur
    host: 127.0.0.2
    world_from_base: { position: [-450 mm, 0, -300 mm] }
    limits:
      workspace: { lower: [-30 mm, -30 mm, -30 mm], upper: [30 mm, 30 mm, 60 mm] }
      acceleration: 2 m/s^2
    start: { position: [0, 0, 0] }
    link_timeout: 2 s
    watchdog: 0.4
    mock: {}
  RIGHT:
    driver: ur
    host: 127.0.0.3
    world_from_base: { position: [450 mm, 0, -300 mm], rotation: [0, 0, 180 deg] }
    limits:
      workspace: { lower: [-30 mm, -30 mm, -30 mm], upper: [30 mm, 30 mm, 60 mm] }
      acceleration: 2 m/s^2
    start: { position: [0, 0, 30 mm], rotation: [180 deg, 0, 0] }
    link_timeout: 2 s
    watchdog: 0.4
    mock: {}
keep_out:
  - { arms: [LEFT, RIGHT], distance: 20 mm }
canonical: { rows: 32, columns: 32, pitch: 0.5 mm }
sensors:
  LEFT:
    { driver: camera, source: 'http://127.0.0.2:8081/?action=stream', arm: LEFT, width: 80, height: 60, stamped: true,
      max_age: 1 s }
  RIGHT:
    { driver: camera, source: 'http://127.0.0.3:8081/?action=stream', arm: RIGHT, width: 80, height: 60, stamped: true,
      max_age: 1 s }
"""
GREY = np.full((60, 80, 3), 120, np.uint8)


class Opened:
    """A rig, the cell behind it, and the cameras next to the cell."""

    def __init__(self, rig: Rig, cell: MockCell, cameras: dict[str, MockCamera]) -> None:
        self.rig, self.cell, self.cameras = rig, cell, cameras

    def received(self, since: dict[str, int] | None = None) -> dict[str, list[int]]:
        """Numbers of the commands that reached each controller."""
        since = dict.fromkeys(self.cell.faults, 0) if since is None else since
        return {
            name: [int(each.values.get("input_int_register_0", 0)) for each in faults.received(since[name]).entries]  # type: ignore[arg-type]
            for name, faults in self.cell.faults.items()
        }

    def now(self) -> dict[str, int]:
        return {name: faults.received().last for name, faults in self.cell.faults.items()}


@contextlib.contextmanager
def cameras_of(config: RigConfig) -> Iterator[dict[str, MockCamera]]:
    """Cameras for the sensors that ask for none, with a grey picture."""
    with contextlib.ExitStack() as stack:
        found: dict[str, MockCamera] = {}
        for name, sensor in config.sensors.items():
            if isinstance(sensor, CameraSensorConfig) and sensor.mock is None:
                host = sensor.source.split("/")[2].partition(":")[0]
                found[name] = stack.enter_context(MockCamera(host, 8081, 80, 60))
                found[name].push(GREY)
        yield found


@contextlib.contextmanager
def opened(
    rig: Path | str,
    *overrides: str,
    dry_run: bool = False,
    link_timeout: float = 20.0,
    action_timeout: float = 5.0,
) -> Iterator[Opened]:
    """No time-out of the arms depends on how busy the machine is; `link_timeout` [s] is long for the same reason."""
    config = load_rig(rig, overrides=overrides).config
    patient = {
        "watchdog": 0.05,
        "action_timeout": action_timeout,
        "observation_timeout": 60.0,
    }  # model_copy does not validate
    slow = {"link_timeout": link_timeout, **patient}
    config = config.model_copy(
        update={"arms": {name: arm.model_copy(update=slow) for name, arm in config.arms.items()}}
    )
    cells: list[MockCell] = []

    class Kept(MockCell):
        def __init__(self, config: RigConfig) -> None:
            super().__init__(config)
            cells.append(self)

    with cameras_of(config) as cameras:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(robot.mock.cell.cell, "MockCell", Kept)
            made = open_rig(config, dry_run=dry_run)
        with made:
            yield Opened(made, cells[0], cameras)


def bare_file(folder: Path, first: int = 41) -> Path:
    """Two arms and cameras at addresses of this process, from number `first` on. Those of the shared rig are called
    left and right; others, which may be open at the same time, west and east."""
    left, right = ("left", "right") if first == 41 else ("west", "east")
    text = (
        BARE.replace("LEFT", left)
        .replace("RIGHT", right)
        .replace("127.0.0.2", mock_host(first))
        .replace("127.0.0.3", mock_host(first + 1))
    )
    file = folder / "bare.yaml"
    file.write_text(text)
    return file


class After:
    """A policy that holds, and does something before its n-th step."""

    needs = Needs()

    def __init__(self, steps: int, act: Callable[[], object]) -> None:
        self._left, self._act = steps, act

    def reset(self) -> None: ...

    def __call__(self, observation: Observation) -> Action:
        self._left -= 1
        if self._left == 0:
            self._act()
        return Action({name: arm.pose for name, arm in observation.arms.items()})


def failing(rig: Rig, act: Callable[[], object]) -> EpisodeFailed:
    """Runs an episode in which `act` happens before the third step; what ended it."""
    with pytest.raises(EpisodeFailed) as failed:
        run_episode(rig, After(3, act), None, 400)
    return failed.value


def belongings() -> tuple[int, int, int]:
    """Processes of ours, sockets of ours, shared memory of ours."""
    own = str(os.getpid())
    children = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            children += stat.read_text().rpartition(")")[2].split()[1] == own
    gc.collect()
    sockets = memory = 0
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            sockets += str(link.readlink()).startswith("socket:")
            memory += str(link.readlink()).startswith("/memfd:tacsim")
    return children, sockets, memory


needs_proc = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts by /proc")
