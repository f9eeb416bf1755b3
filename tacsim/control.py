"""Control of an arm on any rig: the contact signal and the approach until touch, guards of the gels, and a constant
load. NumPy only.

Constant load: an arm follows its targets except along the z of its sensor, where a force is held. An arm that takes
poses holds a force by moving until it feels it (position-based force control: Villani and De Schutter, Force Control,
in Springer Handbook of Robotics, 2nd ed., 2016, ch. 9). Each control period the force gives the next correction, by a
stiffness that is learned from what the corrections before did. It needs poses and wrenches alone, so it is the same for
simulated, mock and real arms, and every command still passes their limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacsim import pose as se3
from tacsim.interface import Action, ArmState, FloatArray, GelReading, Mask, Pose, SensorSpec, TactileObservation
from tacsim.limits import LimitExceeded, exceeds_limit

if TYPE_CHECKING:
    from tacsim.models.limits import ArmLimits
    from tacsim.models.task import TaskConfig

# Tuned constants. Sources: the tests in tests/tacsim/test_control.py.
MIN_CONTACT_HEIGHT = 20e-6  # deeper than this counts as contact: ten times the usual gel texture of 2 um [m]
MIN_CONTACT_DIFFERENCE = 0.10  # relative change of colour that counts as contact; camera noise is 0.02 to 0.03 [-]
LOAD_TOLERANCE = 0.01  # of the load: an error within it is left alone, so an arm at its load rests
MAX_TRAVEL = 5e-3  # farthest from where the arm began along z; beyond, the load counts as out of reach [m]


def contact_signal(observation: TactileObservation) -> float:
    """Mean of |I - I0| / mean(I0) over valid pixels and channels [-]: 0 without contact, grows with the press.

    Reads the 8-bit canonical image, so changes beyond a full mean(I0) saturate at 1. Raises ValueError when no pixel is
    valid or when the image is no whole multiple of the `valid` mask.
    """
    valid = pixel_mask(observation.valid, observation.image.shape[:2])
    if not valid.any():
        raise ValueError("contact_signal: no valid pixel; does the canonical grid overlap the gel?")
    return float(np.abs(observation.image[valid].astype(np.int16) - 128).mean() / 128.0)


def pixel_mask(cells: Mask, shape: tuple[int, int]) -> Mask:
    """A mask over grid cells (h, w), spread to the pixels (H, W) of the canonical image. Raises ValueError if H, W are
    no whole multiple of h, w."""
    scale = shape[0] // cells.shape[0]
    if scale < 1 or shape != (cells.shape[0] * scale, cells.shape[1] * scale):
        raise ValueError(f"image of {shape} pixels is no whole multiple of the canonical grid of {cells.shape} cells")
    return np.repeat(np.repeat(cells, scale, axis=0), scale, axis=1)


class NoTouch(RuntimeError):
    """An approach met nothing, or found no gentle contact."""


class ObjectDropped(RuntimeError):
    """A rigid object that was held falls, or no pad touches it any more."""


def approach(
    touches: Callable[[], bool], advance: Callable[[float], None], step: float, longest: float, advice: str
) -> float:
    """Moves ahead in equal steps until something is touched. Returns the distance travelled [m].

    For rigs that cannot undo a motion; a simulated world can (tacsim.sim.reset.approach_force).

    Args:
        touches: whether the gels touch by now; asked before every step.
        advance: goes this far [m] from where the approach began, and returns once the gels were observed there.
        step: between two contact checks [m].
        longest: the approach ends here [m].
        advice: what a person may do about it when nothing was touched.

    Raises NoTouch at the end of the approach, and what `touches` and `advance` raise.
    """
    distance = 0.0
    while not touches():
        distance += step
        if distance > longest:
            raise NoTouch(f"no touch after an approach of {1e3 * longest:.3g} mm; {advice}")
        advance(distance)
    return distance


def depth_and_shear(tactile: TactileObservation) -> tuple[float, float]:
    """Depth and shear [m] that one sensor shows; NaN where it does not measure them."""
    depth = shear = math.nan
    if tactile.height is not None:
        depth = float(tactile.height.max(where=tactile.valid, initial=0.0))
    if tactile.flow is not None:
        dragged = np.linalg.norm(tactile.flow, axis=-1)
        shear = float(np.nanmax(dragged)) if np.isfinite(dragged).any() else math.nan
    return depth, shear


class GelMonitor:
    """Checks every observation: reports to each arm the state of its gels, and raises LimitExceeded beyond its limits.

    Args:
        sensors: what each sensor of the rig delivers.
        limits: of the arms that have any, by arm name.
        report: for arms that also monitor their gels themselves (robot.arm.ur); by arm name.
        error: raised when a limit is exceeded.

    Raises ValueError for a limit that cannot be monitored, because no sensor of its arm delivers height or flow.
    """

    def __init__(
        self,
        sensors: Mapping[str, SensorSpec],
        limits: Mapping[str, ArmLimits],
        report: Mapping[str, Callable[[GelReading], None]],
        error: type[LimitExceeded] = LimitExceeded,
    ) -> None:
        self._arm_of = {name: spec.arm for name, spec in sensors.items() if spec.arm is not None}
        self._limits, self._report, self._error = dict(limits), dict(report), error
        for name, arm in self._arm_of.items():
            limits_of_arm = limits.get(arm)
            if limits_of_arm is None:
                continue
            spec = sensors[name]
            for what, limit, measured in (
                ("depth", limits_of_arm.depth, spec.height),
                ("shear", limits_of_arm.shear, spec.flow),
            ):
                if limit is not None and not measured:
                    raise ValueError(
                        f"arms.{arm}.limits.{what}: sensor '{name}' does not measure it (no calibration, no markers): "
                        "leave it out, or calibrate the sensor"
                    )

    def __call__(self, tactile: Mapping[str, TactileObservation]) -> None:
        """`tactile`: by sensor name. Every arm gets its report before anything is raised."""
        exposed = min((observation.time for observation in tactile.values()), default=math.nan)
        measured = {name: depth_and_shear(tactile[name]) for name in self._arm_of if name in tactile}
        for arm, report in self._report.items():
            limits_of_arm = [found for name, found in measured.items() if self._arm_of[name] == arm] or [
                (math.nan, math.nan)
            ]
            report(
                GelReading(exposed, *np.max(limits_of_arm, axis=0).tolist())
            )  # NaN if any is: not measured is not safe
        for name, found in measured.items():
            arm = self._arm_of[name]
            limits = self._limits.get(arm)
            if limits is None:
                continue
            for what, value, limit in zip(("depth", "shear"), found, (limits.depth, limits.shear), strict=True):
                if exceeds_limit(value, limit):
                    assert limit is not None
                    shown_as = "is not measured (markers lost?)" if math.isnan(value) else f"{1e3 * value:.3g} mm"
                    raise self._error(
                        f"gel of sensor '{name}': {what} {shown_as}, limits.{what} of arm '{arm}' is "
                        f"{1e3 * limit:.3g} mm; the arms are stopped. Move them apart, then begin a new episode"
                    )


@dataclass
class _AxisState:
    """One arm's z: where it began, its last force, and where it was last sent."""

    began: FloatArray  # (3,) [m]
    before: tuple[FloatArray, float]  # (3,) position [m] and force [N] of the period before
    sent: Pose
    stiffness: float | None = None  # [N/m]


class LoadController:
    """Secant force control: changes the actions of a policy so that arms hold `loads` along the z of their sensors.

    Call it once a control period with the action and the latest arm states, then `record_sent_poses` with the poses
    that were sent. It replaces only the displacement along z; an arm without a target still follows its load.
    """

    def __init__(self, loads: Mapping[str, float], max_correction: float) -> None:
        """loads: normal force by arm name, > 0 when pressed [N]; longest: correction of one period, > 0 [m]."""
        self.loads, self._max_correction = dict(loads), max_correction
        self._axes: dict[str, _AxisState] = {}

    def reset(self) -> None:
        """For a new episode: forgets stiffness and travel."""
        self._axes = {}

    def __call__(self, action: Action, arms: Mapping[str, ArmState]) -> Action:
        """`action` with each loaded arm's displacement along z replaced. Raises LimitExceeded when a load is out of
        reach, or a force is not finite."""
        held = {name: self._loaded_target(name, action.tool.get(name), arms[name]) for name in self.loads}
        return Action({**action.tool, **held}, action.grippers)

    def record_sent_poses(self, poses: Mapping[str, Pose | None]) -> None:
        """What the arms were really sent, after their limits; None: nothing was executed."""
        for name, axis in self._axes.items():
            axis.sent = poses.get(name) or axis.sent

    def _loaded_target(self, name: str, requested: Pose | None, arm: ArmState) -> Pose:
        force = -float(arm.wrench[2])
        if not math.isfinite(force):
            raise LimitExceeded(f"arm '{name}' holds a load of {self.loads[name]:g} N, but feels {force} N")
        here = arm.pose.position
        axis = self._axes.setdefault(name, _AxisState(here, (here, force), arm.pose))
        normal = se3.rotation_matrix(arm.pose)[:, 2]
        self._update_stiffness(axis, float(normal @ (here - axis.before[0])), force)
        axis.before = here, force
        requested = axis.sent if requested is None else requested
        normal = se3.rotation_matrix(requested)[:, 2]
        step = self._next_correction(axis, self.loads[name], force)
        if abs(travel := float(normal @ (axis.sent.position - axis.began)) + step) > MAX_TRAVEL:
            raise LimitExceeded(
                f"arm '{name}' does not reach its load of {self.loads[name]:g} N: it feels {force:.3g} N after "
                f"{1e3 * travel:+.3g} mm along its sensor's z (limit {1e3 * MAX_TRAVEL:g} mm); is there anything to "
                "press?"
            )
        along = normal @ (axis.sent.position - requested.position) + step
        return Pose(requested.position + along * normal, requested.quaternion)

    def _update_stiffness(self, axis: _AxisState, displacement: float, force: float) -> None:
        """The stiffness from the last displacement along z [m] and the force after it [N]; a force that fell as the
        sensor pressed came from elsewhere (the body slid, tipped or yielded) and teaches nothing."""
        # Largest change of stiffness a period, as forces are noisy; smaller towards soft, where corrections are longer
        down = 1.25
        # Largest change of stiffness a period, as forces are noisy; smaller towards soft, where corrections are longer
        up = 2.0
        min_displacement = 1e-6  # a shorter displacement gives no stiffness [m]
        change = force - axis.before[1]
        if abs(displacement) < min_displacement or not change / displacement > 0:
            return
        found = change / displacement
        known = axis.stiffness
        axis.stiffness = found if known is None else min(max(found, known / down), known * up)

    def _next_correction(self, axis: _AxisState, load: float, force: float) -> float:
        """The next correction, positive towards the object [m]."""
        probe_share = 0.1  # of the longest correction: the length of one while no stiffness is known
        error = load - force
        if abs(error) <= LOAD_TOLERANCE * load:
            return 0.0
        if axis.stiffness is None:
            return math.copysign(probe_share * self._max_correction, error)
        return max(-self._max_correction, min(self._max_correction, error / axis.stiffness))


def load_controller(task: TaskConfig | None) -> LoadController | None:
    """The controller of the loads of a rig's task; None if it asks for none."""
    return None if task is None or not task.held_loads else LoadController(task.held_loads, task.max_step)
