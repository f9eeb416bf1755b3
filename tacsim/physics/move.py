"""What one motion of a world is asked for, and how it went."""

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
    """How one motion went."""

    substeps: int  # explicit substeps of motion and hold together
    hold: int  # of which hold
    residual: float  # largest relative force imbalance or change at the end, or change still to come [-]
    # residual <= the scene's tolerance; and of an indenter with friction: slid as it can be followed
    # (tacsim.physics.motion.slide), of a body: moved no faster than it bears
    settled: bool
    overlap: float  # deepest overlap of body (or indenter) and gel surface in the last substep [m]
    # times a guard changed the physics (particles set aside, gaps capped), found gels in one another, or tension in a
    # body grow beyond what it can bear (tacsim.physics.worlds.hybrid)
    guard_hits: int
    retries: int = 0  # times the motion was started again with half the time step
    load_error: float = 0.0  # largest |force - load| of the sensors that hold a load [N]
    time_step: float = 0.0  # of the last substep, as the distance that the gel's pressure wave travels in it [m]
    damping: float = 0.0  # of the gel in the last substep: its rate times the wave's time through the gel [-]
    gel_overlap: float = 0.0  # deepest overlap of the two gels with one another at the end, which they do not feel [m]
    courant: float = 0.0  # largest time step / time of the wave through the most squeezed element or grid cell [-]
    # least and largest elastic volume ratio of the body's particles at the end [-]; a body led to and fro keeps them
    smallest_volume: float = 1.0
    largest_volume: float = 1.0
    # layers of particles over the body's mean height at the end (0: no body); whether they are fewer than MIN_LAYERS
    particle_layers: float = 0.0
    few_layers: bool = False
    # share of the force between the sensors that the hold took from a body that yields, of what is left [-]: the stress
    # that the speed itself cost
    force_loss: float = 0.0


@dataclass(frozen=True, slots=True)
class MoveCommand:
    """What one motion of a world is asked for; see `World.move`."""

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
