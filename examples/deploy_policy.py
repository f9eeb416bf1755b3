"""Run a learned policy, one ONNX file, on a rig: here the shipped squeeze policy in the simulation.

python examples/deploy_policy.py          # needs the extra `policy`
python examples/deploy_policy.py mock     # the same policy on mock hardware; needs ur_rtde
"""

from __future__ import annotations

import sys

from robot import EpisodeSetup, load_policy, open_rig, run_episode
from tacsim import load_rig, make_task

STEPS = 15
SUCCESS = 0.15e-3  # distance from the goal [m]


def main() -> None:
    rig_name = sys.argv[1] if len(sys.argv) > 1 else "sim"
    loaded = load_rig(rig_name, overrides=["scene.preset=learn", "task.goal=8 mm"])
    task = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        # Refused here, in words, if the policy needs what the rig does not deliver.
        policy = load_policy("learned", task, rig.spec, loaded.config.canonical)
        setup = EpisodeSetup(policy="learned", canonical=loaded.config.canonical)
        episode = run_episode(rig, policy, task, STEPS, setup=setup)

    for step in episode.steps:
        print(f"step {step.index:2d}: {step.distance * 1e3:.2f} mm from the goal")
    if not episode.steps[-1].distance < SUCCESS:
        sys.exit(f"the policy ends {episode.steps[-1].distance * 1e3:.2f} mm from the goal, more than 0.15 mm")
    strangeness = max(step.info["training_distance"] for step in episode.steps[1:])
    if strangeness > 1:
        sys.exit(f"an observation lies outside the range of training ({strangeness:.2f}, allowed: 1)")


if __name__ == "__main__":
    main()
