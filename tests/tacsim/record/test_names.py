"""Names and texts in a recording are bounded before anything draws or prints them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.interface import Action
from tacsim.models.task import unit_of
from tacsim.models.text import MAX_NAME, check_name
from tacsim.record import schemas
from tacsim.record.episode import EpisodeError, EpisodeMeta, Step
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder
from tacsim.report.figure import MAX_GOAL, goal_text

LONG = "x" * 20_000


def renamed(parts: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {name if key == "upper" else key: value for key, value in parts.items()}


def with_name(meta: EpisodeMeta, step: Step, part: str, name: str) -> tuple[EpisodeMeta, Step]:
    """The sensor, arm or attachment of another name."""
    spec = meta.spec
    if part == "attachment":
        return replace(meta, attachments={name: b"text"}), step
    if part == "sensor":
        step = replace(step, frames=renamed(step.frames, name))
        return replace(meta, spec=replace(spec, sensors=renamed(spec.sensors, name))), step
    action = None if step.action is None else Action(renamed(step.action.tool, name))
    step = replace(step, arms=renamed(step.arms, name), sent=renamed(step.sent, name), action=action)
    sensors = {key: replace(each, arm=name if each.arm == "upper" else each.arm) for key, each in spec.sensors.items()}
    arms = tuple(name if arm == "upper" else arm for arm in spec.arms)
    return replace(meta, spec=replace(spec, arms=arms, sensors=sensors)), step


@pytest.mark.parametrize("part", ["sensor", "arm", "attachment"])
def test_a_name_without_measure_is_refused_by_recorder_and_reader(
    part: str, tmp_path: Path, meta: EpisodeMeta, make_step: Callable[[int], Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report of it took minutes: every letter is drawn, in many plots."""
    changed, step = with_name(meta, make_step(0), part, LONG)
    with pytest.raises(ValueError, match=f"the {part} name 'x{{20}} ... x{{20}}' has 20000 characters, at most"):
        Recorder(tmp_path / "refused.mcap", changed)
    with monkeypatch.context() as other:
        other.setattr(schemas, "_check_parts", lambda *_: None)  # a program that is not ours
        with Recorder(tmp_path / "foreign.mcap", changed) as recorder:
            recorder.write(step)
    with pytest.raises(EpisodeError, match=f"the {part} name .* has 20000 characters") as caught:
        read_episode(tmp_path / "foreign.mcap")
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("part", ["sensor", "arm"])
def test_the_longest_name_that_is_allowed_is_recorded_and_read(
    part: str, tmp_path: Path, meta: EpisodeMeta, make_step: Callable[[int], Step]
) -> None:
    name = "x" * MAX_NAME
    changed, step = with_name(meta, make_step(0), part, name)
    with Recorder(tmp_path / "episode.mcap", changed) as recorder:
        recorder.write(step)
    (read,) = read_episode(tmp_path / "episode.mcap").steps
    assert name in (read.frames if part == "sensor" else read.arms)


def test_other_texts_are_shortened(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[[int], Step]) -> None:
    changed = replace(meta, rig=LONG, task=LONG, policy=LONG, versions={LONG: LONG})
    with Recorder(tmp_path / "episode.mcap", changed) as recorder:
        recorder.write(make_step(0))
    read = read_episode(tmp_path / "episode.mcap").meta
    texts = [read.rig, read.task or "", read.policy, *read.versions, *read.versions.values()]
    assert len(texts) == 5 and all(0 < len(text) < 1000 for text in texts)


def test_too_many_parts_are_refused(tmp_path: Path, meta: EpisodeMeta) -> None:
    many = {f"file{number}": b"" for number in range(schemas.MAX_FILES + 1)}
    with pytest.raises(ValueError, match="more than 1000 attachments"):
        Recorder(tmp_path / "episode.mcap", replace(meta, attachments=many))


def test_names_and_goals() -> None:
    check_name("x" * MAX_NAME, "sensor")
    with pytest.raises(ValueError, match=r"the sensor name 'a\\x1b' holds control characters"):
        check_name("a\x1b", "sensor")
    assert goal_text((1e-3,) * 3) == "(1.00, 1.00, 1.00) mm"
    assert goal_text(np.pi / 6, unit_of("turn")) == "30.00 °" and goal_text(1.25, unit_of("hold")) == "125.00 %"
    assert goal_text((1e-3,) * 100_000) == f"({', '.join(['1.00'] * MAX_GOAL)}, ...) mm"
