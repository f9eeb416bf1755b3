"""Recordings that were cut off or damaged become files that the official reader takes, with every whole step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import MCAP0_MAGIC

from tacsim.record import recover as module
from tacsim.record.episode import EpisodeError, EpisodeMeta, Step
from tacsim.record.reader import read_episode
from tacsim.record.recover import Recovery, recover_recording
from tacsim.record.writer import Recorder

STEPS = 5


@pytest.fixture
def whole(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> Path:
    """An episode of five small steps, with packages of an arm."""
    with Recorder(tmp_path / "whole.mcap", replace(meta, attachments={"a.yaml": b"a: 1", "b.yaml": b"b: 2"})) as file:
        for k in range(STEPS):
            step = make_step(k, image=(6, 6), grid=(2, 2), packages=k == 2)
            file.write(replace(step, frames={"lower": step.frames["lower"]}))
    return tmp_path / "whole.mcap"


def official(path: Path) -> dict[int, list[tuple[str, Message]]]:
    """What the official reader finds by the index, checksums and statistics checked: messages by the index of their
    step, which the time of a step tells."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        found: dict[int, list[tuple[str, Message]]] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            found.setdefault(message.sequence, []).append((channel.topic, message))
        assert summary.statistics.message_count == sum(len(each) for each in found.values())
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == len(found)
        assert all(topic in {channel.topic for channel in summary.channels.values()} for topic, _ in found.get(0, []))
        assert [each.name for each in reader.iter_metadata()][-1:] in ([], ["tacsim.close"])
        list(reader.iter_attachments())
    return found


def content(messages: list[tuple[str, Message]]) -> list[tuple[str, int, int, bytes]]:
    return [(topic, each.log_time, each.publish_time, each.data) for topic, each in messages]


def recovered(data: bytes, folder: Path) -> tuple[Recovery, Path] | None:
    """The file made of `data`, which must stay as it is; None where nothing can be recovered."""
    (folder / "x.mcap").write_bytes(data)
    target = folder / "y.mcap"
    target.unlink(missing_ok=True)
    try:
        found = recover_recording(folder / "x.mcap", target)
    except EpisodeError:
        assert not target.exists()
        return None
    finally:
        assert (folder / "x.mcap").read_bytes() == data
        assert not list(folder.glob(".*.part"))
    return found, target


@pytest.mark.slow
def test_a_cut_anywhere_keeps_every_whole_step(whole: Path, tmp_path: Path) -> None:
    data, steps = whole.read_bytes(), official(whole)
    counts = []
    for length in [*range(0, len(data), 397), len(data) - 1]:
        made = recovered(data[:length], tmp_path)
        if made is None:
            continue
        found, target = made
        assert not found.is_whole and not found.finished
        kept = official(target)
        assert [content(each) for each in kept.values()] == [content(steps[k]) for k in range(found.steps)]
        episode = read_episode(target)
        assert len(episode.steps) == found.steps and not episode.complete
        (tmp_path / "x.mcap").write_bytes(data[:length])
        if not any("attachment" in words for words in found.missing):
            assert len(read_episode(tmp_path / "x.mcap").steps) == found.steps
        again = recover_recording(target, tmp_path / "z.mcap")
        assert again.is_whole and again.steps == found.steps and not (tmp_path / "z.mcap").exists()
        counts.append(found.steps)
    assert counts == sorted(counts) and set(counts) == set(range(STEPS + 1))


@pytest.mark.slow
def test_changed_bytes_cost_their_own_step_alone(whole: Path, tmp_path: Path) -> None:
    data, steps = whole.read_bytes(), official(whole)
    rng = np.random.default_rng(0)
    all_steps = {repr(content(each)) for each in steps.values()}
    counts = []
    for place in range(8, len(data), 211):
        damaged = bytearray(data)
        damaged[place] ^= int(rng.integers(1, 256))
        made = recovered(bytes(damaged), tmp_path)
        assert made is not None
        found, target = made
        if found.is_whole:  # in an index of one chunk, which has no checksum and which nobody needs
            assert found.steps == STEPS and not target.exists()
            continue
        kept = [repr(content(each)) for each in official(target).values()]
        assert set(kept) <= all_steps and len(kept) == len(set(kept)) == found.steps
        counts.append(found.steps)
        if not any("metadata" in words for words in found.missing):
            assert len(read_episode(target).steps) == found.steps
    assert set(counts) == {STEPS - 1, STEPS}  # the definitions of topics stand in the first step, and in the index


def test_the_first_step_defines_the_topics(whole: Path, tmp_path: Path) -> None:
    """In a file without index, damage in it costs the others only where it meets the definitions."""
    data = whole.read_bytes()
    cut = bytearray(data[: data.index(b"tacsim.close")])
    assert b"PNG" in cut and b"/lower/flow" in cut
    for word, steps in ((b"PNG", STEPS - 1), (b"/lower/flow", 0)):
        damaged = cut.copy()
        damaged[cut.index(word) - 2] ^= 0xFF  # of the topic: the size of its name
        made = recovered(bytes(damaged), tmp_path)
        assert made is not None and made[0].steps == steps
        assert any("topics" in words for words in made[0].missing) == (steps == 0)


def test_garbage_in_the_middle_leaves_the_steps_around_it(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    rng = np.random.default_rng(1)
    begin = len(data) * 2 // 3
    for damaged in (
        data[:begin] + rng.bytes(500) + data[begin:],
        data[:begin] + data[begin + 500 :],
        data[:begin] + bytes(500) + data[begin + 500 :],
    ):
        made = recovered(damaged, tmp_path)
        assert made is not None and made[0].steps >= STEPS - 2
        assert not made[0].is_whole
        steps = read_episode(made[1]).steps
        assert [step.index for step in steps] == sorted({step.index for step in steps}) and steps[0].index == 0


def test_a_damaged_attachment_costs_itself_alone(whole: Path, tmp_path: Path) -> None:
    made = recovered(whole.read_bytes().replace(b"b: 2", b"b: 3", 1), tmp_path)
    assert made is not None
    found, target = made
    assert found.missing == ["the attachment 'b.yaml'"]
    episode = read_episode(target)
    assert dict(episode.meta.attachments) == {"a.yaml": b"a: 1"} and len(episode.steps) == STEPS


def test_recover_reports_intact_and_empty_files(whole: Path, tmp_path: Path) -> None:
    found = recover_recording(whole, whole)
    assert found.is_whole and found.steps == STEPS
    for data, words in (
        (b"", "is empty"),
        (b"hello world", "not an MCAP file"),
        (MCAP0_MAGIC, "nothing in it can be recovered"),
        (MCAP0_MAGIC + b"\x06" * 500, "nothing in it can be recovered"),
    ):
        (tmp_path / "x.mcap").write_bytes(data)
        with pytest.raises(EpisodeError, match=words):
            recover_recording(tmp_path / "x.mcap", tmp_path / "y.mcap")
    with pytest.raises(EpisodeError, match="no such file"):
        recover_recording(tmp_path / "none.mcap", tmp_path / "y.mcap")


def test_nothing_is_overwritten_and_nothing_half_is_left(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = whole.read_bytes()[:-100]
    whole.write_bytes(before)
    with pytest.raises(FileExistsError):
        recover_recording(whole, whole)
    with pytest.raises(OSError) as caught:
        recover_recording(whole, tmp_path / "none" / "y.mcap")
    assert "none" in str(caught.value.filename)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        recover_recording(whole, tmp_path / "y.mcap")
    assert caught.value.filename == str(tmp_path / "y.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mcap"] and whole.read_bytes() == before
