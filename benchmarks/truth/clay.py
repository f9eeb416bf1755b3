"""The cube of clay that every method compresses: its material, its time step, and its yield stress."""

from __future__ import annotations

from tacsim.models.material import BodyMaterial

CLAY = BodyMaterial(youngs_modulus=0.5e6, poisson_ratio=0.45, yield_stress=30e3)
COURANT = 0.4


def uniaxial_stress(force: float, volume: float, height: float) -> float:
    """Mean Kirchhoff stress of a prism [Pa]: force [N] over its section, which is its volume [m^3] over its height."""
    return force * height / volume
