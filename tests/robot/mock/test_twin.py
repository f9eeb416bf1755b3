"""The simulated bench's process: what goes over the wire, and how it fails."""

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
from robot.mock.cell.sim_server import LARGEST, Twin, TwinError, read_message, write_message
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


def stand_in(monkeypatch: pytest.MonkeyPatch, act: str) -> Twin:
    """A twin whose process does `act` when it is asked to move."""
    code = STAND_IN.replace("    act()", f"    {act}")
    start = subprocess.Popen

    def other(command: list[str], **options: object) -> subprocess.Popen[bytes]:
        return start([sys.executable, "-c", code], **options)  # type: ignore[call-overload,no-any-return]

    monkeypatch.setattr(twins.subprocess, "Popen", other)
    config = load_rig("mock", overrides=SMALL).config
    assert config.scene is not None
    return Twin(config.scene, {}, config.canonical)


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
    with stand_in(monkeypatch, act) as twin, pytest.raises(TwinError, match=words):
        twin.move({})


def test_a_process_that_says_nothing_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(monkeypatch, "time.sleep(600)") as twin:
        monkeypatch.setattr(twins, "PATIENCE", 0.2)
        with pytest.raises(TwinError, match=r"no answer within 0\.2 s"):
            twin.move({})
        assert twin._process.returncode is not None


def test_after_ctrl_c_no_old_answer_is_taken_for_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    with stand_in(monkeypatch, "time.sleep(1.0); write_message(sys.stdout.buffer, {'error': 'an old answer'})") as twin:
        hit = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
        hit.start()
        with pytest.raises(KeyboardInterrupt):
            twin.move({})
        hit.join()
        with pytest.raises(TwinError, match="is closed; open the rig anew"):
            twin.move({})


# -- the true process ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config() -> RigConfig:
    return load_rig("mock", overrides=SMALL).config


@pytest.fixture(scope="module")
def twin(config: RigConfig) -> Iterator[Twin]:
    assert config.scene is not None
    models = {
        name: sensor.model
        for name, sensor in config.sensors.items()
        if not isinstance(sensor, SimSensorConfig) and sensor.model is not None  # type: ignore[union-attr]
    }
    with Twin(config.scene, models, config.canonical) as running:
        yield running


def closer(twin: Twin, way: float) -> dict[str, Pose]:
    """Both sensors moved along their own z [m]."""
    signs = {"lower": 1.0, "upper": -1.0}
    return {
        name: Pose(pose.position + [0, 0, signs[name] * way], pose.quaternion) for name, pose in twin.initial.items()
    }


def touching(twin: Twin) -> float:
    """How far both must come from their start until they touch [m]: half of what is between gels and body."""
    return 0.5 * (twin.initial["upper"].position[2] - twin.initial["lower"].position[2] - 4e-3)


def test_a_bench_answers_with_pictures_surfaces_forces_and_truth(twin: Twin, config: RigConfig) -> None:
    clear = twin.place(twin.initial)
    assert set(clear.images) == set(clear.surfaces) == set(clear.wrenches) == {"lower", "upper"}
    assert clear.images["upper"].shape == (30, 40, 3)
    assert clear.surfaces["upper"].height.shape == (16, 16)
    assert max(float(np.abs(wrench).max()) for wrench in clear.wrenches.values()) < 0.05
    pressed = twin.move(closer(twin, touching(twin) + 0.1e-3))
    assert pressed.index == clear.index + 1 and pressed.time > clear.time
    assert all(wrench[2] < -0.05 for wrench in pressed.wrenches.values())  # the object pushes back
    assert float(pressed.surfaces["upper"].height.max()) > 20e-6
    assert clear.truth is not None and pressed.truth is not None
    assert pressed.truth.height < clear.truth.height
    fresh = twin.place(twin.initial)
    assert fresh.truth is not None and fresh.truth.height == pytest.approx(clear.truth.height)


def test_what_cannot_be_done_is_said_and_the_bench_goes_on(twin: Twin) -> None:
    twin.place(twin.initial)
    with pytest.raises(TwinError, match=r"simulated bench: .*third"):
        twin.move({**twin.initial, "third": Pose()})
    assert np.isfinite(twin.place(twin.initial).wrenches["upper"]).all()


def test_ctrl_c_is_for_the_parent(twin: Twin) -> None:
    """A terminal sends it to all; the bench must not die in the middle of an episode that ends in order."""
    os.kill(twin.pid, signal.SIGINT)
    assert twin.place(twin.initial).truth is not None


def test_a_killed_process_is_a_twin_error_and_closing_stays_harmless(twin: Twin) -> None:
    """The last test of this process."""
    os.kill(twin.pid, signal.SIGKILL)
    with pytest.raises(TwinError, match=rf"process {twin.pid}.*open the rig anew"):
        twin.move(twin.initial)
    twin.close()


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
