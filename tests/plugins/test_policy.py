"""`lerobot-train`, `lerobot-eval` and `lerobot-rollout`, unmodified: a policy of few steps learns from an export, is
judged in simulation, and drives a rig."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from robot.export.lerobot_env import LeRobotEnv
from robot.export.lerobot_mapping import ENVIRONMENT, IMAGE, STATE
from robot.open import make_env
from tests.plugins.commands import refused, run
from tests.robot.cli.invoked import tacsim
from tests.tacsim.gym.small import SMALL

pytestmark = [pytest.mark.deep, pytest.mark.timeout(290)]
TINY = (  # of ACT: enough to run
    *("--policy.type=act", "--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32"),
    *("--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1", "--policy.chunk_size=4"),
    *("--policy.n_action_steps=4", "--policy.pretrained_backbone_weights=null", "--policy.device=cpu"),
    "--policy.push_to_hub=false",
)
OVERRIDES = (*SMALL[:6], "canonical.rows=32", "canonical.columns=32", "canonical.pitch=0.5 mm", *SMALL[10:])


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a policy trained in two steps on an episode of the small simulation."""
    home = tmp_path_factory.mktemp("policy")
    sets = [word for each in OVERRIDES for word in ("--set", each)]
    done = tacsim("run", "sim", "--task", "squeeze", *sets, "--out", home / "run")
    assert done.exit_code == 0, done.output
    done = tacsim("export", "lerobot", home / "run/episode.mcap", "--out", home / "set")
    assert done.exit_code == 0, done.output
    run(
        home, "lerobot-train", *TINY, "--dataset.repo_id=me/set", f"--dataset.root={home / 'set'}", "--steps=2",
        "--batch_size=2", "--num_workers=0", f"--output_dir={home / 'out'}", "--wandb.enable=false", "--save_freq=2",
    )  # fmt: skip
    found = home / "out/checkpoints/last/pretrained_model"
    assert (found / "model.safetensors").is_file()
    return found


def test_a_policy_is_judged_in_simulation(policy: Path, tmp_path: Path) -> None:
    """Two environments in processes of their own, which LeRobot's forkserver starts."""
    overrides = json.dumps(OVERRIDES)
    run(
        tmp_path, "lerobot-eval", f"--policy.path={policy}", "--policy.device=cpu", "--env.type=tacsim", "--env.fps=10",
        f"--env.overrides={overrides}", "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=true",
        f"--output_dir={tmp_path / 'judged'}",
    )  # fmt: skip
    found = json.loads((tmp_path / "judged/eval_info.json").read_text())["overall"]
    assert found["n_episodes"] == 2 and found["pc_success"] in (0.0, 50.0, 100.0)


def test_another_rate_is_refused(policy: Path, tmp_path: Path) -> None:
    said = refused(tmp_path, "lerobot-eval", f"--policy.path={policy}", "--env.type=tacsim", "--env.fps=30")
    assert "control period of 100 ms, which is fps=10, not 30" in said


def test_a_policy_drives_a_rig(policy: Path, tmp_path: Path) -> None:
    overrides = json.dumps(OVERRIDES)
    said = run(
        tmp_path, "lerobot-rollout", "--strategy.type=base", f"--policy.path={policy}", "--device=cpu",
        "--robot.type=tacsim", "--robot.rig=sim", "--robot.task=squeeze", f"--robot.overrides={overrides}", "--fps=10",
        "--duration=2", "--play_sounds=false", "--return_to_initial_position=false",
    )  # fmt: skip
    assert "Duration limit reached" in said and "Rollout finished" in said


def test_a_policy_is_one_of_tacsim(policy: Path, tmp_path: Path) -> None:
    """It acts in an environment of tacsim as LeRobot's own pipeline does on the same observation."""
    from lerobot_env_tacsim import TrainedPolicy, _batch

    mine = TrainedPolicy(policy, task="squeeze", overrides=OVERRIDES)
    env, other = (
        make_env("squeeze", "sim", OVERRIDES, features=None, learning=False),
        LeRobotEnv("squeeze", "sim", OVERRIDES),
    )
    env.reset(seed=1)
    seen, _ = other.reset(seed=1)
    mine.set_goal(env.task.goal)
    mine.reset()
    rig = env.rig
    rig.require(mine.needs, "the policy")
    action = mine(env.observation)
    assert set(action.tool) == {"lower", "upper"}
    row = {STATE: seen["agent_pos"], ENVIRONMENT: seen["environment_state"]}
    row |= {IMAGE + name: picture for name, picture in seen["pixels"].items()}
    mine.reset()
    numbers = mine._after(mine._policy.select_action(mine._before(_batch(row))))
    wanted = other._mapping.decode_action(numbers.detach().numpy()[0])
    for name in action.tool:
        assert np.allclose(action.tool[name].position, wanted.tool[name].position, atol=1e-7)
    with pytest.raises(ValueError, match="has no model"):
        TrainedPolicy(tmp_path)
