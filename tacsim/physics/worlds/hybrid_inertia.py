"""Inertia of two gels and the body between them: masses, damping, contact stiffness, and the substep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.models.scene import Scene
from tacsim.physics.body.plasticine import BodyParams
from tacsim.physics.contact.tuning import FORCE_MEMORY_RATE
from tacsim.physics.exec.layout import (
    BODY_DAMPING,
    BODY_MASS,
    FILTERED_WEIGHT,
    GEL_DAMPING,
    GEL_DENSITY,
    GRAVITY,
    MEMORY_SHARE,
    OWN_WEIGHT,
    RIGID_MASS_SCALE,
    STIFFNESS,
)
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.motion.inertia import Inertia, kernel_density, kernel_second
from tacsim.physics.worlds.tuning import (
    BODY_COURANT,
    BODY_ZETA,
    BODY_ZETA_DRAGGED,
    BODY_ZETA_FLOWING,
    BODY_ZETA_HELD,
    COLLECTIVE_STIFFNESS,
    FULL_DAMPING_SHEAR_SPEED,
    GEL_ZETA,
    GEL_ZETA_DRAGGED,
    GEL_ZETA_FLOWING,
    GEL_ZETA_HELD,
    MAX_PARTICLE_STIFFNESS,
    YIELDING_ZETA_HELD,
)

# Acceleration of a node: weight of its own, and of the one filtered by (4 S - 1)^2, S the mean over the cells around
# it. Motions that the mesh resolves, S = 1, have a sixth of the inertia; the shortest waves, S = 0, have all.
TRUE_INERTIA = {OWN_WEIGHT: 1.0, FILTERED_WEIGHT: 0.0}
SELECTIVE_INERTIA = {OWN_WEIGHT: 1 / 3, FILTERED_WEIGHT: 2 / 3}
# Factor by which the inertia is reduced for motions that the mesh resolves
LIGHTER_GEL = SELECTIVE_INERTIA[OWN_WEIGHT] + 9.0 * SELECTIVE_INERTIA[FILTERED_WEIGHT]
FILTERED_RIGID = LIGHTER_GEL - 1.0  # part of that factor from the filter, for rigid motions


@dataclass(frozen=True, slots=True, eq=False)
class HybridInertia:
    """The two kinds of inertia of one scene's gels and body: scaled and true."""

    scene: Scene
    gels: Sequence[GelParams]
    body: BodyParams
    body_force: np.ndarray  # (3,) weight of the body [N/mm^3]

    def scaled_inertia(self, height: float, *, yields: bool) -> Inertia:
        """Inertia of quasi-static motions; height: of the body [mm]."""
        step = BODY_COURANT * min(self.body.cell, *(gel.spacing for gel in self.gels))
        damping = {
            **self._gel_damping(GEL_ZETA), BODY_DAMPING: BODY_ZETA / self._thickness,
            # The body's slowest mode is its rigid translation between two soft gels: for it, the inertia is divided by
            # the number of particle layers.
            RIGID_MASS_SCALE: max(1.0, height / self.body.spacing - FILTERED_RIGID),
        }  # fmt: skip
        held = {
            **self._gel_damping(GEL_ZETA_HELD),
            BODY_DAMPING: (YIELDING_ZETA_HELD if yields else BODY_ZETA_HELD) / self._thickness,
        }
        densities = [gel.density for gel in self.gels]
        masses = {
            **self._masses(densities, self.body.density, step),
            **SELECTIVE_INERTIA,
            MEMORY_SHARE: FORCE_MEMORY_RATE,
        }
        for g in range(len(self.gels)):
            # the filter reduces the inertia, so the stable stiffness is smaller: between stiff gels particles
            # oscillated
            max_stiffness = MAX_PARTICLE_STIFFNESS * masses[BODY_MASS] / step**2
            masses[STIFFNESS + g] = COLLECTIVE_STIFFNESS * min(masses[STIFFNESS + g], max_stiffness)
        flowing = {**self._gel_damping(GEL_ZETA_FLOWING), BODY_DAMPING: BODY_ZETA_FLOWING / self._thickness}
        dragging = {**self._gel_damping(GEL_ZETA_DRAGGED), BODY_DAMPING: BODY_ZETA_DRAGGED / self._thickness}
        return Inertia({**masses, **damping}, step, held=held, flowing=flowing, dragging=dragging)

    def _gel_damping(self, zeta: float) -> dict[int, float]:
        """Damping of each gel: rate = zeta c / thickness, less where its shear wave is slow."""
        shares = [min(1.0, math.sqrt(gel.mu / gel.density) / FULL_DAMPING_SHEAR_SPEED) for gel in self.gels]
        rates = [zeta * share / gel.thickness for share, gel in zip(shares, self.gels, strict=True)]
        return {GEL_DAMPING + g: rate for g, rate in enumerate(rates)}

    def true_inertia(self) -> Inertia:
        """Inertia of motions in real time: the fastest pressure wave of the gels has speed 1."""
        assert self.scene.body is not None
        materials = [self.scene.gel_of(name).material for name in self.scene.sensors]
        seconds = [kernel_second(gel, each.density) for gel, each in zip(self.gels, materials, strict=True)]
        second = max(seconds)
        density = kernel_density(self.scene.body.material.density, second)
        densities = [gel.density * (second / own) ** 2 for gel, own in zip(self.gels, seconds, strict=True)]
        wave = math.sqrt(self.body.density / density)  # the body's pressure wave
        times = [gel.spacing * second / own for gel, own in zip(self.gels, seconds, strict=True)]
        step = BODY_COURANT * min(self.body.cell / wave, *times)
        undamped = {**self._gel_damping(0.0), BODY_DAMPING: 0.0, RIGID_MASS_SCALE: 1.0, MEMORY_SHARE: 0.0}
        return Inertia({**self._masses(densities, density, step), **TRUE_INERTIA, **undamped}, step, second)

    def _masses(self, gels: Sequence[float], body: float, step: float) -> dict[int, float]:
        """Entries of `params` that follow from the densities [MPa] and the substep [mm]."""
        particle = body * self.body.volume
        gravity = self.body_force / body  # [1/mm]
        entries = {BODY_MASS: particle, GRAVITY: gravity[0], GRAVITY + 1: gravity[1], GRAVITY + 2: gravity[2]}
        for g, (density, gel) in enumerate(zip(gels, self.gels, strict=True)):
            # penalty of one particle against its share of a gel node: stable for all ratios of their masses
            share = density * gel.spacing * self.body.spacing**2 / 2
            reduced = 1.0 / (1.0 / particle + 1.0 / share)
            entries |= {GEL_DENSITY + g: density, STIFFNESS + g: reduced / step**2}
        return entries

    @property
    def _thickness(self) -> float:
        """Thickness of the thickest gel [mm]."""
        return max(gel.thickness for gel in self.gels)
