"""Reference pictures of a served rig: taken of free gels only, with a lamp for the drift of the light since."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from calibration.reference import StaleReference, UnusableReference
from robot.serve.errors import Refused
from tacsim.control import contact_signal
from tacsim.interface import TactileFrame
from tacsim.rig import READ_TIMEOUT, Rig

Lamp = Literal["none", "fresh", "stale", "touched"]
MAX_SIGNAL = 0.01  # contact signal of a free gel: that of the first touch of the shipped rigs
MAX_FORCE = 1.0  # of a free arm by its force sensor [N]
ADVICE = "move it clear first, or start an episode: its reset moves the gels clear and takes references"


class References:
    """The references of a rig. Only the rig's thread takes them; `lamps` may be called in any thread."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._frames: Mapping[str, TactileFrame] = {}

    @property
    def are_taken(self) -> bool:
        return bool(self._frames)

    def note_reset(self) -> None:
        """A reset may have taken references."""
        self._frames = self._rig.references or self._frames

    def lamps(self) -> dict[str, Lamp]:
        """By sensor: no reference, a fresh one, a stale one (the light has drifted), or one that shows a contact."""
        if not self.are_taken:
            return dict.fromkeys(self._rig.sensors, "none")
        return {name: self._lamp(name) for name in self._rig.sensors}

    def _lamp(self, name: str) -> Lamp:
        values = self._rig.normalisers[name].diagnostics()
        return "touched" if values.get("touched_reference") else "stale" if values.get("stale") else "fresh"

    def take(self) -> None:
        """Makes the present pictures the references. Raises Refused while a gel is touched; the old ones then stay.

        A contact is found by the force of the arms, by the change since the last reference, and by the picture without
        contact of the calibration, as far as a rig has them.
        """
        frames = {name: sensor.read(READ_TIMEOUT) for name, sensor in self._rig.sensors.items()}
        self._require_free_arms()
        if self.are_taken:
            self._require_free_gels(frames)
        try:
            for name, frame in frames.items():
                self._rig.normalisers[name].take_reference(frame)
        except (UnusableReference, ValueError) as failure:
            self._restore()
            raise Refused(f"sensor '{name}': {failure}") from failure
        if touched := [name for name in frames if self._lamp(name) == "touched"]:
            self._restore()
            raise Refused(f"the picture of sensor '{touched[0]}' shows a contact; {ADVICE}")
        self._frames = frames

    def _require_free_arms(self) -> None:
        for name, arm in self._rig.arms.items():
            force = float(np.linalg.norm(arm.state().wrench[:3]))
            if not force <= MAX_FORCE:  # NaN, too
                raise Refused(f"arm '{name}' measures {force:.1f} N: a gel is touched; {ADVICE}")

    def _require_free_gels(self, frames: Mapping[str, TactileFrame]) -> None:
        for name, frame in frames.items():
            try:
                signal = contact_signal(self._rig.normalisers[name](frame, self._rig.now()))
            except StaleReference:  # the light has changed too much to compare with it
                continue
            if signal > MAX_SIGNAL:
                raise Refused(f"sensor '{name}' is touched (contact signal {signal:.3f}); {ADVICE}")

    def _restore(self) -> None:
        for name, frame in self._frames.items():
            self._rig.normalisers[name].take_reference(frame)
