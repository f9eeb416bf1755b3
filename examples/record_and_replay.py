"""Record an episode in one MCAP file, read it, and replay it through the same observation.

python examples/record_and_replay.py
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from robot import EpisodeSetup, open_rig, run_episode
from tacsim import Observation, Recorder, load_rig, make_task, read_episode

STEPS = 3


def record(path: Path) -> list[Observation]:
    """Runs the scripted squeeze and records it. Returns what the policy observed."""
    loaded = load_rig("sim", overrides=["scene.preset=learn"])
    task = make_task(loaded.config.task)
    seen: list[Observation] = []
    setup = EpisodeSetup(policy="scripted", attachments={"rig.yaml": loaded.text.encode()})
    with ExitStack() as stack:
        run_episode(
            *(stack.enter_context(open_rig(loaded)), task.scripted(), task, STEPS),
            setup=setup,
            recorder=lambda meta: stack.enter_context(Recorder(path, meta)),
            watch=lambda step, observation, truth: seen.append(observation),
        )
    return seen


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mcap"
        live = record(path)
        episode = read_episode(path)
        print(f"{path.stat().st_size / 1e3:.0f} kB, {len(episode.steps)} steps, complete: {episode.complete}")
        parts = {"arms": "driver: replay", "sensors": "driver: replay, arm: upper"}
        lines = [f"{key}: {{upper: {{{what}, source: '{path}'}}}}" for key, what in parts.items()]
        rig_file = Path(folder) / "replay.yaml"
        rig_file.write_text("\n".join(["name: replay", "clock: replay", *lines]))
        with open_rig(rig_file) as rig:
            again = rig.reset()

    if not episode.complete or len(episode.steps) != STEPS + 1:
        sys.exit(f"the recording has {len(episode.steps)} steps, not {STEPS + 1}, or is not complete")
    for name in ("image", "height", "contact"):
        if not np.array_equal(getattr(live[0].tactile["upper"], name), getattr(again.tactile["upper"], name)):
            sys.exit(f"the replayed {name} differs from the one that was observed live")


if __name__ == "__main__":
    main()
