"""How two gels and the body between them answer to forces: masses, damping, contact stiffness, and the substep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.models.scene import Scene
from tacsim.physics.body.plasticine import BodyParams
from tacsim.physics.contact.contact import MEMORY_RATE
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

# dt / (smallest spacing / wave speed). At 0.8 the contact of body and gel fails, without a NaN.
COURANT = 0.5
# Damping of a driven motion falsifies its path, since gels yield and the body spreads; damping of the hold does not.
ZETA_GEL, ZETA_GEL_HELD = 0.8, 1.6  # zeta in rate = zeta c / thickness
ZETA_BODY, ZETA_BODY_HELD = 0.6, 1.2  # zeta in rate = zeta c / gel thickness, against the driven affine motion
ZETA_YIELDING_HELD = 0.3  # of a held body that yields: what creeps has only this drag to overcome
# Of a gel whose shear wave is at least so fast, over its pressure wave (nu 0.48): a nearly incompressible one gives way
# with that wave, and is damped less in proportion, or it creeps
FULLY_DAMPED = 0.196
# Of a path that mostly goes along the gels, and drags a body: one that swings beyond where it is led keeps that
ZETA_GEL_DRAGGED, ZETA_BODY_DRAGGED = 1.6, 1.2
# While motions flow: what drags a body makes forces too high, and what rings in the gel makes clay yield
ZETA_GEL_FLOWING, ZETA_BODY_FLOWING = 1.2, 0.3
# How nodes answer to forces: by their own acceleration, and by that filtered by (4 S - 1)^2, S the mean over the cells
# round them. What the mesh resolves, S = 1, is six times as light; the shortest waves, S = 0, are as heavy as they are.
TRUE_INERTIA = {OWN: 1.0, FILTERED: 0.0}
SELECTIVE_INERTIA = {OWN: 1 / 3, FILTERED: 2 / 3}
LIGHTER_GEL = SELECTIVE_INERTIA[OWN] + 9.0 * SELECTIVE_INERTIA[FILTERED]  # what the mesh resolves
FILTERED_RIGID = LIGHTER_GEL - 1.0  # lighter by this are rigid motions
# Of the contact's stiffness that particles and gel nodes bear one by one: all of them together are lighter. With all of
# it a cube of 40 layers went to and fro between its gels without end, 3.8 N on one and 2.1 on the other; not with 0.9.
# A heavier cube would stand still, too, but lag behind gels that drag it; with 0.65 slides are dragged 2 % less.
BORNE = 0.75
LARGEST_SHARE = 0.5  # of a particle's mass over the step's square: the largest stiffness of its contact


@dataclass(frozen=True, slots=True, eq=False)
class HybridInertia:
    """The two kinds of inertia of one scene's gels and body: scaled and true."""

    scene: Scene
    gels: Sequence[GelParams]
    body: BodyParams
    body_force: np.ndarray  # (3,) weight of the body [N/mm^3]

    def scaled(self, height: float, *, yields: bool) -> Inertia:
        """Of quasi-static motions; height: of the body [mm]."""
        step = COURANT * min(self.body.cell, *(gel.spacing for gel in self.gels))
        damping = {
            **self._gel_damping(ZETA_GEL), BODY_DAMPING: ZETA_BODY / self._thickness,
            # The body's slowest mode is its rigid translation between two soft gels: there it counts as lighter by
            # the number of particle layers.
            RIGID_MASS_SCALE: max(1.0, height / self.body.spacing - FILTERED_RIGID),
        }  # fmt: skip
        held = {
            **self._gel_damping(ZETA_GEL_HELD),
            BODY_DAMPING: (ZETA_YIELDING_HELD if yields else ZETA_BODY_HELD) / self._thickness,
        }
        densities = [gel.density for gel in self.gels]
        masses = {**self._masses(densities, self.body.density, step), **SELECTIVE_INERTIA, MEMORY: MEMORY_RATE}
        for g in range(len(self.gels)):
            # the filter makes a body lighter, so its particles bear less: between stiff gels they shook, untold
            bearable = LARGEST_SHARE * masses[BODY_MASS] / step**2
            masses[STIFFNESS + g] = BORNE * min(masses[STIFFNESS + g], bearable)
        flowing = {**self._gel_damping(ZETA_GEL_FLOWING), BODY_DAMPING: ZETA_BODY_FLOWING / self._thickness}
        dragging = {**self._gel_damping(ZETA_GEL_DRAGGED), BODY_DAMPING: ZETA_BODY_DRAGGED / self._thickness}
        return Inertia({**masses, **damping}, step, held=held, flowing=flowing, dragging=dragging)

    def _gel_damping(self, zeta: float) -> dict[int, float]:
        """Each gel by its own thickness and shear wave: rate = zeta c / thickness, less where that wave is slow."""
        shares = [min(1.0, math.sqrt(gel.mu / gel.density) / FULLY_DAMPED) for gel in self.gels]
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
        step = COURANT * min(self.body.cell / wave, *times)
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
