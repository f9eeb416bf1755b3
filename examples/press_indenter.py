"""Press a rigid ball on one gel, and compare force and contact with closed forms.

    python examples/press_indenter.py

A gel is a thin elastic layer on a rigid backing, so it is stiffer than the half-space of Hertz. Dimitriadis et al. 2002
(Biophysical Journal 82) give the force of a bonded layer of finite thickness.
"""

from __future__ import annotations

import math
import sys

from robot import PressMotion, press
from tacsim import load_scene, load_sensor

RADIUS, DEPTH = 4e-3, 0.3e-3  # of the ball, and how deep it is pressed [m]


def layer_force(modulus: float, poisson: float, thickness: float) -> float:
    """Force [N] on the ball, for an elastic layer that is bonded to a rigid backing."""
    a = -(1.2876 - 1.4678 * poisson + 1.3442 * poisson**2) / (1 - poisson)
    b = (0.6387 - 1.0277 * poisson + 1.5164 * poisson**2) / (1 - poisson)
    x = math.sqrt(RADIUS * DEPTH) / thickness / math.pi
    series = 1 - 2 * a * x + 4 * a**2 * x**2
    series -= 8 * (a**3 + 4 * math.pi**2 / 15 * b) * x**3
    series += 16 * a * (a**3 + 3 * math.pi**2 / 5 * b) * x**4
    return 4 / 3 * modulus / (1 - poisson**2) * math.sqrt(RADIUS * DEPTH**3) * series


def main() -> None:
    scene = load_scene("press", ["preset=draft", f"indenter.geometry.radius={RADIUS} m"])
    result = press(scene, load_sensor("ideal"), PressMotion(depth=DEPTH))
    force = -result.wrench[2]  # what the ball does to the sensor: pressing is negative
    gel = scene.gel
    expected = layer_force(gel.material.youngs_modulus, gel.material.poisson_ratio, gel.size[2])
    print(f"force {force:.3f} N, bonded layer {expected:.3f} N")
    print(f"contact radius {result.contact_radius * 1e3:.2f} mm, deepest {result.height.max() * 1e3:.3f} mm")

    if abs(force / expected - 1) > 0.05:
        sys.exit(f"the force is {force:.3f} N, more than 5 % from {expected:.3f} N")
    hertz = math.sqrt(RADIUS * DEPTH)  # of a half-space; a thin incompressible layer has up to sqrt(2) times that
    if not 0.9 * hertz < result.contact_radius < math.sqrt(2) * hertz:
        sys.exit(f"the contact radius is {result.contact_radius} m, Hertz has {hertz} m")


if __name__ == "__main__":
    main()
