"""How well the distance that is felt agrees with the true one: `python -m benchmarks.felt_distance`.

Episodes of each task at `learn`, of bodies, clays and goals that are drawn anew, played by the scripted policy and by a
random one; at every tenth step both distances are taken. Minutes; docs/learn.md has the figures.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import typer
from scipy import stats

from tacsim.gym.env import TacsimEnv  # registers
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import FloatArray
from tacsim.models.sensor import CanonicalGrid
from tacsim.tasks.task import vector_of_action

NAMES = {"squeeze": "Squeeze", "reposition": "Reposition", "knead": "Knead"}
TOGETHER, EVERY = 16, 10  # environments of a batch; steps from one comparison to the next
STEPS = {"squeeze": 30, "reposition": 30, "knead": 200}
BODY: dict[str, Any] = {
    "scene.body.material.yield_stress": {"log_uniform": ["5 kPa", "20 kPa"]},
    "scene.friction.lower": {"uniform": [0.6, 1.2]},
    "scene.friction.upper": {"uniform": [0.6, 1.2]},
}
DRAWN: dict[str, dict[str, Any]] = {
    "squeeze": BODY
    | {
        "scene.body.geometry.size": {"uniform": [["8 mm", "8 mm", "9 mm"], ["11 mm", "11 mm", "11 mm"]]},
        "task.goal": {"uniform": ["6 mm", "8.5 mm"]},
    },
    "reposition": BODY
    | {
        "scene.body.geometry.size": {"uniform": [["8 mm", "8 mm", "9 mm"], ["11 mm", "11 mm", "11 mm"]]},
        "task.goal": {"uniform": [["-2 mm", "-2 mm"], ["2 mm", "2 mm"]]},
    },
    "knead": BODY
    | {
        "scene.body.geometry.size": {"uniform": [["6 mm", "6 mm", "6 mm"], ["9 mm", "9 mm", "9 mm"]]},
        "task.shape": {"choice": ["rod", "ball"]},
        "task.slenderness": {"uniform": [1.2, 2.5]},
    },
}


def agreement(task: str, rounds: int, seed: int) -> FloatArray:
    """(n, 2) true and felt distance [m] of 16 `rounds` episodes, half of them scripted."""
    overrides = ["scene.preset=learn", "motion=flowing", f"task.steps={STEPS[task]}"]
    overrides += [f"sensors.{n}.model.geometry.{w}=16" for n in ("lower", "upper") for w in ("width", "height")]
    overrides += [f"sensors.{n}.model.geometry.pixel_pitch=1 mm" for n in ("lower", "upper")]
    envs = gymnasium.make_vec(
        f"tacsim/{NAMES[task]}-v0",
        TOGETHER,
        overrides=overrides,
        randomise={"draws": 32, "seed": seed, "values": DRAWN[task]},
        autoreset_mode="Disabled",
    )
    assert isinstance(envs, TacsimVectorEnv)
    random, found = np.random.default_rng(seed), []
    for number in range(rounds):
        envs.reset(seed=1000 * seed + TOGETHER * number)
        found += _episodes(envs, STEPS[task], random)
    envs.close()
    return np.array(found)


def _episodes(envs: TacsimVectorEnv, steps: int, random: np.random.Generator) -> list[tuple[float, float]]:
    each = [env for env in envs.envs if isinstance(env, TacsimEnv)]
    starts = [env.rig.truth() for env in each]
    feel = [env.task.estimator(CanonicalGrid()) for env in each]
    scripted = [env.task.scripted(through=True) for env in each]
    drift, found = [np.zeros(len(env.task.axes)) for env in each], []
    for step in range(steps):
        actions = []
        for number, env in enumerate(each):
            observation, truth, start = env.rig.observe(), env.rig.truth(), starts[number]
            assert truth is not None and start is not None
            felt = feel[number](observation)
            if felt is not None and step % EVERY == 0 and env.phase == "running":
                found.append((env.task.distance(truth, start), felt))
            drift[number] = 0.8 * drift[number] + random.normal(0.0, 0.4, len(env.task.axes))
            vector = drift[number].clip(-1.0, 1.0)
            if env.task.config.kind == "knead":
                vector[:2] *= 0.2
            if number % 2:
                poses = {name: arm.pose for name, arm in observation.arms.items()}
                vector = vector_of_action(scripted[number](observation), env.task.axes, env.task.config.max_step, poses)
            actions.append(vector.astype(np.float32))
        _, _, terminated, truncated, _ = envs.step(np.array(actions))
        ended = terminated | truncated
        if ended.any() and step < steps - 1:  # a limit, or a divergence: what follows does not count
            envs.reset(options={"reset_mask": ended})
            for number in np.flatnonzero(ended).tolist():
                feel[number] = lambda observation: None
    return found


def main(rounds: int = 3, seed: int = 77) -> None:
    typer.echo("| task | moments | r | rank | rms | true distances |\n|---|---|---|---|---|---|")
    for task in NAMES:
        true, felt = 1e3 * agreement(task, rounds, seed).T
        rms = float(np.sqrt(np.mean((true - felt) ** 2)))
        low, high = np.percentile(true, [5, 95])
        typer.echo(
            f"| `{task}` | {len(true)} | {np.corrcoef(true, felt)[0, 1]:.3f} | {stats.spearmanr(true, felt)[0]:.3f} | "
            f"{rms:.3f} mm | {low:.2f} to {high:.2f} mm |"
        )


if __name__ == "__main__":
    typer.run(main)
