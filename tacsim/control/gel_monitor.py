"""Guards of the gels: the depth and shear that the sensors show, against the limits of the arms that carry them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from tacsim.interface import GelReading, SensorSpec, TactileObservation
from tacsim.limits import LimitExceeded, exceeds_limit
from tacsim.models.hardware import ArmLimits


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
