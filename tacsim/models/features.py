"""What a learned policy sees of an observation: a few arrays of order 1. Part of what a policy is trained for."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from tacsim.models.hardware import Name
from tacsim.models.quantity import Config, Length

Channel = Literal["height", "slope", "contact", "image", "picture"]
Quantity = Literal["area", "depth", "centroid", "shear", "wrench", "pressure", "moved", "stepped", "between"]


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
    maps: tuple[Channel, ...] = ("height",)  # of each sensor, on `grid`
    grid: MapGrid = MapGrid()
    flow: bool = False  # tactile flow of each sensor, on the lattice of its markers
    touch: tuple[Quantity, ...] = ("area", "depth", "centroid", "wrench", "moved", "between")
    remembered: tuple[Quantity, ...] = ()  # of these the means since the episode began are seen, too
    goal: bool = True  # that of the task
    frames: Annotated[int, Field(ge=1, le=16)] = 1  # the last observations, oldest first

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        for name, listed in {
            "sensors": self.sensors,
            "arms": self.arms,
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
    def _alike(self) -> Self:
        if len(self.names) != len(self.scales):
            raise ValueError(f"{len(self.names)} names, but {len(self.scales)} scales")
        return self
