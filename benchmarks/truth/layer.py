"""Frictionless contact of a rigid indenter with a linear-elastic layer on a rigid base, by FFT: an independent oracle.

It shares no code with the finite elements: small strain, half-space kinematics, a periodic box much wider than the
contact. Use it to check forces and contact shapes of shallow presses (strain error grows with depth / radius).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

FloatArray = NDArray[np.float64]

TOLERANCE = 1e-6  # relative change of the pressure in one iteration at convergence
ITERATIONS = 500  # at most


@dataclass(frozen=True, slots=True, eq=False)
class LayerContact:
    """Equilibrium of an indenter on a layer."""

    pressure: FloatArray  # (n, n) [Pa]
    displacement: FloatArray  # (n, n) into the layer [m]
    pixel: float  # [m]

    @property
    def force(self) -> float:
        """[N]"""
        return float(self.pressure.sum()) * self.pixel**2


def compliance(k: FloatArray, thickness: float, youngs_modulus: float, poisson_ratio: float) -> FloatArray:
    """Normal surface displacement per pressure wave of wave number k [m/Pa], layer bonded to a rigid base.

    Johnson, Contact Mechanics (1985), and Bentall & Johnson 1968; k -> 0 is the confined (oedometer) compression.
    """
    nu = poisson_ratio
    q = np.minimum(np.maximum(k * thickness, 1e-6), 300.0)  # beyond 300 the layer is a half-space to machine precision
    ratio = ((3 - 4 * nu) * np.sinh(2 * q) - 2 * q) / (
        (3 - 4 * nu) * np.cosh(2 * q) + 2 * q * q + 5 - 12 * nu + 8 * nu * nu
    )
    wave = 2 * (1 - nu * nu) / (youngs_modulus * np.maximum(k, 1e-6 / thickness)) * ratio
    uniform = thickness * (1 + nu) * (1 - 2 * nu) / ((1 - nu) * youngs_modulus)
    return np.where(k == 0, uniform, wave)


def layer_contact(
    gap: FloatArray, depth: float, pixel: float, thickness: float, youngs_modulus: float, poisson_ratio: float
) -> LayerContact:
    """Presses a shape with undeformed `gap` (n, n) [m] (0 at its tip) by `depth` [m] into the layer.

    Solves p >= 0, u - (depth - gap) >= 0, p (u - (depth - gap)) = 0 by the conjugate-gradient method of Polonsky and
    Keer (Wear 231, 1999). Raises RuntimeError if it does not converge.
    """
    n = gap.shape[0]
    wave = 2 * np.pi * fft.fftfreq(n, pixel)
    k = np.hypot(wave[:, None], wave[None, : n // 2 + 1])
    kernel = compliance(np.abs(k), thickness, youngs_modulus, poisson_ratio)

    def displacement(p: FloatArray) -> FloatArray:
        return np.asarray(fft.irfft2(fft.rfft2(p) * kernel, s=(n, n)))

    target = depth - gap
    pressure = np.where(target > 0, youngs_modulus * np.maximum(target, 0) / thickness, 0.0)
    direction = np.zeros_like(pressure)
    norm_before, conjugate = 1.0, 0.0
    for _ in range(ITERATIONS):
        mismatch = displacement(pressure) - target  # negative: indenter overlaps the layer
        contact = pressure > 0
        norm = float((mismatch[contact] ** 2).sum())
        direction = np.where(contact, mismatch + conjugate * norm / norm_before * direction, 0.0)
        response = displacement(direction)
        step = float((mismatch * direction)[contact].sum() / (response * direction)[contact].sum())
        before = pressure
        pressure = np.maximum(pressure - step * direction, 0.0)
        open_overlap = (pressure == 0) & (mismatch < 0)
        conjugate = 0.0 if open_overlap.any() else 1.0
        pressure = np.where(open_overlap, pressure - step * mismatch, pressure)
        norm_before = norm
        if np.abs(pressure - before).sum() < TOLERANCE * pressure.sum():
            return LayerContact(pressure, displacement(pressure), pixel)
    raise RuntimeError(f"layer contact did not converge in {ITERATIONS} iterations; use a coarser grid")
