"""What a learned policy sees of an observation, what its file says of itself (the JSON in its metadata), and what a
training file may say. A policy's file is read on the rig that it is to run on, so it says everything that its numbers
depend on."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from tacsim.models.hardware import Name
from tacsim.models.quantity import Config, Force, Length, Time
from tacsim.models.randomisation import Randomisation

Channel = Literal["height", "slope", "contact", "image", "picture"]
Quantity = Literal[
    "area",
    "depth",
    "centroid",
    "dragged",
    "shear",
    "turned",
    "wrench",
    "pressure",
    "moved",
    "stepped",
    "between",
    "grip",
]

METADATA_KEY = "tacsim.spec"  # of an ONNX file


class MapGrid(Config):
    """Cells of the maps, centred on the gel. Each is the mean of whole cells of the rig's canonical grid; of `picture`
    it is the mean of a part of the camera's picture, whatever that shows, and `pitch` says nothing."""

    rows: Annotated[int, Field(ge=1, le=1024)] = 16
    columns: Annotated[int, Field(ge=1, le=1024)] = 16
    pitch: Annotated[Length, Field(ge=1e-6, le=1e-2)] = 1e-3  # [m]


class Features(Config):
    """Which of an observation's quantities, in which order. Units and scales: `tacsim.gym.features`."""

    sensors: tuple[Name, ...] = Field(default=("lower", "upper"), max_length=16)
    arms: tuple[Name, ...] = Field(default=("lower", "upper"), max_length=16)
    grippers: tuple[Name, ...] = Field(default=(), max_length=16)
    maps: tuple[Channel, ...] = ("height",)  # of each sensor, on `grid`
    grid: MapGrid = MapGrid()
    flow: bool = False  # tactile flow of each sensor, on the lattice of its markers
    touch: tuple[Quantity, ...] = ("area", "depth", "centroid", "wrench", "moved", "between")
    remembered: tuple[Quantity, ...] = ()  # of these the means since the episode began are seen, too
    goal: bool = True  # that of the task
    frames: Annotated[int, Field(ge=1, le=16)] = 1  # the last observations, oldest first

    @model_validator(mode="after")
    def _require_contents(self) -> Self:
        for name, listed in {
            "sensors": self.sensors,
            "arms": self.arms,
            "grippers": self.grippers,
            "maps": self.maps,
            "touch": self.touch,
            "remembered": self.remembered,
        }.items():
            if len(set(listed)) < len(listed):
                raise ValueError(f"{name} names something twice: {', '.join(listed)}")
        if (self.maps or self.flow) and not self.sensors:
            raise ValueError("maps and flow are those of sensors: name some, or leave both out")
        if "between" in self.touch and len(self.arms) < 2:
            raise ValueError("touch 'between' is of two arms and more: name them, or leave it out")
        if "grip" in self.touch and not self.grippers:
            raise ValueError("touch 'grip' is of grippers: name some, or leave it out")
        unseen = [name for name in self.remembered if name not in self.touch]
        if unseen:
            raise ValueError(f"remembered is of what touch names; add {', '.join(unseen)} to touch, or leave it out")
        if not (self.maps or self.flow or self.touch):
            raise ValueError("a policy that sees nothing: choose maps, flow or touch")
        return self


class Numbers(Config):
    """What the numbers of one input are, along its first axis."""

    names: Annotated[tuple[str, ...], Field(min_length=1, max_length=10_000)]
    scales: tuple[float, ...]  # SI value that is encoded as 1

    @model_validator(mode="after")
    def _require_equal_lengths(self) -> Self:
        if len(self.names) != len(self.scales):
            raise ValueError(f"{len(self.names)} names, but {len(self.scales)} scales")
        return self


Component = Annotated[float, Field(ge=-1, le=1)]


class ActionAxis(Config):
    """One number of an action: it moves `arm` along `direction`."""

    arm: Name
    direction: tuple[Component, Component, Component]  # unit vector, world

    @model_validator(mode="after")
    def _require_unit_vector(self) -> Self:
        if abs(math.hypot(*self.direction) - 1.0) > 1e-6:
            raise ValueError(f"direction {self.direction} is no unit vector")
        return self


class ActionGrip(Config):
    """One number of an action: the force of `gripper`, from `min_force` at -1 to `max_force` at 1."""

    gripper: Name
    min_force: Annotated[Force, Field(gt=0)]  # [N]
    max_force: Annotated[Force, Field(gt=0)]  # [N]

    @model_validator(mode="after")
    def _require_range(self) -> Self:
        if not self.min_force < self.max_force:
            raise ValueError(f"min_force {self.min_force:g} N must be below max_force, {self.max_force:g} N")
        return self


class TrainingRange(Config):
    """What a policy observed in its training, and what was simulated there; `robot.deploy.training_range` says how an
    observation is compared with it. `tacsim export policy-range` measures it."""

    episodes: Annotated[int, Field(ge=2)]  # that it was measured in
    low: tuple[float, ...]  # least of each number of an observation [encoded]
    high: tuple[float, ...]
    centre: tuple[float, ...]  # mean of the numbers and of their products
    axes: tuple[tuple[float, ...], ...]  # (number - centre) times these has variance 1 along each
    limit: Annotated[float, Field(gt=0)]  # greatest distance that training's own episodes keep
    scene: dict[str, tuple[float, float]]  # least and greatest of each number of training's scenes, by key [SI]
    words: dict[str, tuple[str, ...]] = {}  # the same of what is no number: shapes

    @model_validator(mode="after")
    def _require_equal_lengths(self) -> Self:
        if len(self.low) != len(self.high):
            raise ValueError(f"{len(self.low)} least numbers, but {len(self.high)} greatest")
        if any(len(axis) != len(self.centre) for axis in self.axes):
            raise ValueError(f"each axis has as many numbers as the centre, {len(self.centre)}")
        return self


class PolicySpec(Config):
    """A learned policy: what it sees, what its numbers do, and where it comes from."""

    version: Literal[1] = 1
    task: str  # the kind that it was trained for
    period: Annotated[Time, Field(gt=0)]  # control period [s]
    features: Features
    # Of each input of the graph; so a change of the encoder's own conventions is noticed.
    inputs: dict[str, Numbers]
    axes: Annotated[tuple[ActionAxis | ActionGrip, ...], Field(min_length=1, max_length=64)]
    max_step: Annotated[Length, Field(gt=0)]  # an action of 1 moves its arm so far [m]
    trained: dict[str, Any] = {}  # how it was made, for people
    range: TrainingRange | None = None  # of its training; None: unknown


Count = Annotated[int, Field(ge=1, le=1_000_000)]
Rate = Annotated[float, Field(gt=0, le=1)]


class DaggerConfig(Config):
    """A teacher shows a student that only feels what to do (Ross et al. 2011)."""

    # truth: `Task.expert`, which knows the state of the simulation, where the task has one; touch: `Task.teacher`, of
    # most tasks the scripted policy, for what no student can feel before it has searched.
    teacher: Literal["truth", "touch"] = "truth"

    rounds: Count = 10  # in each, every environment plays one episode
    epochs: Count = 60  # passes over all that was met so far, after each round
    batch: Count = 128
    rate: Rate = 1e-3  # of Adam; it falls to zero in each round
    pace: Annotated[float, Field(gt=0, le=1)] = 0.5  # share of the teacher's action that the student is shown
    noise: Annotated[float, Field(ge=0, le=1)] = 0.3  # of the teacher's actions in the first round, which it plays


class ReinforceConfig(Config):
    """PPO (Schulman et al. 2017) or SAC (Haarnoja et al. 2018), of stable-baselines3: from the reward alone."""

    rounds: Count | None = None  # in each, every environment plays `episodes`; None: 70 of ppo, 24 of sac
    episodes: Count = 2
    batch: Count = 256
    rate: Rate = 3e-4  # of Adam; it falls to zero over the rounds
    discount: Annotated[float, Field(ge=0, lt=1)] = 0.9  # weight of a reward, over that of one control step before


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
