"""Rigid indenters compared with an independent solver: balls, punches, twists, slides."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from benchmarks.harness.measure import Measurement, Timing, once
from benchmarks.harness.runner import Case
from benchmarks.truth import finite_elements as truth
from tacsim.models.scene import Cylinder, Indenter, Scene, Shape, Sphere

if TYPE_CHECKING:
    from robot.studies.press import PressResult

FINE = "h 0.25 mm"  # no preset: half of standard's spacings
RESOLUTIONS = ("learn", "draft", "standard", FINE)


def balls(resolution: str, repeat: int) -> list[Measurement]:
    """Balls pressed without friction, and deep with friction: force and contact radius, as in `tacsim press`."""
    rows = []
    for (radius, depth), (force, contact) in truth.BALLS.items():
        what = f"ball R {radius:g} mm, {depth:g} mm deep"
        timing, found = _press(resolution, Sphere(radius=radius * 1e-3), 0.0, depth * 1e-3)
        rows.append(comparison_row(timing, f"{what}: force", "n", _normal_force(found), force, _settling_note(found)))
        rows.append(
            comparison_row(
                timing, f"{what}: contact radius", "mm", found.contact_radius * 1e3, contact, _settling_note(found)
            )
        )
    for depth, force in truth.BALL_WITH_FRICTION.items():
        timing, found = _press(resolution, Sphere(radius=4e-3), 0.6, depth * 1e-3)
        what = f"ball R 4 mm, {depth:g} mm deep, friction 0.6: force"
        rows.append(comparison_row(timing, what, "n", _normal_force(found), force, _settling_note(found)))
    return rows


def punches(resolution: str, repeat: int) -> list[Measurement]:
    """Flat punches with sharp edges, 0.1 mm deep: force without friction, and the moment of a sticking punch that is
    twisted by a degree."""
    rows, depth, angle = [], 0.1e-3, math.radians(1.0)
    for radius, force in truth.PUNCHES.items():
        shape = Cylinder(radius=radius * 1e-3, height=4e-3)
        timing, found = _press(resolution, shape, 0.0, depth)
        rows.append(
            comparison_row(
                timing, f"flat punch R {radius:g} mm: force", "n", _normal_force(found), force, _settling_note(found)
            )
        )
    for radius, share in truth.TWISTS.items():
        shape = Cylinder(radius=radius * 1e-3, height=4e-3)
        timing, found = _press(resolution, shape, 5.0, depth, twist=angle)
        moment = share * 16 / 3 * truth.SHEAR_MODULUS * radius**3 * angle  # [N mm]
        what = f"flat punch R {radius:g} mm, twisted by a degree: moment"
        rows.append(comparison_row(timing, what, "nmm", found.wrench[5] * 1e3, moment, _settling_note(found)))
    return rows


def slides(resolution: str, repeat: int) -> list[Measurement]:
    """A ball R 4 mm, slid by 2 mm at the default speed: drag over normal force."""
    rows = []
    for (depth, friction), ratio in truth.SLIDES.items():
        timing, found = _press(resolution, Sphere(radius=4e-3), friction, depth * 1e-3, slide=2e-3)
        what = f"ball slid {depth:g} mm deep, friction {friction:g}: drag over normal force"
        rows.append(
            comparison_row(timing, what, "ratio", found.wrench[0] / _normal_force(found), ratio, _settling_note(found))
        )
    return rows


def comparison_row(
    timing: Timing, what: str, unit: str, found: float, true: float, note: str = "",
    figures: Mapping[str, float] | None = None,
) -> Measurement:  # fmt: skip
    """A row of the table of pages/oracles.py: the value found and the true one, in `unit`."""
    both = {f"found_{unit}": float(found), f"truth_{unit}": true, **(figures or {})}
    return Measurement(timing, abs(found / true - 1) * 100, "%", truth.WORDS, what, figures=both, note=note)


def _press(
    resolution: str, shape: Shape, friction: float, depth: float, slide: float = 0.0, twist: float = 0.0
) -> tuple[Timing, PressResult]:
    from robot.studies.press import PressMotion, press  # loads Taichi
    from tacsim.config import load_sensor

    fineness = {"element_size": 0.25e-3} if resolution == FINE else {"preset": resolution}
    sharp = 0.0 if isinstance(shape, Cylinder) else None  # as in the solver
    indenter = Indenter(geometry=shape, friction=friction, edge_radius=sharp)
    scene = Scene.model_validate({"body": None, "indenter": indenter, **fineness})
    return once(lambda: press(scene, load_sensor("ideal"), PressMotion(depth, (slide, 0.0), twist)))


def _normal_force(found: PressResult) -> float:
    return -float(found.wrench[2])


def _settling_note(found: PressResult) -> str:
    return "" if all(move.settled for move in found.moves) else "not settled"


CASES = tuple(
    Case("oracles", measure.__name__, "tacsim", resolution, partial(measure, resolution), long=resolution == FINE)
    for measure in (balls, punches, slides)
    for resolution in RESOLUTIONS
)
