"""The calibration of one sensor as a folder: `calibration.yaml` and the picture without contact.

A bundle belongs to one serial number. Reading checks version, checksums and sizes, and refuses a damaged, older or
foreign bundle with a message that says what to do.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal, Self

import yaml
from pydantic import Field, model_validator

from calibration.errors import CalibrationError
from calibration.height.slopes import InverseModel
from calibration.lens.view import GelView
from tacsim.config import ConfigError, load_model, load_sensor
from tacsim.config.bundle import (
    FILE,
    REFERENCE,
    REPLACE_ADVICE,
    NoBundle,
    bundle_digest,
    find_bundle,
    read_files,
    require_unchanged,
)
from tacsim.interface import Image
from tacsim.models.hardware import Placement
from tacsim.models.photometric import DarknessModel, PhotometricModel
from tacsim.models.quantity import Config, Length, Time
from tacsim.models.sensor import CameraNoise, Markers, PictureRegion, SensorGeometry, SensorModel
from tacsim.record.episode import EpisodeError
from tacsim.record.images import decode_image, encode_png

SERIAL = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

Positive = Annotated[Length, Field(gt=0)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class BadBundle(CalibrationError):
    """A bundle cannot be used."""


class Residual(Config):
    """Error of the prediction of one press by a calibration without it."""

    frame: str
    circle: tuple[float, float, float]  # x, y, radius of the contact [px]
    error: float  # mean |error| in and near contact [grey levels]
    nothing: float  # the same for a picture without contact [grey levels]
    correlation: float
    angle: float  # of the normal in contact [degrees]


class Provenance(Config):
    """Origin of a calibration."""

    made: str  # date and time, ISO 8601
    software: str
    ball_radius: Positive
    frames: tuple[str, ...]
    left_out: dict[str, str] = {}  # frames that were not used, with the reasons
    warnings: tuple[str, ...] = ()


class Calibration(Config):
    """All results of the calibration of one sensor."""

    format: Literal[8] = 8
    serial: Annotated[str, Field(pattern=SERIAL)]
    geometry: SensorGeometry  # of the picture of the models: the native one, or with `view` the rectified one
    gel_size: tuple[Positive, Positive]  # x, y of the gel that the picture shows [m]
    forward: PhotometricModel | None = None  # slope -> colour
    inverse: InverseModel | None = None  # colour -> slope
    darkness: DarknessModel | None = None  # replaces both for a light that shows depth, but no direction
    view: GelView | None = None  # pose of the gel in the native picture; None: the native picture is metric
    region: PictureRegion | None = None  # part of the camera's picture with the gel; None: all of it, or of the view
    markers: Markers | None = None  # None: no dots are printed on the gel
    noise: CameraNoise | None = None  # of the picture of the models; None: not measured
    # share of the grain without contact that moves with the gel; None: not known
    skin: Annotated[float, Field(gt=0, le=1)] | None = None
    tool_from_sensor: Placement | None = None  # None: not measured
    latency: Annotated[Time, Field(ge=0)] | None = None  # from exposure to arrival; None: not measured [s]
    residuals: tuple[Residual, ...] = ()
    provenance: Provenance
    reference: Digest  # SHA-256 of the picture's bytes
    checksum: Digest = "0" * 64  # SHA-256 of all other fields

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows, columns of the pictures that the sensor's camera delivers."""
        return (self.geometry.height, self.geometry.width) if self.view is None else self.view.image_shape

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        if (self.forward is None) != (self.inverse is None) or (self.forward is None) == (self.darkness is None):
            raise ValueError("a light is given either by forward and inverse, or by darkness")
        pitch = self.geometry.pixel_pitch
        shown = (self.geometry.width * pitch, self.geometry.height * pitch)
        if any(abs(one - other) > pitch for one, other in zip(shown, self.gel_size, strict=True)):
            raise ValueError(f"gel_size is {self.gel_size} m, the picture of its geometry shows {shown} m")
        if self.view is not None and self.view.geometry != self.geometry:
            raise ValueError(f"geometry is {self.geometry}, its view gives {self.view.geometry}")
        return self

    def digest(self) -> str:
        """The correct value of `checksum`."""
        return bundle_digest(self.model_dump(mode="json"))


def write_bundle(folder: Path, calibration: Calibration, reference: Image) -> Path:
    """Writes the bundle into `folder`, which exists, and returns the path of its YAML file; the two checksums are set
    here. `reference`: (H, W, 3) RGB without contact. Raises OSError."""
    png = encode_png(reference)
    stamped = calibration.model_copy(update={"reference": hashlib.sha256(png).hexdigest()})
    stamped = stamped.model_copy(update={"checksum": stamped.digest()})
    (folder / REFERENCE).write_bytes(png)
    path = folder / FILE
    text = yaml.safe_dump(stamped.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")
    return path


def read_bundle(path: Path, serial: str | None = None) -> tuple[Calibration, Image]:
    """The calibration at `path` (its folder or YAML file, or its name if it lies in `sensors/`) and its picture without
    contact; `serial` is the sensor that it must belong to. Raises BadBundle."""
    try:
        file, content, png = read_files(find_bundle(path))
        try:
            calibration = load_model(Calibration, file)
        except ConfigError as error:
            raise BadBundle(f"{file} is damaged; {REPLACE_ADVICE}.\n{error}") from None
        require_unchanged(file, content, png)
    except NoBundle as why:
        raise BadBundle(str(why)) from None
    if serial is not None and serial != calibration.serial:
        raise BadBundle(f"{file} belongs to sensor '{calibration.serial}', not to '{serial}'")
    try:
        picture = decode_image(png, str(file.with_name(REFERENCE)), ("PNG",))
    except EpisodeError as error:
        raise BadBundle(str(error)) from None
    wanted = (calibration.geometry.height, calibration.geometry.width, 3)
    if picture.shape != wanted:
        raise BadBundle(f"{file.with_name(REFERENCE)} is {picture.shape}, the calibration is of {wanted}")
    return calibration, picture


def read_sensor_model(path: Path) -> SensorModel:
    """The simulation model of a calibrated sensor: geometry, view, untouched picture, light, dots, gel size, and the
    camera's noise if it was measured. Raises BadBundle."""
    try:
        return load_sensor(find_bundle(path))
    except ConfigError as error:
        raise BadBundle(str(error)) from None
