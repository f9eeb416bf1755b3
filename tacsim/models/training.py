"""What a training file may say: the task and its episodes, what the policy sees, and how it learns."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tacsim.models.policy import Features
from tacsim.models.quantity import Config
from tacsim.models.randomisation import Randomisation

Count = Annotated[int, Field(ge=1, le=1_000_000)]
Rate = Annotated[float, Field(gt=0, le=1)]


class DaggerConfig(Config):
    """A teacher that knows the truth shows a student that only feels what to do (Ross et al. 2011)."""

    rounds: Count = 10  # in each, every environment plays one episode
    epochs: Count = 60  # passes over all that was met so far, after each round
    batch: Count = 128
    rate: Rate = 1e-3  # of Adam; it falls to zero in each round
    pace: Annotated[float, Field(gt=0, le=1)] = 0.5  # share of the teacher's action that the student is shown
    noise: Annotated[float, Field(ge=0, le=1)] = 0.3  # of the teacher's actions in the first round, which it plays


class ReinforceConfig(Config):
    """PPO (Schulman et al. 2017) or SAC (Haarnoja et al. 2018), of stable-baselines3: from the reward alone."""

    rounds: Count = 20  # in each, every environment plays `episodes` from their start
    episodes: Count = 2
    batch: Count = 256
    rate: Rate = 3e-4


class Training(Config):
    """One training file: ``tacsim train squeeze`` reads ``configs/trainings/squeeze.yaml``."""

    task: str  # name or path, as of `tacsim run --task`
    rig: str = "sim"  # name or path of a simulated one
    overrides: tuple[str, ...] = ()  # of the rig, as of --set: resolution, sensors, length of an episode
    randomise: Randomisation | None = None  # what differs from one episode to the next
    features: Features = Features()  # what the policy sees
    environments: Annotated[int, Field(ge=1, le=1024)] = 16  # that move together
    width: Annotated[int, Field(ge=1, le=1024)] = 128  # of the network's two hidden layers
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    algorithm: Literal["dagger", "ppo", "sac"] = "dagger"
    dagger: DaggerConfig = DaggerConfig()
    reinforce: ReinforceConfig = ReinforceConfig()  # of ppo and sac
