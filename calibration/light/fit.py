"""Result of the calibration of a light: its models, their predictions of left-out presses, and its bundle."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata

import numpy as np

from calibration.bundle import Calibration, Provenance, Residual
from calibration.height.slopes import InverseModel
from calibration.lens.view import GelView
from calibration.light.dent import ContactCircle
from calibration.light.photometry import ModelSize
from calibration.light.press import BallPress
from calibration.light.press_shapes import Stretch
from calibration.light.tuning import UNTOUCHED_RADIUS
from tacsim.interface import Float32, FloatArray, Image, short_repr
from tacsim.models.photometric import DarknessModel, PhotometricModel
from tacsim.models.sensor import CameraNoise, Markers, SensorGeometry


@dataclass(frozen=True, slots=True, eq=False)
class PressPrediction:
    """Error of the prediction of one press by a calibration without it."""

    name: str
    circle: ContactCircle
    error: float  # mean |error| in contact and near it (r < 1.5 a) [grey levels]
    null_error: float  # the same, if no change were predicted: the background alone
    correlation: float  # of predicted and real change there
    predicted: Float32  # (H, W, 3) change of colour [grey levels]
    real: Float32  # (H, W, 3) the same, as seen, without drift
    angle: float  # mean error of the normal by the inverse model in contact [degrees]
    untouched_angle: float  # the same, far from contact


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """A calibrated light."""

    __repr__ = short_repr
    forward: PhotometricModel | None  # None, as the next two, for a light without direction
    inverse: InverseModel | None
    size: ModelSize | None
    thickness: float  # of the gel, from the skirts of the dents [px]
    radius_uncertainty: float  # of the scale of all contact radii [-]; NaN for a single press
    residual_shares: tuple[float, ...]  # share of each press's change of colour that no dent explains
    predictions: tuple[PressPrediction, ...]
    left_out: tuple[tuple[str, str], ...]  # frames that were not used, with the reasons
    warnings: tuple[str, ...]
    reference: Image
    presses: tuple[BallPress, ...]
    frames: tuple[str, ...]  # names of all that were given
    darkness: DarknessModel | None = None  # of a light that shows depth and no direction; lengths in pixels
    stretch: Stretch | None = None  # of contacts, which are round; None: not measured
    image_warnings: tuple[str, ...] = ()  # reasons not to trust the pictures, each with advice after a colon

    def to_calibration(
        self,
        serial: str,
        ball_radius: float,
        pixel_pitch: float,
        *,
        view: GelView | None = None,
        markers: Markers | None = None,
        noise: CameraNoise | None = None,
        skin: float | None = None,
    ) -> Calibration:
        """The calibration of sensor `serial`, made now; `ball_radius`, `pixel_pitch` [m]. `write_bundle` sets the
        checksums."""
        rows, columns, _ = self.reference.shape
        return Calibration(
            serial=serial,
            geometry=view.geometry if view else SensorGeometry(width=columns, height=rows, pixel_pitch=pixel_pitch),
            gel_size=(columns * pixel_pitch, rows * pixel_pitch),
            forward=self.forward,
            inverse=self.inverse,
            darkness=None if self.darkness is None else self.darkness.scaled(pixel_pitch),
            view=view,
            markers=markers,
            noise=noise,
            skin=skin,
            residuals=tuple(
                Residual(
                    frame=press.name,
                    circle=(press.circle.x, press.circle.y, press.circle.radius),
                    error=press.error,
                    nothing=press.null_error,
                    correlation=press.correlation,
                    angle=press.angle,
                )
                for press in self.predictions
            ),
            provenance=Provenance(
                made=datetime.now(UTC).isoformat(timespec="seconds"),
                software=f"tacsim {metadata.version('tacsim')}",
                ball_radius=ball_radius,
                frames=self.frames,
                left_out=dict(self.left_out),
                warnings=self.warnings,
            ),
            reference="0" * 64,
        )


def compare_with_prediction(
    press: BallPress, predicted: FloatArray, angles: FloatArray, mean: FloatArray, reference: Image
) -> PressPrediction:
    """A press and its prediction: change of colour (H, W, 3) [grey levels], and error of the normals (H, W)
    [degrees]."""
    distance = press.distance() / press.circle.radius
    untouched_here = np.float64(reference) + press.drift  # what this frame would show without contact
    predicted = np.clip(untouched_here + predicted, 0.0, 255.0) - untouched_here
    real = press.change * mean
    contact, far = distance < 1.5, distance > UNTOUCHED_RADIUS
    return PressPrediction(
        press.name,
        press.circle,
        error=float(np.abs(predicted - real)[contact].mean()),
        null_error=float(np.abs(real)[contact].mean()),
        correlation=float(np.corrcoef(predicted[contact].ravel(), real[contact].ravel())[0, 1]),
        predicted=predicted.astype(np.float32),
        real=real.astype(np.float32),
        angle=float(angles[distance < 1].mean()),
        untouched_angle=float(angles[far].mean()) if far.any() else 0.0,
    )


def normal_angle(one: FloatArray, other: FloatArray) -> FloatArray:
    """(...,) angle [degrees] between unit normals given by their parts (..., 2) in the plane."""

    def full_normal(parts: FloatArray) -> FloatArray:
        square = (parts**2).sum(axis=-1, keepdims=True)
        shorter = parts * np.minimum(1.0, 0.999 / np.sqrt(np.maximum(square, 1e-12)))
        return np.concatenate([shorter, np.sqrt(1.0 - (shorter**2).sum(axis=-1, keepdims=True))], axis=-1)

    cosine = (full_normal(one) * full_normal(other)).sum(axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
