"""Command and result of one motion of a world."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

from tacsim.interface import Pose

MIN_LAYERS = 12  # of particles over a body's height: with fewer its forces are too high (docs/physics.md)


@cache
def warn_of_few_layers() -> None:
    """Writes one line to the terminal (stderr), once a process."""
    logging.getLogger("tacsim").warning(
        f"warning: a body has fewer than {MIN_LAYERS} layers of particles over its height: its forces are too high "
        f"(draft or standard has more)"
    )


@dataclass(frozen=True, slots=True)
class MoveStats:
    """Result of one motion."""

    substeps: int  # explicit substeps of motion and hold together
    hold: int  # substeps of the hold
    residual: float  # largest relative force imbalance, force change at the end, or expected further change [-]
    # residual <= the scene's tolerance. In addition, for an indenter with friction: the slide is within the limits of
    # tacsim.physics.motion.slide; for a body: the speed is within its limits
    settled: bool
    overlap: float  # deepest overlap of body (or indenter) and gel surface in the last substep [m]
    # number of times that a guard changed the physics (particles removed, overlaps limited), or found that gels
    # overlap or that the tension in a body grew above its limit (tacsim.physics.worlds.hybrid)
    guard_hits: int
    retries: int = 0  # number of times that the motion was started again with half the time step
    load_error: float = 0.0  # largest |force - load| of the sensors that hold a load [N]
    time_step: float = 0.0  # of the last substep, as the distance that the gel's pressure wave travels in it [m]
    damping: float = 0.0  # of the gel in the last substep: its rate times the wave's time through the gel [-]
    gel_overlap: float = 0.0  # deepest overlap of the two gels at the end; no contact force acts between gels [m]
    courant: float = 0.0  # largest time step / time of the wave through the most compressed element or grid cell [-]
    # smallest and largest elastic volume ratio of the body's particles at the end [-]
    smallest_volume: float = 1.0
    largest_volume: float = 1.0
    # layers of particles over the body's mean height at the end (0: no body); whether there are fewer than MIN_LAYERS
    particle_layers: float = 0.0
    few_layers: bool = False
    # decrease of the force between the sensors during the hold of a body that yields, over the force at the end [-]:
    # stress that is caused by the speed of the motion
    force_loss: float = 0.0


@dataclass(frozen=True, slots=True)
class MoveCommand:
    """Arguments of one motion; see `World.move`."""

    targets: Mapping[str, Pose]
    loads: Mapping[str, float] = field(default_factory=dict)
    duration: float | None = None
    flow: bool = False

    def __post_init__(self) -> None:
        """Raises ValueError for options that exclude each other."""
        if bool(self.loads) + (self.duration is not None) + self.flow > 1:
            raise ValueError(
                "loads, duration and flow exclude one another: a load is held in settled states, a duration makes a "
                "motion dynamic, and a flowing motion does not come to rest; give one of them"
            )
