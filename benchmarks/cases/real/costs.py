"""Real group: cost of a calibrated picture and of an observation. No real frame is needed: the time does not depend on
the weights, and the surface is that of a simulated press.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.cases.press import press, press_scene
from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from tacsim.interface import TactileFrame
from tacsim.models.photometric import (
    DEPTH_TERMS,
    DepthColour,
    PhotometricModel,
    depth_terms,
    image_axes,
    image_grid_places,
    term_count,
)
from tacsim.models.scene import Sphere
from tacsim.models.sensor import CanonicalGrid, SensorGeometry, SensorModel

if TYPE_CHECKING:
    from calibration.bundle import Calibration

RENDER, NORMALISE = "calibrated_render", "normaliser"
DEGREE, POSITION = 5, 2  # of the largest model that a calibration selects
MIN_REPETITIONS = 25  # for a median of a few milliseconds
VIEW = (20e-3, 15e-3)  # size of the gel in the pictures of both sizes [m]
BALL, DEPTH = 4e-3, 1e-3  # [m]


def made_up(width: int) -> Calibration:
    """A calibration of the largest order for pictures of width x 3/4 width, with random light."""
    from calibration.bundle import Calibration, Provenance
    from calibration.height.slopes import InverseModel, fit_inverse, inverse_features, normal_of_slope
    from tacsim.models.photometric import PhotometricLight

    shape = (3 * width // 4, width)
    rng = np.random.default_rng(0)
    weights = 0.05 * rng.normal(size=(term_count(DEGREE, POSITION), 3))
    weights[:2] = [[0.8, -0.4, -0.4], [0.0, 0.7, -0.7]]
    forward = PhotometricModel(
        degree=DEGREE, position=POSITION, weights=tuple((float(r), float(g), float(b)) for r, g, b in weights),
        steepest=1.0, blur=0.8,
        depth=DepthColour(deepest=DEPTH / VIEW[0], weights=((-0.1, 0.05, 0.02),) * DEPTH_TERMS),
    )  # fmt: skip
    slopes = rng.uniform(-0.6, 0.6, (*shape, 2)).astype(np.float32)
    change, _ = PhotometricLight(forward).change(slopes, *image_grid_places(shape[1], shape[0]))
    u, v = np.meshgrid(*image_axes(shape[1], shape[0]))
    terms = inverse_features(change.reshape(-1, 3).astype(np.float64), 2 * u.ravel(), 2 * v.ravel())
    target = normal_of_slope(slopes.reshape(-1, 2).astype(np.float64))
    inverse = fit_inverse([(terms.T @ terms, terms.T @ target)], with_position=True)
    return Calibration(
        serial="made-up",
        geometry=SensorGeometry(width=shape[1], height=shape[0], pixel_pitch=VIEW[0] / width),
        gel_size=VIEW,
        forward=forward,
        inverse=InverseModel(weights=tuple((float(x), float(y)) for x, y in inverse), steepest=1.0),
        provenance=Provenance(made="", software="tacsim", ball_radius=BALL, frames=()),
        reference="0" * 64,
    )


def calibrated_render(width: int, repeat: int) -> list[Measurement]:
    """A picture of our gel under a ball, by the largest model that a calibration selects, for a new surface, as after
    each step."""
    import cv2

    from calibration.light.photometry import photometric_features
    from tacsim.optics.grid import image_grid
    from tacsim.optics.render import Renderer
    from tacsim.optics.surface import sample_surface

    calibration = made_up(width)
    forward = calibration.forward
    assert forward is not None
    world, _ = press(press_scene(Sphere(radius=BALL), 1e-3), DEPTH)
    surface = world.surface("lower")
    model = SensorModel(geometry=calibration.geometry, photometric=forward, texture=0.0)
    render = Renderer(model, (20e-3, 20e-3))
    # each differs by 0.001 µm, so that the cache of the last surface is not used
    others = (replace(surface, displacement=surface.displacement * np.float32(1 + 1e-6 * k)) for k in count(1))
    timing, _ = timed(lambda: render(next(others)), max(repeat, MIN_REPETITIONS))
    image = render(surface)
    # the same polynomial, term by term, in double precision and without strips
    sample = sample_surface(surface, image_grid(calibration.geometry))
    slopes, height = sample.gradient.astype(np.float64), sample.height.astype(np.float64) / VIEW[0]
    steep = np.maximum(np.hypot(slopes[..., 0], slopes[..., 1]) / forward.steepest, 1.0)
    u, v = np.meshgrid(*image_axes(image.shape[1], image.shape[0]))
    terms = photometric_features((slopes / steep[..., None]).reshape(-1, 2), u.ravel(), v.ravel(), DEGREE, POSITION)
    change = (terms @ np.array(forward.weights)).reshape(image.shape)
    assert forward.depth is not None
    deep = depth_terms(height, forward.depth.deepest, u, v)
    change += np.tensordot(deep, np.array(forward.depth.weights), axes=(0, 0))
    still = 255.0 * np.array(model.lighting.background, dtype=np.float64)
    exact = np.clip(still + still * cv2.GaussianBlur(change, (0, 0), forward.blur), 0, 255)
    return [
        Measurement(
            timing, float(np.abs(image - exact).max()), "grey at most", "the polynomial itself, in double precision",
            f"{image.shape[1]} x {image.shape[0]}", None, {"terms": float(3 * len(forward.weights))},
        )
    ]  # fmt: skip


def normaliser(repeat: int) -> list[Measurement]:
    """A frame of 320 x 240 to an observation with height and gradient from the picture."""
    from calibration.normaliser import normaliser_for_calibration
    from tacsim.optics.render import Renderer
    from tacsim.optics.surface import surface_map

    calibration, grid = made_up(320), CanonicalGrid()
    world, _ = press(press_scene(Sphere(radius=BALL), 1e-3), DEPTH)
    surface = world.surface("lower")
    model = SensorModel(geometry=calibration.geometry, photometric=calibration.forward, texture=0.0)
    render = Renderer(model, (20e-3, 20e-3))
    normalise = normaliser_for_calibration(calibration, grid)
    flat = replace(surface, displacement=np.zeros_like(surface.displacement))
    normalise.take_reference(TactileFrame(render(flat), time=0.0, index=0))
    frame = TactileFrame(render(surface), time=0.0, index=0)
    timing, observation = timed(partial(normalise, frame, 0.0), max(repeat, MIN_REPETITIONS))
    truth = surface_map(surface, grid, None).height
    assert observation.height is not None
    error = float(np.sqrt(np.mean((observation.height - truth)[truth > 0.1 * DEPTH] ** 2))) / DEPTH * 100.0
    return [
        Measurement(
            timing, error, "% of depth", "the height that the simulation knows, rms where it is pressed", "320 x 240",
        )
    ]  # fmt: skip


CASES = (
    *(
        Case("real", RENDER, "tacsim", f"{width} px wide", partial(calibrated_render, width), cpu=True)
        for width in (640, 320)
    ),
    Case("real", NORMALISE, "tacsim", "320 px wide", normaliser, cpu=True),
)
