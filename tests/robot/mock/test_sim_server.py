"""The simulated cell's process: what goes over the wire, and how it fails."""

from __future__ import annotations

import io
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.mock.cell import sim_server as twins
from robot.mock.cell.sim_server import LARGEST, SimServer, SimServerError, read_message, write_message
from tacsim.config import load_rig
from tacsim.interface import Pose
from tacsim.models.rig import RigConfig, SimSensorConfig

PATIENCE = 60.0  # for anything that has to happen [s]
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

# -- messages --------------------------------------------------------------------------------------------------------


def message(said: dict[str, object], arrays: dict[str, np.ndarray] | None = None) -> bytes:
    pipe = io.BytesIO()
    write_message(pipe, said, arrays)
    return pipe.getvalue()


def test_a_message_comes_back_as_it_was() -> None:
    arrays = {
        "image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        "turned": np.arange(6.0).reshape(2, 3).T,  # not contiguous
        "none": np.zeros((0, 3), np.float32),
    }
    pipe = io.BytesIO(message({"do": "move", "x": [1, 2.5]}, arrays) + message({"second": True}))
    found = read_message(pipe)
    assert found is not None
    said, back = found
    assert said == {"do": "move", "x": [1, 2.5]}
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    assert read_message(pipe) == ({"second": True}, {})
    assert read_message(pipe) is None


def test_a_message_that_is_cut_off_is_the_end_wherever_it_is_cut() -> None:
    whole = message({"do": "move"}, {"a": np.ones(5)})
    assert all(read_message(io.BytesIO(whole[:length])) is None for length in range(len(whole)))
    assert read_message(io.BytesIO(whole)) is not None


def framed(text: bytes, body: bytes = b"") -> io.BytesIO:
    return io.BytesIO(struct.pack(">II", len(text), len(body)) + text + body)


@pytest.mark.parametrize(
    "pipe",
    [
        io.BytesIO(struct.pack(">II", LARGEST, 1)),  # nothing of that size is read
        framed(b"\xff\xfe"),
        framed(b"[1, 2"),
        framed(b"[1, 2]"),
        framed(b"{}"),
        framed(b'{"arrays": [["a", "<f8", [2]]]}', bytes(8)),
        framed(b'{"arrays": [["a", "no such type", [2]]]}', bytes(16)),
        framed(b'{"arrays": [["a", "|O", [1]]]}', bytes(8)),
        framed(b'{"arrays": [["a"]]}'),
    ],
)
def test_what_is_no_message_is_a_value_error(pipe: io.BytesIO) -> None:
    with pytest.raises(ValueError):
        read_message(pipe)


# -- the handle, against a stand-in process --------------------------------------------------------------------------

STAND_IN = """
import json, os, signal, sys, time
from robot.mock.cell.sim_server import read_message, write_message
while (message := read_message(sys.stdin.buffer)) is not None:
    said, _ = message
    if said["do"] == "open":
        write_message(sys.stdout.buffer, {"poses": {}})
        continue
    act()
"""


def stand_in(monkeypatch: pytest.MonkeyPatch, act: str) -> SimServer:
    """A twin whose process does `act` when it is asked to move."""
    code = STAND_IN.replace("    act()", f"    {act}")
    start = subprocess.Popen

    def other(command: list[str], **options: object) -> subprocess.Popen[bytes]:
        return start([sys.executable, "-c", code], **options)  # type: ignore[call-overload,no-any-return]

    monkeypatch.setattr(twins.subprocess, "Popen", other)
    config = load_rig("mock", overrides=SMALL).config
    assert config.scene is not None
    return SimServer(config.scene, {}, config.canonical)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ("sys.exit(7)", r"ended with 7.*open the rig anew"),
        ("sys.stdout.buffer.write(b'x' * 8); sys.stdout.buffer.flush()", r"the limit is \d+"),
        (
            "write_message(sys.stdout.buffer, {'error': 'SimulationDiverged: so and so'})",
            "SimulationDiverged: so and so",
        ),
        ("os.close(1); time.sleep(600)", "cannot be asked"),  # closed its end, but lives on
    ],
)
def test_what_goes_wrong_there_is_a_twin_error_here(monkeypatch: pytest.MonkeyPatch, act: str, words: str) -> None:
    with stand_in(monkeypatch, act) as sim_server, pytest.raises(SimServerError, match=words):
        sim_server.move({})


def test_a_process_that_says_nothing_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(monkeypatch, "time.sleep(600)") as sim_server:
        monkeypatch.setattr(twins, "PATIENCE", 0.2)
        with pytest.raises(SimServerError, match=r"no answer within 0\.2 s"):
            sim_server.move({})
        assert sim_server._process.returncode is not None


def test_after_ctrl_c_no_old_answer_is_taken_for_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(
        monkeypatch, "time.sleep(1.0); write_message(sys.stdout.buffer, {'error': 'an old answer'})"
    ) as sim_server:
        hit = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
        hit.start()
        with pytest.raises(KeyboardInterrupt):
            sim_server.move({})
        hit.join()
        with pytest.raises(SimServerError, match="is closed; open the rig anew"):
            sim_server.move({})


# -- the true process ------------------------------------------------------------------------------------------------


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


def closer(sim_server: SimServer, way: float) -> dict[str, Pose]:
    """Both sensors moved along their own z [m]."""
    signs = {"lower": 1.0, "upper": -1.0}
    return {
        name: Pose(pose.position + [0, 0, signs[name] * way], pose.quaternion)
        for name, pose in sim_server.initial.items()
    }


def touching(sim_server: SimServer) -> float:
    """How far both must come from their start until they touch [m]: half of what is between gels and body."""
    return 0.5 * (sim_server.initial["upper"].position[2] - sim_server.initial["lower"].position[2] - 4e-3)


def test_a_bench_answers_with_pictures_surfaces_forces_and_truth(sim_server: SimServer, config: RigConfig) -> None:
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


def test_what_cannot_be_done_is_said_and_the_bench_goes_on(sim_server: SimServer) -> None:
    sim_server.place(sim_server.initial)
    with pytest.raises(SimServerError, match=r"simulated cell: .*third"):
        sim_server.move({**sim_server.initial, "third": Pose()})
    assert np.isfinite(sim_server.place(sim_server.initial).wrenches["upper"]).all()


def test_ctrl_c_is_for_the_parent(sim_server: SimServer) -> None:
    """A terminal sends it to all; the cell must not die in the middle of an episode that ends in order."""
    os.kill(sim_server.pid, signal.SIGINT)
    assert sim_server.place(sim_server.initial).truth is not None


def test_a_killed_process_is_a_twin_error_and_closing_stays_harmless(sim_server: SimServer) -> None:
    """The last test of this process."""
    os.kill(sim_server.pid, signal.SIGKILL)
    with pytest.raises(SimServerError, match=rf"process {sim_server.pid}.*open the rig anew"):
        sim_server.move(sim_server.initial)
    sim_server.close()


def until(done: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s"
        time.sleep(0.02)


def test_the_process_ends_with_its_parent() -> None:
    """Its standard input ends; nothing else tells it."""
    code = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-m', 'robot.mock.cell.sim_server'], stdin=subprocess.PIPE)\n"
        "print(child.pid, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(json.loads(parent.stdout.readline()))
        parent.kill()

    def gone() -> bool:
        try:
            os.kill(child, 0)
            return Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except (ProcessLookupError, FileNotFoundError):
            return True

    until(gone, "the end of the process")
