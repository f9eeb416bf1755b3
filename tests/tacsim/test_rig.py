"""A rig asks its parts in the right order, refuses what does not fit, and closes all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tacsim.interface import (
    Action,
    ArmState,
    IncompatibleRig,
    Needs,
    Pose,
    SensorSpec,
    TactileFrame,
    TactileObservation,
)
from tacsim.limits import ActionError
from tacsim.rig import Rig

FORWARD = Pose(np.array([0.0, 0.0, 1e-3]))


class Parts:
    """All parts of a rig in one, each noting in `log` when it is asked."""

    period = 0.1

    def __init__(self, arm: str | None = "hand", broken: tuple[str, ...] = ()) -> None:
        self.log: list[str] = []
        self.spec = SensorSpec((4, 6), height=False, flow=False, arm=arm)
        self.broken = broken
        self.time = 0.0
        self.reference: TactileFrame | None = None

    def note(self, what: str) -> None:
        self.log.append(what)
        if what in self.broken:
            raise OSError(f"{what} failed")

    def frame(self, value: int) -> TactileFrame:
        return TactileFrame(np.full((4, 6, 3), value, np.uint8), time=self.time, index=0)

    def read(self, timeout: float) -> TactileFrame:
        self.note("read")
        return self.frame(7)

    def state(self, at: float | None = None) -> ArmState:
        self.note("state")
        return ArmState(Pose(), np.zeros(6), np.zeros(6), None, self.time)

    def command(self, target: Pose | None) -> Pose | None:
        self.note("command hold" if target is None else "command move")
        return target

    def now(self) -> float:
        return self.time

    def tick(self) -> None:
        self.note("tick")
        self.time += self.period

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        self.note(f"clear {seed}")
        return {"finger": self.frame(1)}

    def touch(self) -> None:
        self.note("touch")

    def diagnostics(self) -> dict[str, float]:
        return {"stale": 0.0}

    def take_reference(self, frame: TactileFrame) -> None:
        self.note("reference")
        self.reference = frame

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation:
        mask = np.ones((4, 6), bool)
        return TactileObservation(
            frame.image,
            gradient=None,
            height=None,
            contact=~mask,
            valid=mask,
            flow=None,
            time=frame.time,
            age=now - frame.time,
        )

    def stop(self) -> None:
        self.note("stop")

    def recover(self) -> None:
        self.note("recover")

    def close(self) -> None:
        self.note("close")


def make_rig(parts: Parts, **more: Any) -> Rig:
    arms = {} if parts.spec.arm is None else {parts.spec.arm: parts}
    return Rig(
        name="bench",
        sensors={"finger": parts},
        arms=arms,
        clock=parts,
        normalisers={"finger": parts},
        reset=parts,
        **more,
    )


def test_reset_takes_references_before_contact_and_observes_after() -> None:
    parts = Parts()
    rig = make_rig(parts)
    observation = rig.reset(seed=5)
    assert parts.log == ["clear 5", "reference", "touch", "read", "state"]
    assert parts.reference is rig.references["finger"]
    assert rig.references["finger"].image.max() == 1
    assert rig.frames["finger"].image.max() == 7
    assert observation.tactile["finger"].image is rig.frames["finger"].image


def test_sensors_are_read_the_way_they_are_gathered() -> None:
    """Each sensor's frame stands under its own name, however the reads come about."""
    upper, lower, seen = Parts(), Parts(), []

    def last_first(reads: Any) -> Any:
        seen.append(len(reads))
        return [read() for read in reversed(reads)][::-1]

    def dark(timeout: float) -> TactileFrame:
        return lower.frame(3)

    lower.read = dark  # type: ignore[method-assign]
    rig = make_rig(upper, read_all=last_first)
    rig.sensors["thumb"], rig.normalisers["thumb"] = lower, lower
    rig.observe()
    assert seen == [2]
    assert [rig.frames[name].image.max() for name in ("finger", "thumb")] == [7, 3]


def test_step_commands_then_ticks_then_observes() -> None:
    parts = Parts()
    rig = make_rig(parts)
    rig.reset()
    parts.log.clear()
    observation, sent = rig.step(Action({"hand": FORWARD}))
    assert parts.log == ["command move", "tick", "read", "state"]
    assert sent == {"hand": FORWARD}
    assert observation.time == pytest.approx(0.1)
    assert observation.tactile["finger"].age == pytest.approx(0.0)


def test_an_arm_without_target_is_told_to_hold() -> None:
    parts = Parts()
    rig = make_rig(parts)
    rig.reset()
    for action in (Action(), Action({"hand": None})):
        parts.log.clear()
        assert rig.step(action)[1] == {"hand": None}
        assert parts.log[0] == "command hold"


@pytest.mark.parametrize(
    ("tool", "message"),
    [
        ({"foot": FORWARD}, "action for 'foot', but rig 'bench' moves only: hand"),
        ({"finger": FORWARD}, "moves only: hand"),  # carried by the hand: address that
        ({"hand": np.zeros(3)}, "must be a tacsim.Pose or None"),
    ],
)
def test_an_action_it_cannot_take_moves_nothing(tool: Any, message: str) -> None:
    parts = Parts()
    rig = make_rig(parts)
    rig.reset()
    parts.log.clear()
    with pytest.raises(ActionError, match=message):
        rig.step(Action(tool))
    assert parts.log == []


def test_a_sensor_that_no_arm_carries_is_addressed_by_its_own_name() -> None:
    rig = make_rig(Parts(arm=None))
    rig.reset()
    assert rig.step(Action({"finger": FORWARD}))[1] == {}


def test_needs_are_refused_with_the_difference() -> None:
    rig = make_rig(Parts())
    rig.require(Needs(sensors=frozenset({"finger"}), arms=frozenset({"hand"})), "policy 'soft'")
    with pytest.raises(IncompatibleRig) as caught:
        rig.require(Needs(arms=frozenset({"foot"}), height=True, truth=True), "policy 'hard'")
    message = str(caught.value)
    assert "policy 'hard' cannot run on rig 'bench'" in message
    for lacking in ("arm 'foot'", "surface height of sensor 'finger'", "ground truth", "sensors finger; arms hand"):
        assert lacking in message


def test_truth_is_none_on_a_rig_without() -> None:
    rig = make_rig(Parts())
    assert rig.truth() is None
    assert not rig.spec.truth


def test_leaving_the_context_stops_and_closes() -> None:
    parts = Parts()
    with make_rig(parts):
        parts.log.clear()
    assert parts.log == ["stop", "close", "close"]  # arm stopped and closed, sensor closed


def test_everything_is_closed_even_when_parts_fail() -> None:
    parts = Parts(broken=("stop", "close"))
    with pytest.raises(ExceptionGroup) as caught:
        make_rig(parts).close()
    assert parts.log == ["stop", "close", "close"]
    assert [str(failure) for failure in caught.value.exceptions] == ["stop failed", "close failed", "close failed"]


class Hand(Parts):
    """One of several arms, which note in one log. `broken`: what it fails at, and how."""

    def __init__(self, name: str, log: list[str], broken: Mapping[str, BaseException] | None = None) -> None:
        super().__init__()
        self.name, self.log, self.fails = name, log, broken or {}

    def note(self, what: str) -> None:
        self.log.append(f"{self.name} {what}")
        if what in self.fails:
            raise self.fails[what]


def two_hands(**left_fails: BaseException) -> tuple[Rig, list[str]]:
    log: list[str] = []
    parts = Parts(arm=None)
    parts.log = log
    arms = {"left": Hand("left", log, left_fails), "right": Hand("right", log)}
    normalisers = {"finger": parts}
    made = Rig(name="two", sensors={"finger": parts}, arms=arms, clock=parts, normalisers=normalisers, reset=parts)
    return made, log


@pytest.mark.parametrize("failure", [None, OSError("gone"), KeyboardInterrupt()])
@pytest.mark.parametrize("part", ["stop", "close"])
def test_all_arms_are_stopped_before_any_is_closed(part: str, failure: BaseException | None) -> None:
    """Closing an arm takes a second; the others must not move meanwhile. Nor may one that fails keep them from it."""
    rig, log = two_hands(**({} if failure is None else {part: failure}))
    if failure is None:
        rig.close()
    else:
        with pytest.raises(type(failure)):
            rig.close()
    assert log == ["left stop", "right stop", "left close", "right close", "close"]


@pytest.mark.parametrize("when", ["left command move", "right command move"])
def test_a_step_in_another_thread_leaves_no_arm_moving_when_the_rig_is_closed(when: str) -> None:
    rig, log = two_hands()
    rig.reset()
    log.clear()

    class Closing(list[str]):
        def append(self, what: str) -> None:
            super().append(what)
            if what == when:
                rig.close()

    rig.arms["left"].log = rig.arms["right"].log = seen = Closing()  # type: ignore[attr-defined]
    with pytest.raises(RuntimeError, match="rig 'two' is closed"):
        rig.step(Action({"left": FORWARD, "right": FORWARD}))
    last = max(k for k, what in enumerate(seen) if "command" in what)
    assert {"left stop", "right stop"} <= set(seen[last:])
    with pytest.raises(RuntimeError, match="rig 'two' is closed"):
        rig.step(Action({"left": FORWARD, "right": FORWARD}))
    with pytest.raises(RuntimeError, match="rig 'two' is closed"):
        rig.reset()
    assert not [what for what in seen[last + 1 :] if "command" in what]


@pytest.mark.parametrize("failure", [OSError("gone"), KeyboardInterrupt()])
def test_when_an_arm_refuses_its_part_of_a_step_all_are_stopped(failure: BaseException) -> None:
    rig, log = two_hands()
    rig.reset()
    rig.arms["right"].fails = {"command move": failure}  # type: ignore[attr-defined]
    log.clear()
    with pytest.raises(type(failure)):
        rig.step(Action({"left": FORWARD, "right": FORWARD}))
    assert log == ["left command move", "right command move", "left stop", "right stop"]


@pytest.mark.parametrize("phase", ["clear 3", "touch"])
def test_a_reset_that_fails_stops_all_arms(phase: str) -> None:
    parts = Parts(broken=(phase,))
    with pytest.raises(OSError, match=f"{phase} failed"):
        make_rig(parts).reset(3)
    assert parts.log[-1] == "stop"


def test_each_sensor_needs_its_normaliser() -> None:
    parts = Parts()
    with pytest.raises(ValueError, match=r"sensors \['finger'\] but normalisers \[\]"):
        Rig(name="bench", sensors={"finger": parts}, arms={}, clock=parts, normalisers={}, reset=parts)
