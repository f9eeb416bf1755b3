"""Motions that identify a material: scripts of targets for `tacsim run RIG --policy FILE.csv`."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from itertools import pairwise

from robot.studies.tuning import (
    BODY_SLIDE_SHARE,
    BODY_STEP,
    PRESS_DEPTH,
    SLIDE,
    SLIDE_DEPTH,
    SLIDE_SQUEEZE_SHARE,
    SQUEEZE_SHARE,
    STEP,
    TILT_BACK,
    TILT_DEPTH,
    TILT_RELEASE,
    TILT_SLIDE,
)
from tacsim.geometry.shapes import bounding_size
from tacsim.models.scene import Scene

TILT = math.radians(16.0)  # gels whose angles of friction differ by less than this both slip
REST = 3  # periods without contact, before and after it: they give the zero of the force
CLEAR = 0.3e-3  # distance of a gel from the object before and after contact [m]
TURN = math.radians(2.0)  # rotation of a gel in a step

MOTIONS_FOR_PARAMETER = {
    "gel": {"youngs_modulus": "press", "poisson_ratio": "press", "friction": "slide"},
    "body": {
        "youngs_modulus": "squeeze", "yield_stress": "squeeze", "hardening_modulus": "squeeze",
        "friction_upper": "tilt", "friction_lower": "tilt",
    },
}  # fmt: skip
MOTION_TEXTS = {
    "press": "a ball pressed by a quarter of the gel's thickness, with heights recorded (a calibrated sensor)",
    "slide": "a gel pressed, then slid sideways until it slips",
    "squeeze": "the body squeezed by two fifths of its height, with a short release during the motion",
    "tilt": "the upper gel tilted by 16 degrees, slid along the lower gel's face and back along its own: forward the "
    "lower gel slips, back the upper one, unless their angles of friction (arctan of the coefficient) differ by more",
}
Row = tuple[float, float, float]  # x, z [m], tilt about y [rad], along the axes of the sensor at the start


def motions(scene: Scene) -> dict[str, str]:
    """Tables of targets by the name of the motion."""
    if scene.indenter is not None:
        thickness = scene.gel.size[2]
        return {
            "press": _csv_text("lower", _press_path(PRESS_DEPTH * thickness)),
            "slide": _csv_text("lower", _slide_path(SLIDE_DEPTH * thickness)),
        }
    assert scene.body is not None
    height = float(bounding_size(scene.body.geometry)[2])
    width = float(bounding_size(scene.body.geometry)[0])
    return {
        "squeeze": _csv_text("upper", _squeeze_path(height)),
        "slide": _csv_text("upper", _drag_path(height)),
        "tilt": _csv_text("upper", _tilt_path(height, width)),
    }


def _press_path(depth: float) -> list[Row]:
    down = _line_points((0, -CLEAR, 0), (0, depth, 0), STEP)
    return [*[(0.0, -CLEAR, 0.0)] * REST, *down, *down[::-2], *[(0.0, -CLEAR, 0.0)] * REST]


def _slide_path(depth: float) -> list[Row]:
    forth = _line_points((0, depth, 0), (SLIDE, depth, 0), 2 * STEP)
    back = _line_points((SLIDE, depth, 0), (SLIDE, -CLEAR, 0), 2 * STEP)
    return [*[(0.0, -CLEAR, 0.0)] * REST, *_line_points((0, -CLEAR, 0), (0, depth, 0), STEP), *forth, *back,
            *[(SLIDE, -CLEAR, 0.0)] * REST]  # fmt: skip


def _squeeze_path(height: float) -> list[Row]:
    step, closed = BODY_STEP * height, SQUEEZE_SHARE * height
    half = closed / 2
    legs = [(-CLEAR, half), (half, half - 2 * step), (half - 2 * step, closed), (closed, closed - 5 * step)]
    path = [row for a, b in legs for row in _line_points((0, a, 0), (0, b, 0), step)]
    end = (0.0, closed - 5 * step, 0.0)
    return [*[(0.0, -CLEAR, 0.0)] * REST, *path, *[end] * REST]


def _drag_path(height: float) -> list[Row]:
    far, deep, step = BODY_SLIDE_SHARE * height, SLIDE_SQUEEZE_SHARE * height, BODY_STEP * height
    path = _line_points((0, -CLEAR, 0), (0, deep, 0), step) + _line_points((0, deep, 0), (far, deep, 0), 2 * step)
    path += _line_points((far, deep, 0), (0, deep, 0), 2 * step) + _line_points((0, deep, 0), (0, -CLEAR, 0), 2 * step)
    return [*[(0.0, -CLEAR, 0.0)] * REST, *path, *[(0.0, -CLEAR, 0.0)] * REST]


def _tilt_path(height: float, width: float) -> list[Row]:
    """The gel is lifted before the tilt, because an edge that turns into the body pushes it off the other gel. The
    pressure is reduced before the slide, because a yielding body shears under the gel instead of slipping."""
    lift = CLEAR + width / 2 * math.sin(TILT)  # until an edge makes contact
    eased, step = (TILT_DEPTH - TILT_RELEASE) * height, BODY_STEP * height
    turns = [
        (0.0, -lift, TILT), (0.0, TILT_DEPTH * height, TILT), (0.0, eased, TILT), (TILT_SLIDE * height, eased, TILT),
        (-TILT_BACK * height, eased + (TILT_SLIDE + TILT_BACK) * height * math.tan(TILT), TILT),  # along its face
    ]  # fmt: skip
    path = [row for a, b in pairwise(turns) for row in _line_points(a, b, 1.5 * step if b[0] else step)]
    end = (turns[-1][0], -lift, TILT)
    lifted = [*_line_points((0, 0, 0), (0, -lift, 0), CLEAR), *_line_points((0, -lift, 0), turns[0], step)]
    return [*lifted, *[turns[0]] * REST, *path, *_line_points(turns[-1], end, 2 * step), *[end] * REST]


def _line_points(a: Sequence[float], b: Sequence[float], step: float) -> list[Row]:
    """From a to b in equal steps, without a."""
    count = max(1, math.ceil(max(math.dist(a[:2], b[:2]) / step, abs(b[2] - a[2]) / TURN) - 1e-9))
    found = []
    for k in range(1, count + 1):
        s = k / count
        x, z, tilt = (p + (q - p) * s for p, q in zip(a, b, strict=True))
        found.append((x, z, tilt))
    return found


def _csv_text(arm: str, rows: Sequence[Row]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f"{arm}.x", f"{arm}.z", f"{arm}.ry"])
    table.writerows([[f"{value:.6g}" for value in row] for row in rows])
    return text.getvalue()
