"""Play recorded pictures of a real sensor through the same rig and policy as the simulation. Nothing moves.

    python examples/play_frames.py

The pictures are drawn here; put your own folder or video in their place.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from robot import load_policy, open_rig
from tacsim import EndOfEpisode, contact_signal

FORCES = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]  # one a picture [N]


def draw_frames(folder: Path) -> None:
    """Pictures of a gel that is pressed harder and harder, and the gripper's forces in a table."""
    v, u = np.mgrid[:240, :320]
    for number, force in enumerate(FORCES):
        dent = 8 * force * np.exp(-((u - 160) ** 2 + (v - 120) ** 2) / 1500)
        channels = [120 + dent * (u - 160) / 40, 110 + dent * (v - 120) / 40, np.full(u.shape, 115.0)]
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.stack(channels, axis=-1).clip(0, 255).astype(np.uint8))
    rows = "".join(f"{number},{force}\n" for number, force in enumerate(FORCES))
    (folder / "gripper.csv").write_text(f"frame,force_N\n{rows}")


def main() -> None:
    signals, forces = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        draw_frames(folder)
        recording = [f"sensors.finger.source={folder}", f"arms.gripper.source={folder / 'gripper.csv'}"]
        with open_rig("replay", overrides=[*recording, "arms.gripper.width_column=null"]) as rig:
            policy = load_policy("grip", None, rig.spec)
            observation = rig.reset()
            try:
                while True:
                    signals.append(contact_signal(observation.tactile["finger"]))
                    forces.append(-observation.arms["gripper"].wrench[2])
                    observation, _ = rig.step(policy(observation))
            except EndOfEpisode:
                pass
    for force, signal in zip(forces, signals, strict=True):
        print(f"force {force:.1f} N, contact signal {signal:.3f}")

    if forces != FORCES:
        sys.exit(f"the replayed forces are {forces}, recorded were {FORCES}")
    if signals[0] > 1e-3 or not np.all(np.diff(signals[2:]) > 0):
        sys.exit("the contact signal does not grow with the force")


if __name__ == "__main__":
    main()
