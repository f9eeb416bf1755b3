"""Rigs of hardware over mocks: what reaches the wire, what is refused, what happens when a part dies.

Most tests use two arms and two cameras with nothing simulated before them (BARE), which open in a second; one rig is
shared by them, and each test leaves it as it found it.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import robot.rig.hardware_rig
import robot.rig.reset
from robot.arm.shared_ring import FOLDER
from robot.arm.time_alignment import NotAligned
from robot.camera.camera import StaleFrame
from robot.deploy.control_loop import EpisodeFailed, run_episode
from robot.errors import DeviceError, DeviceNotConnectedError, EmergencyStop, LinkLost, ProtectiveStop, SafetyViolation
from robot.mock.camera.camera import MockCamera
from robot.mock.cell.cell import MockCell
from robot.mock.fixtures import mock_host, rig_addresses
from robot.open import open_rig
from robot.rig.commanded_arm import CommandedArm
from robot.rig.reset import NotConfirmed
from tacsim.config import ConfigError, load_rig
from tacsim.control.approach import NoTouch
from tacsim.interface import Action, ArmState, Needs, Observation, Pose
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

PATIENCE = 20.0  # for anything that has to happen [s]
SERVOJ = 11
MOTIONS = {1, 2, 3, 4, 6, 9, 10, 11, 12, 18, 24, 25, 41, 45, 51, 52, 66}  # of the library: all that move an arm
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
    """A rig, the cell behind it, and the cameras that stand beside the cell."""

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
def opened(rig: Path | str, *overrides: str, dry_run: bool = False, link_timeout: float = 20.0) -> Iterator[Opened]:
    """No time-out of the arms depends on how busy the machine is; `link_timeout` [s] is long for the same reason."""
    config = load_rig(rig, overrides=overrides).config
    patient = {"watchdog": 0.05, "action_timeout": 5.0, "observation_timeout": 60.0}  # model_copy does not validate
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
            patch.setattr(robot.rig.hardware_rig, "MockCell", Kept)
            made = open_rig(config, dry_run=dry_run)
        with made:
            yield Opened(made, cells[0], cameras)


def bare_file(folder: Path, first: int = 41) -> Path:
    """Two arms and cameras at addresses of this process, from number `first` on. Those of the shared rig are called
    left and right; others, which may be open beside it, west and east."""
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


@pytest.fixture(scope="module", autouse=True)
def no_pause() -> Iterator[None]:
    """Mock arms do not shake: nothing has to come to rest before their forces are zeroed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot.rig.reset, "PAUSE", 0.02)
        yield


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    with opened(bare_file(tmp_path_factory.mktemp("bare"))) as found:
        yield found


@pytest.fixture
def bare(shared: Opened) -> Opened:
    shared.rig.reset()
    return shared


def until(done: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s"
        time.sleep(5e-3)


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


# -- steps ---------------------------------------------------------------------------------------------------------


def test_an_arm_goes_where_the_step_says(bare: Opened) -> None:
    observation = bare.rig.observe()
    start = observation.arms["right"].pose
    target = Pose(start.position + [1e-3, 0.0, 0.0], start.quaternion)
    since = bare.now()
    _, sent = bare.rig.step(Action({"right": target}))
    assert sent["right"] is not None and sent["right"].position == pytest.approx(target.position)
    assert sent["left"] is None
    for _ in range(40):
        observation, _ = bare.rig.step(Action({"right": target}))
    assert observation.arms["right"].pose.position == pytest.approx(target.position, abs=50e-6)
    assert SERVOJ in bare.received(since)["right"]
    assert observation.arms["left"].pose.position == pytest.approx([0, 0, 0], abs=50e-6)


def test_arms_never_come_nearer_than_the_keep_out(bare: Opened) -> None:
    """Both are asked to meet in the middle."""
    arms = bare.rig.observe().arms
    middle = np.array([0.0, 0.0, 15e-3])
    towards = Action({name: Pose(middle, arm.pose.quaternion) for name, arm in arms.items()})
    gaps = []
    for _ in range(12):
        try:
            observation, sent = bare.rig.step(towards)
        except SafetyViolation as stopped:
            pytest.fail(f"the guard that comes before the stop did not hold: {stopped}")
        places = {name: arm.pose.position for name, arm in observation.arms.items()}
        gaps.append(float(np.linalg.norm(places["right"] - places["left"])))
        assert all(pose is not None and np.abs(pose.position - middle).max() > 1e-3 for pose in sent.values())
    assert min(gaps) > 19.9e-3  # to the arm's own precision
    assert gaps[-1] < 29e-3  # they did go as far as they may


def test_arms_are_told_what_is_seen_from_the_first_observation_on(bare: Opened) -> None:
    channels = [arm.driver._channel for arm in bare.rig.arms.values()]  # type: ignore[attr-defined]
    observation, _ = bare.rig.step(Action())
    oldest = min(touch.time for touch in observation.tactile.values())
    shown = [channel.tactile.latest() for channel in channels]
    assert [float(touch["exposed"]) for touch in shown] == [oldest, oldest]
    assert all(np.isnan(touch["depth"]) for touch in shown)  # grey pictures tell of no height
    bare.rig._reset.clear(0)
    assert all(np.isnan(channel.tactile.latest()["exposed"]) for channel in channels)


def test_a_start_aside_is_drawn_from_the_seed(shared: Opened) -> None:
    reset = shared.rig._reset
    shared.rig._reset._placement = 2e-3  # type: ignore[attr-defined]
    try:
        places = [shared.rig.reset(seed).arms["left"].pose.position for seed in (1, 1, 2)]
    finally:
        reset._placement = 0.0  # type: ignore[attr-defined]
    assert places[0] == pytest.approx(places[1], abs=20e-6)
    assert float(np.abs(places[0] - places[2]).max()) > 50e-6
    assert float(np.abs(places).max()) <= 2e-3 + 20e-6


@pytest.mark.parametrize(("link_timeout", "lost"), [(2.0, False), (0.05, True)])
def test_a_gap_between_packages_is_a_lost_link_only_beyond_its_time_out(link_timeout: float, lost: bool) -> None:
    now = time.monotonic()
    zero = np.zeros(6)
    states = [
        ArmState(Pose(np.array([x, 0.0, 0.0])), zero, zero, zero, now - ago) for x, ago in ((0.0, 0.3), (3e-3, 0.0))
    ]
    stub = SimpleNamespace(
        name="left",
        config=SimpleNamespace(link_timeout=link_timeout),
        state=lambda: states[-1],
        history=lambda number: states,
    )
    arm = CommandedArm(stub)  # type: ignore[arg-type]
    if lost:
        with pytest.raises(NotAligned, match="was the link lost"):
            arm.state(now - 0.1)
    else:
        assert arm.state(now - 0.1).pose.position == pytest.approx([2e-3, 0, 0])
        assert arm.alignment == pytest.approx(0.1)


# -- what stops it ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stop", "error", "words"),
    [
        ("estop", EmergencyStop, "a person must release it"),
        ("protective_stop", ProtectiveStop, r"made a protective stop; look why, then recover\(\)"),
    ],
)
def test_a_stop_ends_the_episode_keeps_it_and_waits_for_recover(
    shared: Opened, stop: str, error: type[DeviceError], words: str
) -> None:
    upper, lower = shared.rig.arms["right"], shared.rig.arms["left"]
    faults = shared.cell.faults["right"]
    failed = failing(shared.rig, getattr(faults, stop))
    try:
        # Either arm may be asked first: the one that stopped, or the one that stopped because the other did.
        assert isinstance(failed.__cause__, error | SafetyViolation)
        assert len(failed.episode.steps) >= 3
        with pytest.raises(error, match=words):
            upper.command(None)
        until(lambda: _refuses(lower, SafetyViolation), "the other arm's stop")
        with pytest.raises(DeviceError):
            shared.rig.reset()  # nothing begins anew by itself
        if stop == "estop":
            with pytest.raises(EmergencyStop, match="must release it"):
                upper.recover()  # type: ignore[attr-defined]
    finally:
        faults.recover()
        upper.recover()  # type: ignore[attr-defined]
        lower.recover()  # type: ignore[attr-defined]
    shared.rig.reset()
    shared.rig.step(Action())


def _refuses(arm: object, error: type[DeviceError]) -> bool:
    try:
        arm.command(None)  # type: ignore[attr-defined]
    except error:
        return True
    return False


def test_a_camera_that_stalls_ends_the_episode(shared: Opened) -> None:
    camera = shared.cameras["right"]
    try:
        failed = failing(shared.rig, lambda: camera.stall(True))
    finally:
        camera.stall(False)
    assert isinstance(failed.__cause__, StaleFrame)
    assert "sensor 'right'" in str(failed) and "ms old, limit 1000 ms" in str(failed)
    assert len(failed.episode.steps) >= 3
    shared.rig.reset()


def test_ctrl_c_in_a_reset_leaves_arms_that_rest(shared: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody goes on asking them; the next reset begins anew."""
    waited = robot.rig.reset.wait_for_arrival

    def interrupted(arms: Mapping[str, CommandedArm], timeout: float) -> None:
        os.kill(os.getpid(), signal.SIGINT)  # while they retreat
        waited(arms, timeout)

    monkeypatch.setattr(robot.rig.reset, "wait_for_arrival", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shared.rig.reset()
    monkeypatch.setattr(robot.rig.reset, "wait_for_arrival", waited)
    until(lambda: all(faults.state().rests for faults in shared.cell.faults.values()), "rest")
    shared.rig.reset()


def test_without_a_yes_nothing_approaches(shared: Opened) -> None:
    reset = shared.rig._reset
    asked: list[float] = []
    before = reset._confirm  # type: ignore[attr-defined]
    reset._confirm = lambda: bool(asked.append(time.monotonic()))  # type: ignore[attr-defined]
    try:
        with pytest.raises(NotConfirmed, match="nothing approaches"):
            shared.rig.reset()
    finally:
        reset._confirm = before  # type: ignore[attr-defined]
    assert len(asked) == 1
    assert shared.rig.observe().arms["right"].pose.position == pytest.approx([0, 0, 30e-3], abs=50e-6)


# -- what is refused -------------------------------------------------------------------------------------------------


def test_a_rig_without_limits_is_refused_by_its_file(tmp_path: Path) -> None:
    file = bare_file(tmp_path)
    text = file.read_text()
    start, end = text.index("    limits:"), text.index("    start:")
    file.write_text(text[:start] + text[end:])
    with pytest.raises(ConfigError, match=r"(?s)bare\.yaml:\d+.*limits"):
        open_rig(file)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("arms.east.host=192.0.2.1", "192.0.2.1 is not a loopback address"),
        ("arms.east.mock=null", "'east' is a real one, but its host .* is this machine"),
        ("arms.east.start=null", "arms.east.start"),
        ("arms.east.start.position=[3, 0, 0]", "out of reach"),
        ("sensors.east.width=100", "sensor 'east'.*expected are 100 x"),
    ],
)
def test_what_makes_no_rig_is_refused_and_leaves_nothing(tmp_path: Path, override: str, words: str) -> None:
    overrides = [override, *["arms.east.watchdog=10"] * override.endswith("mock=null")]
    file = bare_file(tmp_path, first=61)
    with cameras_of(load_rig(file).config):
        before = belongings()
        with pytest.raises((DeviceError, ValueError), match=words):
            open_rig(file, overrides=overrides)
        until(lambda: belongings() == before, "what was started is gone")


def test_a_second_rig_at_the_same_addresses_is_refused(shared: Opened, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="in use"):
        open_rig(bare_file(tmp_path))
    shared.rig.reset()  # the first one goes on


def test_a_dry_run_sends_no_motion(tmp_path: Path) -> None:
    with opened(bare_file(tmp_path, first=51), dry_run=True) as dry:
        observation = dry.rig.reset()
        pose = observation.arms["east"].pose
        for _ in range(3):
            observation, sent = dry.rig.step(Action({"east": Pose(pose.position + [0, 0, 1e-3], pose.quaternion)}))
            assert sent == {"west": None, "east": None}
        dry.rig.stop()
        assert observation.arms["east"].pose.position == pytest.approx(pose.position, abs=1e-6)
        received = dry.received()
    for name, commands in received.items():
        assert len(commands) > 3, f"arm '{name}' was not even connected"
        assert not MOTIONS & set(commands)


# -- closing ---------------------------------------------------------------------------------------------------------


def belongings() -> tuple[int, int, int]:
    """Processes of ours, sockets of ours, shared memory of ours."""
    own = str(os.getpid())
    children = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            children += stat.read_text().rpartition(")")[2].split()[1] == own
    sockets = 0
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            sockets += str(link.readlink()).startswith("socket:")
    return children, sockets, len(list(FOLDER.glob(f"*-{own}-*")))


needs_proc = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts by /proc")


@needs_proc
def test_closing_leaves_nothing_and_may_be_done_twice(tmp_path: Path) -> None:
    file = bare_file(tmp_path, first=53)
    with cameras_of(load_rig(file).config):
        before = belongings()
        rig = open_rig(file)
        there = belongings()
        assert there[0] == before[0] + 3  # two workers and the controllers
        assert there[2] == before[2] + 2
        rig.close()
        until(lambda: belongings() == before, "all is given back")
    rig.close()
    with pytest.raises(DeviceNotConnectedError, match="closed"):
        rig.arms["east"].command(None)


def one_killed(folder: Path, first: int, victim: Callable[[Opened], int]) -> EpisodeFailed:
    with opened(bare_file(folder, first), link_timeout=6.0) as found:
        failed = failing(found.rig, lambda: os.kill(victim(found), signal.SIGKILL))
        with contextlib.suppress(DeviceError, ExceptionGroup):
            found.rig.stop()
    return failed


@needs_proc
@pytest.mark.deep
@pytest.mark.parametrize(
    ("victim", "errors", "words"),
    [
        (lambda found: found.cell._controllers.pid, (LinkLost, DeviceNotConnectedError, DeviceError), "arm '"),
        (lambda found: found.rig.arms["east"].driver._worker.pid, (DeviceError,), "worker|the other arm did"),
        (lambda found: found.cameras["west"].pid, (StaleFrame,), "sensor 'west'"),
    ],
    ids=["controllers", "worker", "camera"],
)
def test_a_part_that_is_killed_ends_the_episode_in_clear_words(
    tmp_path: Path, victim: Callable[[Opened], int], errors: tuple[type[Exception], ...], words: str
) -> None:
    before = belongings()
    failed = one_killed(tmp_path, 55, victim)
    assert isinstance(failed.__cause__, errors)
    assert re.search(words, str(failed)), str(failed)
    assert len(failed.episode.steps) >= 3
    until(lambda: belongings() == before, "all is given back")


def runs(pid: int) -> bool:
    """False for a process that is gone, or that only nobody has asked after yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@needs_proc
@pytest.mark.deep
def test_mocks_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time; from robot.open import open_rig\n"
        "rig = open_rig(sys.argv[1]); print('open', flush=True); time.sleep(600)"
    )
    file = bare_file(tmp_path, 57)
    words = [sys.executable, "-c", code, str(file)]
    with cameras_of(load_rig(file).config), subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "open\n"
        family = [
            int(stat.parent.name)
            for stat in Path("/proc").glob("[0-9]*/stat")
            if stat.read_text().rpartition(")")[2].split()[1] == str(process.pid)
        ]
        assert len(family) == 3  # two workers and the controllers
        process.kill()
    until(lambda: not any(runs(pid) for pid in family), "all mocks and workers have ended")


# -- with the simulated cell ----------------------------------------------------------------------------------------

SMALL = [f"canonical.{key}={value}" for key, value in (("rows", 32), ("columns", 32), ("pitch", "0.5 mm"))]
for _name in ("lower", "upper"):
    SMALL += [f"sensors.{_name}.{side}={pixels}" for side, pixels in (("width", 80), ("height", 60))]
    SMALL += [
        f"sensors.{_name}.model.geometry.{key}={value}"
        for key, value in (("width", 80), ("height", 60), ("pixel_pitch", "0.1 mm"))
    ]
TINY = ["scene.body.geometry.size=[4 mm, 4 mm, 4 mm]", "scene.gel.size=[8 mm, 8 mm, 2 mm]"]


@pytest.fixture(scope="module")
def loaded() -> Iterator[Opened]:
    """A task whose upper arm holds a load."""
    reposition = ["task=reposition", "task.touch_force=0.3 N", "task.loads={upper: 0.6 N}"]
    with opened("mock", *SMALL, *TINY, *reposition, *rig_addresses(), "start.approach_step=0.2 mm") as found:
        yield found


@pytest.fixture
def simulated(loaded: Opened, monkeypatch: pytest.MonkeyPatch) -> Opened:
    """The same rig without the load."""
    monkeypatch.setattr(loaded.rig, "_admittance", None)
    return loaded


def test_arms_of_a_mock_rig_hold_the_loads_of_their_task(loaded: Opened) -> None:
    start = loaded.rig.reset().arms["upper"].pose
    for count in range(1, 7):
        asked = Pose(start.position + [count * 0.05e-3, 0.0, 0.0], start.quaternion)
        observation, _ = loaded.rig.step(Action({"upper": asked}))
    arm = observation.arms["upper"]
    assert -arm.wrench[2] == pytest.approx(0.6, rel=0.05)
    assert arm.pose.position[0] - start.position[0] == pytest.approx(0.3e-3, abs=10e-6)


def test_a_mock_rig_begins_in_gentle_touch_and_knows_the_truth(simulated: Opened) -> None:
    rig = simulated.rig
    observation = rig.reset()
    forces = [-arm.wrench[2] for arm in observation.arms.values()]
    assert min(forces) > 0.3  # task.touch_force [N]
    assert max(forces) < 10.0
    assert all(touch.height is not None for touch in observation.tactile.values())
    before = rig.truth()
    arms = observation.arms
    closer = Action(
        {name: Pose(arm.pose.position + [0, 0, 0.1e-3 * sign], arm.pose.quaternion)
         for (name, arm), sign in zip(arms.items(), (1, -1), strict=True)}
    )  # fmt: skip
    observation, sent = rig.step(closer)
    after = rig.truth()
    assert before is not None and after is not None and after.height < before.height
    for name, pose in sent.items():
        assert pose is not None
        assert observation.arms[name].pose.position == pytest.approx(pose.position, abs=5e-6)


def test_no_touch_on_all_the_way_ends_at_the_start(simulated: Opened) -> None:
    reset = simulated.rig._reset
    config = reset._config  # type: ignore[attr-defined]
    reset._config = config.model_copy(update={"approach_distance": 0.1e-3})  # type: ignore[attr-defined]
    try:
        with pytest.raises(NoTouch, match=r"no touch after an approach of 0\.\d mm.*back at their start"):
            simulated.rig.reset()
    finally:
        reset._config = config  # type: ignore[attr-defined]
    for name, pose in simulated.cell.start_poses.items():
        assert simulated.rig.arms[name].state().pose.position == pytest.approx(pose.position, abs=50e-6)


@pytest.mark.deep
def test_a_killed_simulator_ends_the_episode(simulated: Opened) -> None:
    """The last test of this rig."""
    sim_server = simulated.cell._sim_server
    assert sim_server is not None
    failed = failing(simulated.rig, lambda: os.kill(sim_server.pid, signal.SIGKILL))
    assert "simulated cell" in str(failed) and "open the rig anew" in str(failed)
    assert len(failed.episode.steps) >= 3
    until(lambda: all(faults.state().rests for faults in simulated.cell.faults.values()), "rest")
