"""Real group: balls pressed to a known depth, simulated from that depth alone, and rendered with a calibration by other
presses; pictures and heights against the real ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.cases.real import balls
from benchmarks.cases.real.balls import BallSet
from benchmarks.cases.real.contact_radius import ELEMENT, ball_scene, press_to
from benchmarks.cases.real.labels import BadData, PressLabel, PressLabels, read_frames, read_labels
from benchmarks.harness.measure import Measurement, Timing
from benchmarks.harness.runner import Case
from calibration.light.dent import Circle, NoCircle, find_contact_circle
from robot.studies.matched_press import place_surface
from tacsim.interface import FloatArray, Image, Mask
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid
from tacsim.physics.world import make_world

if TYPE_CHECKING:
    from calibration.light.fit import LightFit


CASE = "known_depth"
GRID = CanonicalGrid()
REACH = 1.3  # radius of the mask of a picture, in radii of the cap of the ball below the rest plane
HEIGHT_REACH = 1.5  # radius in which heights are compared, in radii of the Hertz contact


def light_of(folder: Path, labels: PressLabels) -> BallSet:
    """The ball presses that calibrate the sensor of the known depths. Raises BadData, ConfigError."""
    found = next((of for of in balls.read_sets(folder) if of.name == labels.light), None)
    if found is None:
        raise BadData(f"the labels of '{labels.name}' name no ball presses that calibrate its light (light:)")
    if not balls.has_frames(folder, found):
        raise BadData(f"no ball presses to calibrate the light by: no {found.wanted} below {folder}")
    return found


def known_depth(folder: Path, ball: float, repeat: int) -> list[Measurement]:
    """A ball pressed to a real press's depth, in calibrated light: picture and height. Seconds: press and picture."""
    labels = read_labels(folder)
    of = light_of(folder, labels)
    reference, frames = read_frames(folder, labels)
    fit, _, _ = balls.calibrated(folder, of)
    world = make_world(ball_scene((*labels.gel_size, labels.gel_thickness[0]), ball, ELEMENT))
    camera = CalibratedSensor(of, fit, labels.gel_size, reference)
    rows = []
    for press in sorted((p for p in frames if p.ball_radius == ball), key=lambda p: p.depth):
        real = _find_circle(press, frames[press], reference, labels)
        wall, cpu = perf_counter(), process_time()
        settled = press_to(world, ball, press.depth).settled
        image = camera.render_image(place_surface(world.surface("lower"), real.x, real.y, camera.model))
        timing = Timing((perf_counter() - wall,), process_time() - cpu)
        ours = _find_circle(press, image, reference, labels)  # light shifts it in the same way as the real one
        x, y = 2 * real.x - ours.x, 2 * real.y - ours.y
        surface = place_surface(world.surface("lower"), x, y, camera.model)
        image = camera.render_image(surface)
        cap = float(np.sqrt(2 * ball * press.depth - press.depth**2)) / labels.pixel_pitch
        mask = circle_mask(reference.shape[:2], x, y, REACH * cap)
        figures = compare_pictures(image, frames[press], reference, mask) | {"depth_mm": press.depth * 1e3}
        note = "" if settled else "not settled"
        rows.append(
            Measurement(
                timing, figures.pop("grey"), "grey", "the real frame within 1.3 radii of the cap",
                f"{press.name}: picture", None, figures, note,
            )
        )  # fmt: skip
        rows.append(_height_row(camera, surface, frames[press], press, (x, y), timing))
    return rows


class CalibratedSensor:
    """A simulated sensor with the calibration of a real one: renders surfaces, and finds them in real frames."""

    def __init__(self, of: BallSet, fit: LightFit, gel_size: tuple[float, float], reference: Image) -> None:
        from calibration.bundle import read_sensor_model, write_bundle
        from calibration.normaliser import normaliser_for_calibration
        from tacsim.interface import TactileFrame
        from tacsim.optics.render import Renderer

        calibration = fit.to_calibration("bench", of.ball_radius, of.pixel_pitch)
        with TemporaryDirectory() as place:
            write_bundle(Path(place), calibration, reference)
            self.model = read_sensor_model(Path(place))
            self._render = Renderer(self.model, gel_size)
        self._normalise = normaliser_for_calibration(calibration, GRID)
        self._normalise.take_reference(TactileFrame(reference, time=0.0, index=0))

    def render_image(self, surface: GelSurface) -> Image:
        return self._render(surface)

    def height(self, image: Image) -> FloatArray:
        """(h, w) height [m] on the canonical grid, by the inverse model."""
        from tacsim.interface import TactileFrame

        found = self._normalise(TactileFrame(image, time=0.0, index=0), 0.0).height
        assert found is not None
        return found.astype(np.float64)


def _find_circle(press: PressLabel, image: Image, reference: Image, labels: PressLabels) -> Circle:
    """The contact circle in the image. Raises BadData."""
    try:
        return find_contact_circle(image, reference, press.ball_radius / labels.pixel_pitch)
    except NoCircle as error:
        raise BadData(f"{press.name}: {error}") from None


def circle_mask(shape: Iterable[int], x: float, y: float, radius: float) -> Mask:
    """(H, W) within `radius` of x, y [px]."""
    rows, columns = shape
    v, u = np.mgrid[:rows, :columns]
    return np.asarray(np.hypot(u - x, v - y) < radius)


def compare_pictures(image: Image, real: Image, reference: Image, mask: Mask) -> dict[str, float]:
    """Similarity of two pictures inside `mask`, and that of the picture without contact."""
    from calibration.compare import metrics

    still = reference.astype(np.float64)
    return {
        "grey": metrics.mean_absolute_error(image, real, mask),
        "null_grey": metrics.mean_absolute_error(reference, real, mask),
        "ssim": metrics.structural_similarity(image, real, mask),
        "null_ssim": metrics.structural_similarity(reference, real, mask),
        "ncc": metrics.image_correlation(image - still, real - still, mask),
    }


def _height_row(
    camera: CalibratedSensor,
    surface: GelSurface,
    real: Image,
    press: PressLabel,
    at: tuple[float, float],
    timing: Timing,
) -> Measurement:
    """The row of the surface from the real frame, by the inverse model, against the simulated one."""
    from tacsim.optics.surface import surface_map

    (u0, v0), pitch = camera.model.geometry.principal, camera.model.geometry.pixel_pitch
    scale = pitch / GRID.pitch
    x, y = (at[0] - u0) * scale + (GRID.columns - 1) / 2, (at[1] - v0) * scale + (GRID.rows - 1) / 2
    near = circle_mask(
        (GRID.rows, GRID.columns), x, y, HEIGHT_REACH * np.sqrt(press.ball_radius * press.depth) / GRID.pitch
    )
    ours = surface_map(surface, GRID, None).height.astype(np.float64)
    found = camera.height(real)
    off = (found - ours)[near]
    percent = 100.0 / press.depth
    shape = float(np.sqrt(((off - np.median(off)) ** 2).mean())) * percent
    figures = {
        "whole_percent": float(np.sqrt((off**2).mean())) * percent,
        "null_percent": float(np.sqrt(((ours[near] - np.median(ours[near])) ** 2).mean())) * percent,
        "peak_ratio": float(found[near].max() / ours[near].max()),
        "depth_mm": press.depth * 1e3,
    }
    return Measurement(
        timing, shape, "% of depth", "the simulated surface at this depth, rms within 1.5 radii, median removed",
        f"{press.name}: height", None, figures,
    )  # fmt: skip


def cases(folder: Path) -> tuple[Case, ...]:
    """A case for each ball; balls without frames or light are marked as missing. Raises ConfigError."""
    labels = read_labels(folder)
    try:
        light_of(folder, labels)
        frames = read_frames(folder, labels)[1]
        lacking = ""
    except BadData as error:
        frames, lacking = {}, str(error)
    return tuple(
        Case(
            "real", CASE, "tacsim", f"ball R {ball * 1e3:g} mm, h {ELEMENT * 1e3:g} mm",
            partial(known_depth, folder, ball),
            missing=lacking or ("" if any(p.ball_radius == ball for p in frames) else "no frame of this ball"),
        )
        for ball in labels.balls
    )  # fmt: skip
