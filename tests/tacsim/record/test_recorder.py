"""The recorder never blocks the control loop and keeps what it flushed: kill, full queue, full disk, wrong step."""

from __future__ import annotations

import errno
import io
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tacsim.interface import SurfaceMap, TactileFrame
from tacsim.record import writer
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder

KILLED = """
import sys, time
import numpy as np
from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.writer import Recorder

spec = RigSpec(sensors={"lower": SensorSpec((48, 64), False, False, None)}, arms=(), truth=False, period=0.1)
meta = EpisodeMeta("rig", None, "none", 0, spec, {}, {"rig.yaml": b"name: rig"})
recorder = Recorder(sys.argv[1], meta)
rng = np.random.default_rng(0)
for k in range(100000):
    image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    image[0, 0] = k % 256
    recorder.write(Step(index=k, time=0.1 * k, frames={"lower": TactileFrame(image, time=0.1 * k, index=k)}, arms={}))
    assert recorder.flush()
    print(k, flush=True)
"""


@pytest.mark.promise(14)
def test_every_flushed_step_survives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        printed = [int(process.stdout.readline()) for _ in range(25)]
        process.kill()
        printed += [int(line) for line in process.stdout.read().splitlines()]
    assert process.returncode == -9
    episode = read_episode(path)
    assert not episode.complete
    assert len(episode.steps) >= len(printed) >= 25
    assert [step.index for step in episode.steps[: len(printed)]] == printed
    assert all((step.frames["lower"].image[0, 0] == step.index % 256).all() for step in episode.steps)
    assert episode.meta.attachments == {"rig.yaml": b"name: rig"}


def test_an_existing_file_is_refused(tmp_path: Path, meta: EpisodeMeta) -> None:
    (tmp_path / "e.mcap").write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        Recorder(tmp_path / "e.mcap", meta)
    assert (tmp_path / "e.mcap").read_bytes() == b"mine"


def test_a_full_queue_drops_whole_steps_and_counts_them(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, busy = threading.Event(), threading.Event()
    encode = writer.encode_step

    def slow(step: Step, pitch: float, offset: int):  # type: ignore[no-untyped-def]
        busy.set()
        assert gate.wait(10)
        return encode(step, pitch, offset)

    monkeypatch.setattr(writer, "encode_step", slow)
    with Recorder(tmp_path / "e.mcap", meta, capacity=2) as recorder:
        assert recorder.write(make_step(0))
        assert busy.wait(10)  # the first is in work, two may wait
        steps = [make_step(k) for k in range(1, 6)]
        start = time.perf_counter()
        assert [recorder.write(step) for step in steps] == [True, True, False, False, False]
        assert time.perf_counter() - start < 0.5  # no waiting, on however busy a machine
        assert recorder.dropped == 3
        assert not recorder.flush(timeout=0.01)
        gate.set()
        assert recorder.flush()
        assert recorder.write(make_step(6))
    episode = read_episode(tmp_path / "e.mcap")
    assert [step.index for step in episode.steps] == [0, 1, 2, 6]
    assert episode.dropped == recorder.dropped == 3
    assert episode.complete
    with pytest.raises(ValueError, match="is closed"):
        recorder.write(make_step(7))


class FullDisk(io.FileIO):
    """A file on a disk with room for `room` bytes."""

    room = 0

    def write(self, data: bytes) -> int:  # type: ignore[override]
        if self.tell() >= self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = super().write(bytes(data)[: self.room - self.tell()])
        assert written is not None
        return written


@pytest.mark.parametrize("into_step", [0, 1, 500])
def test_a_full_disk_ends_the_recording_cleanly(
    tmp_path: Path,
    meta: EpisodeMeta,
    make_step: Callable[..., Step],
    monkeypatch: pytest.MonkeyPatch,
    into_step: int,
) -> None:
    disk = FullDisk(str(tmp_path / "e.mcap"), "xb")
    disk.room = 10**9
    monkeypatch.setattr(writer, "open_new_file", lambda path: io.BufferedWriter(disk))
    recorder = Recorder(tmp_path / "e.mcap", meta)
    for k in range(3):
        recorder.write(make_step(k))
    assert recorder.flush()
    disk.room = disk.tell() + into_step
    recorder.write(make_step(3))
    assert recorder.flush()
    assert isinstance(recorder.error, OSError)
    assert recorder.error.errno == errno.ENOSPC
    assert recorder.write(make_step(4)) is False
    assert (recorder.written, recorder.dropped) == (3, 2)
    recorder.close()
    recorder.close()
    assert disk.closed
    episode = read_episode(tmp_path / "e.mcap")
    assert [step.index for step in episode.steps] == [0, 1, 2]
    assert not episode.complete


def test_a_disk_that_fills_while_closing(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = FullDisk(str(tmp_path / "e.mcap"), "xb")
    disk.room = 10**9
    monkeypatch.setattr(writer, "open_new_file", lambda path: io.BufferedWriter(disk))
    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        recorder.write(make_step(0))
        assert recorder.flush()
        disk.room = disk.tell() + 10
    assert isinstance(recorder.error, OSError)
    episode = read_episode(tmp_path / "e.mcap")
    assert len(episode.steps) == 1
    assert not episode.complete


def test_a_disk_that_is_full_from_the_start_leaves_nothing(
    tmp_path: Path, meta: EpisodeMeta, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "open_new_file", lambda path: io.BufferedWriter(FullDisk(str(path), "xb")))
    with pytest.raises(OSError, match="No space left"):
        Recorder(tmp_path / "e.mcap", meta)
    assert list(tmp_path.iterdir()) == []


def test_a_step_that_cannot_be_encoded_ends_the_recording(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    grey = TactileFrame(np.zeros((4, 4), np.uint8), time=0.0, index=0)
    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        recorder.write(make_step(0))
        recorder.write(replace(make_step(1), frames={"lower": grey}))
        assert recorder.flush()
        assert "(H, W, 3) uint8 RGB" in str(recorder.error)
        assert recorder.write(make_step(2)) is False
    episode = read_episode(tmp_path / "e.mcap")
    assert [step.index for step in episode.steps] == [0]
    assert episode.dropped == 2


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (SurfaceMap(np.zeros((4, 4)), np.zeros((4, 4, 2)), None), "float32"),  # type: ignore[arg-type]
        (SurfaceMap(np.zeros((4, 4), np.float32), np.zeros((4, 5, 2), np.float32), None), "belong together"),
        (SurfaceMap(np.zeros((4, 0), np.float32), np.zeros((4, 0, 2), np.float32), None), "float32 maps"),
    ],
)
def test_a_surface_that_would_lose_something_is_refused(surface: SurfaceMap, message: str) -> None:
    frame = TactileFrame(np.zeros((4, 4, 3), np.uint8), time=0.0, index=0, surface=surface)
    with pytest.raises(ValueError, match=message):
        writer.encode_step(Step(index=0, time=0.0, frames={"lower": frame}, arms={}), 1e-3)


def test_an_attachment_beyond_the_limit_is_refused(tmp_path: Path, meta: EpisodeMeta) -> None:
    with pytest.raises(ValueError, match=r"attachment 'big' has 67108865 bytes"):
        Recorder(tmp_path / "e.mcap", replace(meta, attachments={"big": bytes((64 << 20) + 1)}))
    assert list(tmp_path.iterdir()) == []


def test_handing_over_a_step_is_cheap(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> None:
    steps = [make_step(k, image=(240, 320), grid=(64, 64)) for k in range(10)]
    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        cost = []
        for step in steps:
            start = time.thread_time()
            recorder.write(step)
            cost.append(time.thread_time() - start)
    assert recorder.written == 10
    assert np.median(cost) < 1e-3
