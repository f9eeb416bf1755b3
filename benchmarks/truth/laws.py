"""The same laws in float64 NumPy, written for clarity, as reference for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


def hencky_return(
    b: Matrix, plastic_strain: Matrix, mu: float, bulk: float, yield_strain: float, hardening: float
) -> tuple[Matrix, Matrix, Matrix]:
    """Von Mises return mapping on the Hencky strain of b (..., 3, 3), by eigenvalues; linear isotropic hardening.

    plastic_strain: (...) equivalent, so far: |dev strain| stays below yield_strain + hardening * plastic_strain (Simo &
    Hughes 1998, box 3.1). Returns the elastic left Cauchy-Green tensor after the return (..., 3, 3), the new plastic
    strain (...), and the Kirchhoff stress (..., 3, 3).
    """
    values, axes = np.linalg.eigh(b)
    strain = 0.5 * np.log(values)  # principal Hencky strains
    mean = strain.mean(axis=-1, keepdims=True)
    deviator = strain - mean
    norm = np.linalg.norm(deviator, axis=-1)
    root = np.sqrt(2.0 / 3.0)
    increment = np.maximum(norm - (yield_strain + hardening * plastic_strain), 0.0) / (1.0 + root * hardening)
    deviator = deviator * (1.0 - increment / np.maximum(norm, 1e-300))[..., None]
    stress = 2 * mu * deviator + bulk * 3 * mean
    elastic = np.exp(2 * (deviator + mean))
    return _from_principal(elastic, axes), np.asarray(plastic_strain + root * increment), _from_principal(stress, axes)


def _from_principal(values: Matrix, axes: Matrix) -> Matrix:
    return np.asarray(np.einsum("...ik,...k,...jk->...ij", axes, values, axes))


def neo_hookean(f: Matrix, mu: float, lam: float) -> Matrix:
    """First Piola-Kirchhoff stress P = mu (F - F^-T) + lambda ln(J) F^-T of F (..., 3, 3)."""
    inverse_transpose = np.swapaxes(np.linalg.inv(f), -1, -2)
    log_j = np.log(np.linalg.det(f))[..., None, None]
    return np.asarray(mu * (f - inverse_transpose) + lam * log_j * inverse_transpose)


def gel_forces(u: Matrix, spacing: float, mu: float, lam: float, hourglass: float) -> Matrix:
    """Internal nodal forces of a block of one-point hexahedra with hourglass stiffness; u (nx, ny, nz, 3) nodal."""
    corners = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    signs = 2.0 * np.array(corners) - 1.0  # (8, 3)
    nx, ny, nz = (n - 1 for n in u.shape[:3])
    local = np.stack([u[a : a + nx, b : b + ny, c : c + nz] for a, b, c in corners], axis=-2)  # (..., 8, 3)
    gradient = signs / (4 * spacing)
    f = np.eye(3) + np.einsum("...ai,aj->...ij", local, gradient)
    force = -(spacing**3) * np.einsum("...ij,aj->...ai", neo_hookean(f, mu, lam), gradient)
    s = signs
    modes = np.stack([s[:, 0] * s[:, 1], s[:, 1] * s[:, 2], s[:, 0] * s[:, 2], s[:, 0] * s[:, 1] * s[:, 2]])
    amplitude = np.einsum("ma,...ai->...mi", modes, local)
    force -= hourglass * 2 * mu * spacing / 8 * np.einsum("ma,...mi->...ai", modes, amplitude)
    total = np.zeros_like(u)
    for index, (a, b, c) in enumerate(corners):
        total[a : a + nx, b : b + ny, c : c + nz] += force[..., index, :]
    return total
