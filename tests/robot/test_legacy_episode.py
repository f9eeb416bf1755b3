"""Files of earlier versions: an episode that version 0.1.0 recorded, three steps of squeezing in the simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot import open_rig
from tacsim import Action, EndOfEpisode, read_episode, write_report
from tacsim.report.report import summary
from tacsim.report.series import Series

EPISODE = Path(__file__).resolve().parent.parent / "fixtures/episode_0_1_0.mcap"


def test_an_earlier_episode_is_read_and_reported(tmp_path: Path) -> None:
    episode = read_episode(EPISODE)
    assert (episode.meta.rig, episode.meta.task, episode.meta.goal, episode.complete) == ("sim", "squeeze", 3e-3, True)
    assert [step.arms["upper"].wrench[2] for step in episode.steps] == pytest.approx(
        [-0.0547, -0.2690, -0.4913, -0.5929], abs=1e-4
    )
    assert [step.distance for step in episode.steps] == pytest.approx(
        [0.979e-3, 0.904e-3, 0.829e-3, 0.711e-3], abs=1e-6
    )
    stats = summary(Series.of(episode))
    assert stats["contact_signal"]["upper"] == pytest.approx([0.0407, 0.0741, 0.0933], abs=1e-4)
    assert stats["versions"]["tacsim"] == "0.1.0"
    assert all(path.stat().st_size for path in write_report(episode, tmp_path).values())


def test_an_earlier_episode_is_replayed_as_it_was_observed(tmp_path: Path) -> None:
    """Through the rig file that was recorded with it: pictures are normalised anew, with the height found then."""
    rig_file = tmp_path / "rig.yaml"
    parts = {"arms": "{{driver: replay, source: '{0}'}}", "sensors": "{{driver: replay, source: '{0}', arm: {1}}}"}
    lines = ["name: r", "clock: replay", "canonical: {rows: 32, columns: 32, pitch: 0.5 mm}"]
    for part, text in parts.items():
        lines += [f"{part}:", *(f"  {name}: {text.format(EPISODE, name)}" for name in ("lower", "upper"))]
    rig_file.write_text("\n".join(lines) + "\n")
    recorded = read_episode(EPISODE).steps
    with open_rig(rig_file) as rig:
        seen = [rig.reset(), *(rig.step(Action())[0] for _ in recorded[1:])]
        with pytest.raises(EndOfEpisode):
            rig.step(Action())
    for observation, step in zip(seen, recorded, strict=True):
        for name, touch in observation.tactile.items():
            np.testing.assert_array_equal(observation.arms[name].wrench, step.arms[name].wrench)
            assert touch.height is not None and touch.flow is not None
            surface = step.frames[name].surface
            assert surface is not None
            np.testing.assert_array_equal(touch.height, surface.height)
    assert [int(observation.tactile["upper"].contact.sum()) for observation in seen] == [0, 100, 124, 132]
