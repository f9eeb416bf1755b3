"""What the page shows of a rig: pictures as JPEG, numbers and words as JSON."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.arm.status import ArmStatus
from robot.rig.commanded_arm import CommandedArm
from robot.serve.errors import describe
from tacsim.control import contact_signal
from tacsim.interface import Arm, ArmState, FloatArray, Image, Observation, TactileFrame, TactileObservation
from tacsim.record.episode import ALIGNMENT, LIMITS_HIT, Step

QUALITY = 85  # of JPEG
MAX_WIDTH = 640  # of a picture [px]
FULL_COLOUR = 1e-3  # height that has the last colour of the map [m]
MAX_ARROWS = 20  # of the flow, along each side
PERIODS = ("period_median", "period_p99", "period_max", "periods_late")  # of the wall clock, in Step.info


@dataclass(frozen=True, slots=True)
class LiveView:
    """One moment of a rig.

    state: JSON of it, without its pictures. pictures: JPEG by "SENSOR/picture" and "SENSOR/height".
    """

    state: Mapping[str, Any]
    pictures: Mapping[str, bytes] = field(default_factory=dict)

    def encode(self) -> bytes:
        """One message: length of the JSON (uint32, big endian), the JSON with the length of each picture, pictures."""
        head = {**self.state, "pictures": {name: len(data) for name, data in self.pictures.items()}}
        text = json.dumps(head, allow_nan=False).encode()
        return struct.pack(">I", len(text)) + text + b"".join(self.pictures.values())


def view_of_frames(frames: Mapping[str, TactileFrame], arms: Mapping[str, ArmState], now: float) -> LiveView:
    """Pictures and arms without observations: during a reset, and before a reference is taken."""
    return LiveView(
        {
            "time": now,
            "sensors": {name: {"age": _number(now - frame.time)} for name, frame in frames.items()},
            "arms": {name: _describe_motion(arm) for name, arm in arms.items()},
        },
        {f"{name}/picture": encode_picture(frame.image) for name, frame in frames.items()},
    )


def view_of_observation(observation: Observation, frames: Mapping[str, TactileFrame]) -> LiveView:
    """Pictures, heights, flow and arms of an observation; frames: its native ones."""
    found = view_of_frames(frames, observation.arms, observation.time)
    pictures = dict(found.pictures)
    for name, touch in observation.tactile.items():
        if touch.height is not None:
            pictures[f"{name}/height"] = encode_picture(colour_heights(touch.height))
    sensors = {name: describe_touch(touch) for name, touch in observation.tactile.items()}
    return LiveView({**found.state, "sensors": sensors}, pictures)


def describe_touch(touch: TactileObservation) -> dict[str, Any]:
    """Numbers of one sensor: signal [-], depth [m], contact share [-], age [s], flow as arrows [mm]."""
    found: dict[str, Any] = {
        "signal": _number(contact_signal(touch)),
        "depth": None if touch.height is None else _number(touch.height.max()),
        "contact": _number(touch.contact[touch.valid].mean()) if touch.valid.any() else None,
        "age": _number(touch.age),
    }
    if touch.flow is not None:
        rows, columns = (max(1, -(-count // MAX_ARROWS)) for count in touch.flow.shape[:2])
        thinned = touch.flow[::rows, ::columns]
        found["flow"] = {
            "shape": thinned.shape[:2],
            "arrows": _numbers(np.nan_to_num(thinned).ravel() * 1e3, 4),
            "longest": _number(np.nan_to_num(np.linalg.norm(touch.flow, axis=-1)).max()),
        }
    return found


def describe_arm(arm: Arm) -> dict[str, Any]:
    """What an arm reports of itself: its status in words, and as "ok", "stopped" (by STOP) or "fault"."""
    if not isinstance(arm, CommandedArm):
        return {"words": "simulated", "lamp": "ok"}
    try:
        words = arm.driver.explain()
        status = arm.driver.status() if hasattr(arm.driver, "status") else None
    except Exception as failure:  # of a driver of another distribution
        return {"words": describe(failure), "lamp": "fault"}
    if isinstance(status, ArmStatus) and status.is_fault:
        return {"words": words, "lamp": "fault"}
    if arm.is_halted:
        return {"words": "stopped by STOP, until the next start", "lamp": "stopped"}
    return {"words": words, "lamp": "ok"}


def describe_step(step: Step) -> dict[str, Any]:
    """Numbers of a step of an episode: index, reward [-], distance [m], duration, and times of the clock [s]."""
    timing = {name: step.info[name] for name in PERIODS if name in step.info}
    timing |= {name: value for name, value in step.info.items() if name.startswith((ALIGNMENT, LIMITS_HIT))}
    return {
        "index": step.index,
        "reward": None if step.reward is None else _number(step.reward),
        "distance": None if step.distance is None else _number(step.distance),
        "seconds": _number(step.seconds),
        "timing": {name: _number(value) for name, value in timing.items()},
    }


def colour_heights(height: NDArray[np.float32]) -> Image:
    """A map of heights (h, w) [m] as a picture (h, w, 3): matplotlib's viridis from 0 to FULL_COLOUR."""
    from matplotlib import colormaps

    share = np.clip(np.nan_to_num(height) / FULL_COLOUR, 0.0, 1.0)
    return np.asarray(colormaps["viridis"](share)[..., :3] * 255.0, np.uint8)


def encode_picture(image: Image) -> bytes:
    """As JPEG, thinned to at most MAX_WIDTH."""
    import simplejpeg

    stride = -(-image.shape[1] // MAX_WIDTH)
    thinned = np.ascontiguousarray(image[::stride, ::stride])
    return bytes(simplejpeg.encode_jpeg(thinned, quality=QUALITY, colorspace="RGB"))


def _describe_motion(arm: ArmState) -> dict[str, Any]:
    """Position [m] in world, force on the sensor [N] in its axes, speed [m/s]."""
    return {
        "position": _numbers(arm.pose.position),
        "force": _numbers(arm.wrench[:3]),
        "speed": _number(np.linalg.norm(arm.twist[:3])),
    }


def _number(value: Any) -> float | None:
    """As JSON can hold it: None for what is no finite number."""
    return round(float(value), 9) if np.isfinite(value) else None


def _numbers(values: FloatArray | NDArray[np.float32], digits: int = 6) -> list[float | None]:
    return [round(float(value), digits) if np.isfinite(value) else None for value in values]
