"""The normaliser of each kind of sensor: `normaliser_for_...`, an instance of calibration/frame_normaliser.py."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from calibration.bundle import BadBundle, Calibration, read_bundle
from calibration.errors import BadFrames
from calibration.frame_normaliser import FrameNormaliser
from calibration.height.slopes import (
    DarknessSlopes,
    GradientModel,
    InverseModel,
    PolynomialSlopes,
    inverse_of_light,
    table_of_model,
)
from calibration.height.surface_finder import ForwardSteps, SurfaceFinder, extended_view
from calibration.lens.rectification import (
    Rectification,
    rectification_of_corners,
    rectification_of_geometry,
    rectification_of_view,
    visible_box,
)
from calibration.markers.flow import NoMarkers, marker_flow, view_of_dots
from tacsim.interface import Image
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.photometric import PhotometricModel
from tacsim.models.rig import ReplaySensorConfig
from tacsim.models.sensor import CanonicalGrid, PictureRegion, SensorGeometry, SensorModel
from tacsim.optics.grid import PixelGrid, canonical_image


def normaliser_for_simulation(
    model: SensorModel, gel_size: tuple[float, float], grid: CanonicalGrid
) -> FrameNormaliser:
    """The normaliser of a simulated sensor; `gel_size`: x, y [m]."""
    return FrameNormaliser(_rectification_of_model(model, gel_size, canonical_image(grid)), grid)


def normaliser_for_pictures(
    model: SensorModel, gel_size: tuple[float, float], grid: CanonicalGrid, region: PictureRegion | None = None
) -> FrameNormaliser:
    """The normaliser of a simulated sensor of which only pictures are available, from a camera or a recording. The
    inverse of the model's light gives height and gradient, its markers give flow. Raises ValueError for a light without
    inverse, or markers too small for the image."""
    wide = extended_view(grid, gel_size)
    rectify = _rectification_of_model(model, gel_size, wide).within(region)
    slopes: GradientModel
    better = None
    if model.photometric is not None:
        inverse = inverse_of_light(model.photometric)
        slopes, better = _calibrated_slopes(inverse, model.photometric, model.geometry, wide, rectify)
    elif model.darkness is not None:
        shape = rectify.valid[visible_box(rectify.valid)].shape
        slopes = DarknessSlopes(model.darkness, shape, grid.pitch / grid.image_scale)
    else:
        slopes = table_of_model(model)
    find = SurfaceFinder(slopes, rectify.valid, grid, dots=model.markers is not None, better=better)
    return FrameNormaliser(
        rectify, grid, find, marker_flow(model.markers, model.geometry, gel_size, model.view, region)
    )


def _calibrated_slopes(
    inverse: InverseModel, forward: PhotometricModel, geometry: SensorGeometry, wide: PixelGrid, rectify: Rectification
) -> tuple[PolynomialSlopes, ForwardSteps]:
    """Both models of a calibrated light on the pixels of `wide` that show gel."""
    pixels = (wide.points() / geometry.pixel_pitch + geometry.principal + 0.5) / (geometry.width, geometry.height)
    x, y = np.moveaxis(2.0 * pixels[visible_box(rectify.valid)] - 1.0, -1, 0)
    u, v = (np.asarray(place / 2, dtype=np.float32) for place in (x, y))
    steps = ForwardSteps(forward, u, v, wide.pitch, geometry.width * geometry.pixel_pitch)
    return PolynomialSlopes(inverse, x, y), steps


def _rectification_of_model(model: SensorModel, gel_size: tuple[float, float], grid: PixelGrid) -> Rectification:
    """Native picture to grid, for a sensor of this model."""
    return (
        rectification_of_geometry(model.geometry, gel_size, grid)
        if model.view is None
        else rectification_of_view(model.view, grid)
    )


def normaliser_for_calibration(
    calibration: Calibration, grid: CanonicalGrid, untouched: Image | None = None
) -> FrameNormaliser:
    """The normaliser of a calibrated sensor: geometry and inverse of its light are those of its bundle.

    untouched: the bundle's (metric) picture, which is used to check the channel order of each reference.
    """
    geometry = calibration.geometry
    wide = extended_view(grid, calibration.gel_size)
    # One look-up from the native picture, whether it is metric by itself or seen through lens and perspective.
    if calibration.view is None:
        rectify = rectification_of_geometry(geometry, calibration.gel_size, wide)
    else:
        rectify = rectification_of_view(calibration.view, wide)
    rectify = rectify.within(calibration.region)
    slopes: GradientModel
    better = None
    if calibration.darkness is not None:
        shape = rectify.valid[visible_box(rectify.valid)].shape
        slopes = DarknessSlopes(calibration.darkness, shape, wide.pitch)
    else:
        assert calibration.inverse is not None and calibration.forward is not None
        slopes, better = _calibrated_slopes(calibration.inverse, calibration.forward, geometry, wide, rectify)
    dots = calibration.markers is not None
    find = SurfaceFinder(slopes, rectify.valid, grid, dots=dots, drifts=True, better=better)
    flow = marker_flow(calibration.markers, geometry, calibration.gel_size, calibration.view, calibration.region)
    known = None
    if untouched is not None:  # it is metric, even if the camera's picture is not
        known = rectification_of_geometry(geometry, calibration.gel_size, wide)(untouched)
    return FrameNormaliser(rectify, grid, find, flow, untouched=known)


def normaliser_for_recording(
    config: ReplaySensorConfig,
    image_shape: tuple[int, int],
    grid: CanonicalGrid,
    untouched: Image | None = None,
) -> FrameNormaliser:
    """The normaliser of recorded frames of `image_shape` (rows, columns), from the sensor's calibration, from the dots
    in its picture without contact (`untouched`) and their distance, or from the four corners of the gel.

    Raises calibration.lens.view.BadCorners, calibration.bundle.BadBundle, calibration.errors.BadFrames.
    """
    if config.marker_pitch is not None and untouched is not None:
        return normaliser_for_dots(config.marker_pitch, untouched, grid, config.region)
    if config.calibration is not None:
        return _of_bundle(config.calibration, image_shape, grid)
    seen = rectification_of_corners(config.corners, config.size, image_shape, canonical_image(grid))
    return FrameNormaliser(seen.within(config.region), grid, drifts=True)


def normaliser_for_dots(
    pitch: float, untouched: Image, grid: CanonicalGrid, region: PictureRegion | None = None
) -> FrameNormaliser:
    """The normaliser of a sensor of which only the distance of its printed dots, `pitch` [m], and its picture without
    contact are known: flow, no height. The camera looks along the gel's normal. Raises BadFrames without dots."""
    try:
        rectify, flow = view_of_dots(pitch, untouched, grid, region)
    except NoMarkers as nothing:
        raise BadFrames(str(nothing)) from None
    return FrameNormaliser(rectify, grid, markers=flow, drifts=True)


def normaliser_for_camera(
    config: CameraSensorConfig, gel_size: tuple[float, float], grid: CanonicalGrid
) -> FrameNormaliser:
    """The normaliser of a sensor with a camera, from its calibration, its model, the distance of its dots, or the four
    corners of the gel. The last two give no height. gel_size: x, y of a model's gel [m].

    Raises calibration.bundle.BadBundle, ValueError for a model without inverse,
    calibration.lens.view.BadCorners.
    """
    if config.calibration is not None:
        return _of_bundle(config.calibration, (config.height, config.width), grid)
    if config.model is not None:
        return normaliser_for_pictures(config.model, gel_size, grid, config.region)
    shape = (config.height, config.width)
    if config.marker_pitch is not None:
        dots = partial(view_of_dots, config.marker_pitch, grid=grid, region=config.region)
        first = rectification_of_corners(None, config.size, shape, canonical_image(grid))
        return FrameNormaliser(first, grid, drifts=True, dots=dots)
    seen = rectification_of_corners(config.corners, config.size, shape, canonical_image(grid))
    return FrameNormaliser(seen.within(config.region), grid, drifts=True)


def _of_bundle(path: str, image_shape: tuple[int, int], grid: CanonicalGrid) -> FrameNormaliser:
    """The normaliser of the calibration at `path`, for pictures of `image_shape` (rows, columns). Raises BadBundle."""
    calibration, untouched = read_bundle(Path(path))
    if calibration.image_shape != image_shape:
        (rows, columns), (high, wide) = image_shape, calibration.image_shape
        raise BadBundle(
            f"{path} was calibrated on pictures of {wide} x {high} px, this sensor delivers {columns} x {rows}: set "
            "width and height of the sensor to those of the calibration, or calibrate again at this setting"
        )
    return normaliser_for_calibration(calibration, grid, untouched)
