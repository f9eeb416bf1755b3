"""How two gels and the body between them answer to forces: masses, damping, contact stiffness, and the substep."""

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
    FILTERED,
    GEL_DAMPING,
    GEL_DENSITY,
    GRAVITY,
    MEMORY,
    OWN,
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

# How nodes answer to forces: by their own acceleration, and by that filtered by (4 S - 1)^2, S the mean over the cells
# round them. What the mesh resolves, S = 1, is six times as light; the shortest waves, S = 0, are as heavy as they are.
TRUE_INERTIA = {OWN: 1.0, FILTERED: 0.0}
SELECTIVE_INERTIA = {OWN: 1 / 3, FILTERED: 2 / 3}
LIGHTER_GEL = SELECTIVE_INERTIA[OWN] + 9.0 * SELECTIVE_INERTIA[FILTERED]  # what the mesh resolves
FILTERED_RIGID = LIGHTER_GEL - 1.0  # lighter by this are rigid motions


@dataclass(frozen=True, slots=True, eq=False)
class HybridInertia:
    """The two kinds of inertia of one scene's gels and body: scaled and true."""

    scene: Scene
    gels: Sequence[GelParams]
    body: BodyParams
    body_force: np.ndarray  # (3,) weight of the body [N/mm^3]

    def scaled(self, height: float, *, yields: bool) -> Inertia:
        """Of quasi-static motions; height: of the body [mm]."""
        step = BODY_COURANT * min(self.body.cell, *(gel.spacing for gel in self.gels))
        damping = {
            **self._gel_damping(GEL_ZETA), BODY_DAMPING: BODY_ZETA / self._thickness,
            # The body's slowest mode is its rigid translation between two soft gels: there it counts as lighter by
            # the number of particle layers.
            RIGID_MASS_SCALE: max(1.0, height / self.body.spacing - FILTERED_RIGID),
        }  # fmt: skip
        held = {
            **self._gel_damping(GEL_ZETA_HELD),
            BODY_DAMPING: (YIELDING_ZETA_HELD if yields else BODY_ZETA_HELD) / self._thickness,
        }
        densities = [gel.density for gel in self.gels]
        masses = {**self._masses(densities, self.body.density, step), **SELECTIVE_INERTIA, MEMORY: FORCE_MEMORY_RATE}
        for g in range(len(self.gels)):
            # the filter makes a body lighter, so its particles bear less: between stiff gels they shook, untold
            bearable = MAX_PARTICLE_STIFFNESS * masses[BODY_MASS] / step**2
            masses[STIFFNESS + g] = COLLECTIVE_STIFFNESS * min(masses[STIFFNESS + g], bearable)
        flowing = {**self._gel_damping(GEL_ZETA_FLOWING), BODY_DAMPING: BODY_ZETA_FLOWING / self._thickness}
        dragging = {**self._gel_damping(GEL_ZETA_DRAGGED), BODY_DAMPING: BODY_ZETA_DRAGGED / self._thickness}
        return Inertia({**masses, **damping}, step, held=held, flowing=flowing, dragging=dragging)

    def _gel_damping(self, zeta: float) -> dict[int, float]:
        """Each gel by its own thickness and shear wave: rate = zeta c / thickness, less where that wave is slow."""
        shares = [min(1.0, math.sqrt(gel.mu / gel.density) / FULL_DAMPING_SHEAR_SPEED) for gel in self.gels]
        rates = [zeta * share / gel.thickness for share, gel in zip(shares, self.gels, strict=True)]
        return {GEL_DAMPING + g: rate for g, rate in enumerate(rates)}

    def true(self) -> Inertia:
        """Of motions in real time: the pressure wave of the gel in which it is fastest has speed 1."""
        assert self.scene.body is not None
        materials = [self.scene.gel_of(name).material for name in self.scene.sensors]
        seconds = [kernel_second(gel, each.density) for gel, each in zip(self.gels, materials, strict=True)]
        second = max(seconds)
        density = kernel_density(self.scene.body.material.density, second)
        densities = [gel.density * (second / own) ** 2 for gel, own in zip(self.gels, seconds, strict=True)]
        wave = math.sqrt(self.body.density / density)  # the body's pressure wave
        times = [gel.spacing * second / own for gel, own in zip(self.gels, seconds, strict=True)]
        step = BODY_COURANT * min(self.body.cell / wave, *times)
        undamped = {**self._gel_damping(0.0), BODY_DAMPING: 0.0, RIGID_MASS_SCALE: 1.0, MEMORY: 0.0}
        return Inertia({**self._masses(densities, density, step), **TRUE_INERTIA, **undamped}, step, second)

    def _masses(self, gels: Sequence[float], body: float, step: float) -> dict[int, float]:
        """Entries of `params` that follow from the densities [MPa] and the substep [mm]."""
        particle = body * self.body.volume
        gravity = self.body_force / body  # [1/mm]
        entries = {BODY_MASS: particle, GRAVITY: gravity[0], GRAVITY + 1: gravity[1], GRAVITY + 2: gravity[2]}
        for g, (density, gel) in enumerate(zip(gels, self.gels, strict=True)):
            # penalty of one particle against its share of a gel node: stable whichever of the two is lighter
            share = density * gel.spacing * self.body.spacing**2 / 2
            reduced = 1.0 / (1.0 / particle + 1.0 / share)
            entries |= {GEL_DENSITY + g: density, STIFFNESS + g: reduced / step**2}
        return entries

    @property
    def _thickness(self) -> float:
        """Of the thickest gel [mm]."""
        return max(gel.thickness for gel in self.gels)
