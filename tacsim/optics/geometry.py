"""Facts of one tactile sensor: the one geometry of its image, its light, its markers, its noise."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from tacsim.quantity import Facts, Length

Channel = Annotated[float, Field(ge=0, le=4)]
Rgb = tuple[Channel, Channel, Channel]


class SensorGeometry(Facts):
    """Where the pixels of the (rectified) image lie on the gel: ``x = (u - u0) * pixel_pitch``, likewise y.

    Pixel centres are integers; (u0, v0) defaults to the image centre, so the sensor axis is in the middle.
    """

    width: Annotated[int, Field(ge=16, le=4096)] = 320
    height: Annotated[int, Field(ge=16, le=4096)] = 240
    pixel_pitch: Annotated[Length, Field(gt=0)] = 0.0625e-3  # [m]
    centre: tuple[float, float] | None = None  # (u0, v0) [px]

    @property
    def principal(self) -> tuple[float, float]:
        """(u0, v0): the pixel on the sensor axis."""
        return ((self.width - 1) / 2.0, (self.height - 1) / 2.0) if self.centre is None else self.centre


class Light(Facts):
    """One directional light."""

    direction: tuple[float, float, float]  # from the surface towards the light, sensor axes, any length
    colour: Rgb
    diffuse: Channel = 1.0
    specular: Channel = 0.35

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if sum(c * c for c in self.direction) < 1e-12:
            raise ValueError("direction must not be zero")
        return self


class Lighting(Facts):
    """Phong illumination: ambient + sum over lights of diffuse and specular parts (Gomes et al. 2021, as the seed uses)."""

    lights: tuple[Light, ...] = Field(default=(), max_length=64)
    ambient: Channel = 0.0
    shininess: Annotated[float, Field(ge=1, le=1000)] = 10.0
    background: Rgb | str = (0.42, 0.44, 0.46)  # colour of the untouched gel, or the path of a picture


class Markers(Facts):
    """A lattice of dots printed on the gel surface."""

    rows: Annotated[int, Field(ge=1, le=100)] = 9
    columns: Annotated[int, Field(ge=1, le=100)] = 11
    pitch: Annotated[Length, Field(gt=0)] = 1.5e-3  # [m]
    radius: Annotated[Length, Field(gt=0)] = 0.25e-3  # [m]


class SensorModel(Facts):
    """Everything that makes a gel surface into a picture."""

    name: str = "ideal"
    geometry: SensorGeometry = SensorGeometry()
    lighting: Lighting = Lighting()
    markers: Markers | None = None
    texture: Annotated[Length, Field(ge=0)] = 2e-6  # standard deviation of the gel's surface texture [m]
    texture_seed: Annotated[int, Field(ge=0)] = 0
    source: str = ""


class CanonicalGrid(Facts):
    """The grid that every sensor's observation lies on, centred on the gel. Part of a policy's specification."""

    rows: Annotated[int, Field(ge=8, le=1024)] = 64
    columns: Annotated[int, Field(ge=8, le=1024)] = 64
    pitch: Annotated[Length, Field(gt=0)] = 0.25e-3  # [m]
    image_scale: Annotated[int, Field(ge=1, le=8)] = 2  # image pixels per grid cell, each way
