"""Inertia of a scene: scaled densities with damping (quasi-static motions), or true densities (real time).

Quasi-static motions need the state at rest only. Each material has the density with which its pressure wave has speed
1, and is damped. A motion with a duration is dynamic: materials have their true densities, energy is dissipated only by
plastic flow, friction and the contact's dashpots, and contact has no memory, since memory would create energy. Kernel
units stay mm and MPa; the gel's pressure wave has speed 1, so a kernel time of 1 mm is the true time of this wave for 1
mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tacsim.interface import Pose
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.motion.controller import Launch
from tacsim.physics.motion.path import PEAK_SLOPE, Path, path_length
from tacsim.physics.motion.tuning import MAX_DRIVE_MACH, MAX_SUBSTEPS, ROUNDING
from tacsim.physics.units import MM, MPA


@dataclass(frozen=True)
class Inertia:
    """Entries of the array `params` (tacsim.physics.exec.layout) with masses, damping and stiffness, and the time
    scale.
    """

    params: Mapping[int, float]
    step: float  # nominal substep [mm]
    second: float = math.nan  # kernel time of one second [mm]; quasi-static motions have no real time
    held: Mapping[int, float] = field(default_factory=dict)  # entries that differ in holds
    flowing: Mapping[int, float] = field(default_factory=dict)  # in motions that pass their targets
    dragging: Mapping[int, float] = field(default_factory=dict)  # in motions that drag a body along the gels

    def entries(self, launch: Launch | None = None) -> dict[int, float]:
        """The entries for a launch; None: for a driven launch."""
        if launch is None:
            return dict(self.params)
        if launch.is_held:
            return {**self.params, **self.held}
        if launch.is_flowing:
            return {**self.params, **self.flowing}
        return {**self.params, **(self.dragging if launch.path.is_drag else {})}

    @property
    def real_time(self) -> bool:
        return math.isfinite(self.second)


def kernel_second(gel: GelParams, density: float) -> float:
    """Kernel time of one second [mm]: the distance of the pressure wave in a gel with `density` [kg/m^3]."""
    return math.sqrt(gel.density / MPA / density) * MM


def kernel_density(density: float, second: float) -> float:
    """`density` [kg/m^3] in kernel units [MPa], where a second lasts `second` [mm]: rho c^2."""
    return density * (second / MM) ** 2 * MPA


def plan_real_time(start: Sequence[Pose], end: Sequence[Pose], duration: float, inertia: Inertia, lever: float) -> Path:
    """The path of a dynamic motion; `lever` [mm]: see `fastest_point_motion`.

    Raises ValueError for a duration [s] that is not positive, has too many substeps or less than one, or in which a
    frame would come near the speed of the gel's own waves.
    """
    if not (math.isfinite(duration) and duration > 0):
        raise ValueError(f"duration is {duration:g} s: give a positive time, or None for a quasi-static motion")
    substep = inertia.step / inertia.second
    if not ROUNDING <= duration / substep <= MAX_SUBSTEPS:
        raise ValueError(
            f"duration is {duration:.3g} s; at substeps of {substep:.3g} s (of the materials) it must lie"
            f" between {ROUNDING * substep:.3g} and {MAX_SUBSTEPS * substep:.3g} s: is it in seconds? if so, divide it "
            f"into several motions"
        )
    kernel_time, wave = duration * inertia.second, inertia.second / MM
    peak = PEAK_SLOPE * path_length(start, end, lever) / kernel_time
    if peak > MAX_DRIVE_MACH:
        raise ValueError(
            f"within {duration:.3g} s a frame would reach {peak * wave:.3g} m/s; the limit is {MAX_DRIVE_MACH:g} of "
            f"the gel's wave speed, {MAX_DRIVE_MACH * wave:.3g} m/s: "
            f"give at least {duration * peak / MAX_DRIVE_MACH:.3g} s"
        )
    substeps = math.ceil(kernel_time / inertia.step)
    return Path(start, end, substeps, kernel_time / substeps)
