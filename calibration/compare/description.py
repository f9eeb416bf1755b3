"""A comparison in one plain sentence."""

from __future__ import annotations

import math

from calibration.compare.compare import Comparison

CLOSE_CORRELATION = 0.95  # of the change of colour in contact, from which two sources look alike ...
CLOSE_SHARE = 0.25  # ... if their error there also is no larger share of what a picture without contact would score

SIDE_NAMES = {"simulated": "the simulation", "real": "the real sensor"}


def describe_comparison(comparison: Comparison) -> str:
    """Whether A looks like B in contact, and by how many grey levels and degrees."""
    a, b = (SIDE_NAMES.get(name, name) for name in comparison.names)
    error, alike = comparison.overall["contact_mae"], comparison.overall["contact_ncc"].mean
    if math.isnan(error.mean):
        return "No pair shows contact, so nothing can be judged."
    if error.beats_null is None:
        start = f"Too few pairs to judge how much {a} and {b} look alike in contact"
    elif not error.beats_null:
        start = f"In contact {a} looks no more like {b} than a picture without contact does"
    elif alike >= CLOSE_CORRELATION and error.mean <= CLOSE_SHARE * error.null:
        start = f"In contact {a} looks like {b}"
    else:
        start = f"In contact {a} resembles {b}, but is not close to it"
    floor = "" if math.isnan(error.floor) else f", noise alone by {error.floor:.1f}"
    picture = (
        f"they differ by {error.mean:.1f} grey levels, where no contact at all would differ by {error.null:.1f}"
        f"{floor}, and the change of colour correlates by {alike:.3f}"
    )
    normals, height = comparison.overall["gradient_angle"], comparison.overall["height_share"]
    surface = "" if math.isnan(normals.mean) else f"; normals are {normals.mean:.1f}° apart (flat: {normals.null:.1f}°)"
    surface += "" if math.isnan(height.mean) else f", heights {height.mean:.1%} of the indentation"
    return f"{start}: {picture}{surface}."
