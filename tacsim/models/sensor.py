"""Configuration of one tactile sensor: where the pixels of its picture lie on its gel (in a metric picture, and in a
camera's through its lens), its light, markers, texture and noise."""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from tacsim.interface import FloatArray
from tacsim.models.photometric import DarknessModel, PhotometricModel, Weight
from tacsim.models.quantity import Config, Length

PixelCount = Annotated[int, Field(ge=16, le=8192)]
Positive = Annotated[Length, Field(gt=0)]
Pair = tuple[float, float]
# Corners u, v [px] of the polygon of a camera's picture that shows gel, one after the other
PictureRegion = Annotated[tuple[Pair, ...], Field(min_length=3, max_length=64)]


class SensorGeometry(Config):
    """Where the pixels of the (rectified) image lie on the gel: ``x = (u - u0) * pixel_pitch``, likewise y.

    Pixel centres are integers; (u0, v0) defaults to the image centre, so the sensor axis is in the middle.

    A `camera_distance` H makes the camera a pinhole on the sensor axis, that far behind the untouched gel: a dot on a
    surface pressed in by h appears at ``x H / (H - h)``. Without one it looks along parallel rays, x stays x. Only
    dots are drawn so; the colour of the gel is always that of parallel rays.
    """

    width: Annotated[int, Field(ge=16, le=4096)] = 320
    height: Annotated[int, Field(ge=16, le=4096)] = 240
    pixel_pitch: Annotated[Length, Field(ge=1e-6, le=1e-2)] = 0.0625e-3  # [m]
    centre: tuple[float, float] | None = None  # (u0, v0) [px]
    camera_distance: Annotated[Length, Field(ge=2e-3, le=10.0)] | None = None  # [m]; None: parallel rays

    @property
    def principal(self) -> tuple[float, float]:
        """(u0, v0): the pixel on the sensor axis."""
        return ((self.width - 1) / 2.0, (self.height - 1) / 2.0) if self.centre is None else self.centre


class Lens(Config):
    """A pinhole with distortion (Brown's model, as OpenCV has it)."""

    width: PixelCount  # of the picture [px]
    height: PixelCount
    focal: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]  # fx, fy [px]
    centre: Pair  # cx, cy [px]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3
    residual: Annotated[float, Field(ge=0)] = 0.0  # root mean square of the calibration [px]

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) [px]"""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1.0]])

    def project(self, directions: FloatArray) -> FloatArray:
        """(n, 2) pixels of lines of sight (n, 2), each as x/z, y/z."""
        projection_chunk = 1 << 16  # points at a time: OpenCV makes the Jacobian along, 240 bytes a point
        import cv2

        found = np.empty((len(directions), 2))
        for start in range(0, len(directions), projection_chunk):
            part = slice(start, start + projection_chunk)
            ahead = np.concatenate([directions[part], np.ones((len(directions[part]), 1))], axis=1)
            pixels, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
            found[part] = pixels.reshape(-1, 2)
        return found

    def directions(self, pixels: FloatArray) -> FloatArray:
        """(n, 2) lines of sight x/z, y/z of pixels (n, 2)."""
        import cv2

        there = cv2.undistortPointsIter(
            np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2), self.matrix, np.array(self.distortion),
            np.eye(3), np.eye(3), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
        )  # fmt: skip
        return np.asarray(there, dtype=np.float64).reshape(-1, 2)


class GelView(Config):
    """Where the gel lies in the native picture. The sensor's x runs along image columns, where its axis is.

    A point (x, y) of the gel [m] is seen along (a, b, c) = perspective (x, y, 1), at the pixel that `lens` gives a / c,
    b / c.
    """

    lens: Lens
    perspective: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    size: tuple[Positive, Positive]  # x, y of the gel that counts, round the sensor's axis [m]
    pixel_pitch: Positive  # of the rectified picture [m]
    residual: Annotated[float, Field(ge=0)] = 0.0  # root mean square of the points [px]
    residual_length: Annotated[Length, Field(ge=0)] = 0.0  # the same on the gel [m]
    board: str = ""  # by what it was found

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows, columns of the native picture."""
        return (self.lens.height, self.lens.width)

    @property
    def geometry(self) -> SensorGeometry:
        """Of the rectified picture."""
        width, height = (round(length / self.pixel_pitch) for length in self.size)
        return SensorGeometry(width=width, height=height, pixel_pitch=self.pixel_pitch)

    def project(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixels of points (..., 2) of the gel [m]."""
        seen = ray_slopes(np.array(self.perspective), points.reshape(-1, 2))
        return self.lens.project(seen).reshape(points.shape)

    def on_gel(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) points of the gel's plane [m] at pixels (..., 2): the inverse of :meth:`project`."""
        back = np.linalg.inv(np.array(self.perspective))
        return ray_slopes(back, self.lens.directions(pixels.reshape(-1, 2))).reshape(pixels.shape)


def ray_slopes(perspective: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 2) x / z, y / z of perspective (x, y, 1), for points (n, 2)."""
    lines = points @ perspective[:, :2].T + perspective[:, 2]
    seen: FloatArray = lines[:, :2] / lines[:, 2:]
    return seen


Side = Annotated[Length, Field(gt=0)]
Channel = Annotated[float, Field(ge=0, le=4)]
Rgb = tuple[Channel, Channel, Channel]
Deviation = Annotated[float, Field(ge=0, le=32)]
Correlation = Annotated[float, Field(ge=-1, le=1)]
Neighbour = Annotated[float, Field(ge=-0.95, le=0.95)]


class BackgroundPolynomial(Config):
    """The colour of an untouched gel as a polynomial in the place u, v, each from -1/2 to 1/2 across the image."""

    degree: Annotated[int, Field(ge=0, le=8)]
    # Of R, G, B, 1 is white; one row a term: 1, u, v, u^2, u v, v^2, u^3, ... up to `degree`.
    weights: tuple[tuple[Weight, Weight, Weight], ...]

    @model_validator(mode="after")
    def _require_weight_count(self) -> Self:
        wanted = math.comb(self.degree + 2, 2)
        if len(self.weights) != wanted:
            raise ValueError(f"weights has {len(self.weights)} rows; a polynomial of degree {self.degree} has {wanted}")
        return self


def _background_kind(value: Any) -> str:
    if isinstance(value, str):
        return "picture"
    return "polynomial" if isinstance(value, (dict, BackgroundPolynomial)) else "colour"


Background = Annotated[
    Annotated[Rgb, Tag("colour")] | Annotated[str, Tag("picture")] | Annotated[BackgroundPolynomial, Tag("polynomial")],
    Discriminator(_background_kind),
]


class Light(Config):
    """One directional light. Like the camera it is behind the gel, on the -z side (z points out of the gel)."""

    direction: tuple[float, float, float]  # from the surface towards the light, sensor axes, any length
    colour: Rgb
    diffuse: Channel = 1.0
    specular: Channel = 0.35

    @model_validator(mode="after")
    def _require_direction(self) -> Self:
        if sum(c * c for c in self.direction) < 1e-12:
            raise ValueError("direction must not be zero")
        if self.direction[2] > 0:
            raise ValueError(f"direction z is {self.direction[2]:g}: lights stand behind the gel, where z is negative")
        return self


# Three lights a third of a turn apart, 24 degrees above the gel's plane: red from the right, green from the lower left,
# blue from the upper left of the image.
THREE_LIGHTS = (
    Light(direction=(1.0, 0.0, -0.45), colour=(1.0, 0.10, 0.08)),
    Light(direction=(-0.5, 0.87, -0.45), colour=(0.08, 1.0, 0.12)),
    Light(direction=(-0.5, -0.87, -0.45), colour=(0.10, 0.12, 1.0)),
)


class Lighting(Config):
    """Phong illumination: diffuse and specular parts summed over lights (Gomes et al. 2021, as the seed uses).

    With a background the picture is background + shade(n) - shade(flat gel); without one it is ambient + shade(n).
    """

    lights: tuple[Light, ...] = Field(default=THREE_LIGHTS, max_length=64)
    ambient: Channel = 0.0  # grey level of unlit gel; only without a background
    shininess: Annotated[float, Field(ge=1, le=1000)] = 10.0
    # of the untouched gel: a colour, a polynomial, or the path of a picture
    background: Background | None = (0.42, 0.44, 0.46)

    @model_validator(mode="after")
    def _require_one_base(self) -> Self:
        if self.ambient > 0 and self.background is not None:
            raise ValueError(
                "ambient has no effect where there is a background; set background to null, or ambient to 0"
            )
        return self


class Markers(Config):
    """A lattice of dots printed on the gel surface. They move with it."""

    rows: Annotated[int, Field(ge=1, le=100)] = 9
    columns: Annotated[int, Field(ge=1, le=100)] = 11
    pitch: Annotated[Length, Field(gt=0)] = 1.5e-3  # [m]
    radius: Annotated[Length, Field(gt=0)] = 0.25e-3  # [m]
    # x, y of each dot on the untouched gel, row by row [m]; None: an even lattice round the sensor's axis
    places: tuple[tuple[tuple[Length, Length], ...], ...] | None = None
    # The background picture shows them as they really are: they are lifted off it. Otherwise they are drawn as discs.
    in_background: bool = False

    @model_validator(mode="after")
    def _require_place_per_dot(self) -> Self:
        if self.places is not None and [len(row) for row in self.places] != [self.columns] * self.rows:
            raise ValueError(f"places must be {self.rows} rows of {self.columns} dots each, x and y of every dot")
        return self


class CameraNoise(Config):
    """Noise of the pictures that a camera delivers, rounding to whole grey levels included."""

    deviation: tuple[Deviation, Deviation, Deviation]  # of R, G, B [grey levels]
    colours: tuple[Correlation, Correlation, Correlation] = (0.0, 0.0, 0.0)  # of R with G, R with B, G with B
    neighbours: tuple[Neighbour, Neighbour] = (0.0, 0.0)  # correlation of pixels side by side along x, along y
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _require_valid_correlations(self) -> Self:
        if np.linalg.eigvalsh(self.colour_matrix())[0] < -1e-6:
            raise ValueError(f"colours {self.colours}: no three colours can be correlated so")
        return self

    def colour_matrix(self) -> FloatArray:
        """(3, 3) correlations of R, G, B."""
        red_green, red_blue, green_blue = self.colours
        return np.array([[1.0, red_green, red_blue], [red_green, 1.0, green_blue], [red_blue, green_blue, 1.0]])


class SensorModel(Config):
    """Everything that makes a gel surface into a picture."""

    name: str = "ideal"
    geometry: SensorGeometry = SensorGeometry()
    gel_size: tuple[Side, Side] | None = None  # x, y of its gel; a rig's scene takes it [m]; None: the scene's
    gel_thickness: Side | None = None  # of the same gel [m]; None: the scene's
    lighting: Lighting = Lighting()
    # Calibrated on a real sensor: takes the place of the lights; the background stays that of `lighting`.
    photometric: PhotometricModel | None = None
    darkness: DarknessModel | None = None  # the same of a light that shows depth and no direction
    markers: Markers | None = None
    # Where the picture of `geometry` lies in the camera's own, which is delivered then; None: it is the camera's own.
    view: GelView | None = None
    texture: Annotated[Length, Field(ge=0)] = 2e-6  # standard deviation of the gel's surface texture [m]
    # Share of the background picture's grain that is on the gel's skin, and moves with it; the rest stands still
    skin: Annotated[float, Field(ge=0, le=1)] = 0.0
    texture_seed: Annotated[int, Field(ge=0)] = 0
    noise: CameraNoise | None = None  # of each picture that a sensor delivers; None: a camera without noise
    source: str = ""
    caution: str = ""  # what its calibration says against itself; "": nothing

    @model_validator(mode="after")
    def _require_calibration_base(self) -> Self:
        given = [name for name in ("photometric", "darkness") if getattr(self, name) is not None]
        if len(given) == 2:
            raise ValueError("photometric and darkness are two lights; give one of them")
        if given and self.lighting.background is None:
            raise ValueError(f"{given[0]} tells changes of colour, so it needs lighting.background: the untouched gel")
        return self

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        if self.gel_thickness is not None and self.gel_size is None:
            raise ValueError("gel_thickness is given without gel_size; give both, or neither")
        if self.view is not None and self.view.geometry != self.geometry:
            raise ValueError(f"geometry is {self.geometry}, its view gives {self.view.geometry}")
        if self.markers is not None and self.markers.in_background:
            if not isinstance(self.lighting.background, str):
                raise ValueError("markers.in_background: lighting.background is no picture that could show them")
            if self.geometry.camera_distance is not None:
                raise ValueError("markers.in_background: dots of a picture are seen along parallel rays only")
        if self.skin > 0:
            if not isinstance(self.lighting.background, str):
                raise ValueError("skin: lighting.background is no picture that could show it")
            if self.geometry.camera_distance is not None:
                raise ValueError("skin: that of a picture is seen along parallel rays only")
        return self

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows, columns of the pictures that are delivered."""
        return (self.geometry.height, self.geometry.width) if self.view is None else self.view.image_shape


class CanonicalGrid(Config):
    """The grid that every sensor's observation lies on, centred on the gel. Part of a policy's specification."""

    rows: Annotated[int, Field(ge=8, le=1024)] = 64
    columns: Annotated[int, Field(ge=8, le=1024)] = 64
    pitch: Annotated[Length, Field(ge=1e-6, le=1e-2)] = 0.25e-3  # [m]
    image_scale: Annotated[int, Field(ge=1, le=8)] = 2  # image pixels per grid cell, along each axis
