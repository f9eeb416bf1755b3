"""The rig behind the page: one thread opens it, observes it, and runs what the operator starts."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from robot.open import open_rig
from robot.rig.commanded_arm import CommandedArm
from robot.serve.episode import Episodes, StartOptions, Watcher
from robot.serve.errors import Refused, describe
from robot.serve.live_view import (
    LiveView,
    colour_heights,
    describe_arm,
    describe_step,
    view_of_frames,
    view_of_observation,
)
from robot.serve.operated_policy import Mode, OperatedPolicy
from robot.serve.recordings import Recordings
from robot.serve.references import References
from robot.serve.stop_switch import StopSwitch
from tacsim.config import LoadedRig
from tacsim.control import load_controller
from tacsim.interface import FloatArray, Observation
from tacsim.record.episode import Step
from tacsim.rig import READ_TIMEOUT, Rig

Phase = Literal["opening", "watching", "busy", "starting", "running", "failed", "closed"]
HEARTBEAT = 1.0  # motion stops when the page was silent for so long [s]
MIN_VIEW_INTERVAL = 0.05  # between two views [s]
REFERENCE_TIMEOUT = 10.0  # of taking references [s]


class Session:
    """Owns a rig. Every method may be called in any thread; those that start motion return before it ends.

    Args:
        loaded: the rig, with its task if it has one.
        policy: by name (`load_policy`).
        out: folder in which recorded episodes are stored, 000, 001, ...
        on_failure: called when the rig cannot be opened or served any more; the error is in `failure`.

    Use as a context manager. `stop` never waits for the thread of the rig, nor for an arm.
    """

    def __init__(
        self, loaded: LoadedRig, policy: str, out: Path, on_failure: Callable[[], None] = lambda: None
    ) -> None:
        self.failure: Exception | None = None
        self.recordings = Recordings(out)
        self._loaded, self._policy_name, self._on_failure = loaded, policy, on_failure
        self._episodes = Episodes(loaded, policy)
        self._commands: queue.SimpleQueue[Callable[[Rig], str]] = queue.SimpleQueue()
        self._stop = StopSwitch(self._show_words)
        self._closing = threading.Event()
        self._change = threading.Condition()  # guards phase, words, view, question; held for no call that may wait
        self._phase: Phase = "opening"
        self._words = "opening the rig"
        self._stop_words = ""  # why it was stopped last
        self._question: str | None = None
        self._answer: bool | None = None
        self._view, self._view_number, self._view_time = LiveView({}), 0, 0.0
        self._heartbeat = 0.0
        self._rig: Rig | None = None
        self._references: References | None = None
        self._policy: OperatedPolicy | None = None
        self._step: Step | None = None
        self._thread = threading.Thread(target=self._run, name="rig", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop("the server ends")
        self._closing.set()
        self._thread.join(timeout=30.0)
        self.recordings.close()

    # -- what the page shows ----------------------------------------------------------------------------------------

    def wait_for_view(self, after: int, timeout: float) -> tuple[int, LiveView]:
        """The newest view and its number, as soon as that is above `after`, or after `timeout` [s]."""
        with self._change:
            self._change.wait_for(lambda: self._view_number > after, timeout)
            number, view = self._view_number, self._view
            shown = {"phase": self._phase, "words": self._words, "question": self._question}
        return number, LiveView({**view.state, **shown, **self._status()}, view.pictures)

    def _status(self) -> dict[str, Any]:
        policy, step, rig, references = self._policy, self._step, self._rig, self._references
        config, recordings = self._loaded.config, self.recordings
        return {
            "rig": config.name,
            "task": None if config.task is None else config.task.kind,
            "policy": self._policy_name,
            "mode": None if policy is None else policy.mode,
            "is_episode": policy is not None and policy.inner is not None,
            "pending": None if recordings.pending is None else recordings.pending.name,
            "report": None if recordings.report is None else recordings.report.name,
            "report_state": recordings.report_state,
            "lamps": {} if references is None else references.lamps(),
            "arm_states": {} if rig is None else {name: describe_arm(arm) for name, arm in rig.arms.items()},
            "step": None if step is None else describe_step(step),
        }

    # -- what the operator does -------------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """Brakes every arm at once and ends the motion. Needs nothing, waits for nothing, and is never refused."""
        self._stop_words = f"stopped: {reason}"
        self._stop.press()
        if (policy := self._policy) is not None:
            policy.end()
        self._show_words(self._stop_words)

    def note_heartbeat(self) -> None:
        """The page of the operator is there."""
        self._heartbeat = time.monotonic()

    def check_heartbeat(self) -> None:
        """Stops a motion whose page has been silent for HEARTBEAT; to be called several times in that time."""
        is_silent = time.monotonic() - self._heartbeat > HEARTBEAT
        if is_silent and self._phase in ("starting", "running") and not self._stop.is_pressed:
            self.stop(f"the page was silent for {HEARTBEAT:g} s")

    def start(self, options: StartOptions) -> None:
        """Resets the rig and runs an episode. Raises Refused while something else runs, or a recording waits."""
        if self.recordings.pending is not None:
            raise Refused("keep or discard the last recording first")
        self._begin_motion(lambda rig: self._run_episode(rig, options))

    def drive(self) -> None:
        """Lets the operator move the arms by hand from where they are, without an episode. Raises Refused."""
        if self._loaded.config.clock != "wall":
            raise Refused("arms of this rig move by hand in an episode only; start one by hand")
        if load_controller(self._loaded.config.task) is not None:
            raise Refused("the arms of this task hold a load; start an episode by hand instead")
        if self._references is None or not self._references.are_taken:
            raise Refused("without a reference nothing limits the depth of a gel; take a new reference, or start")
        self._begin_motion(self._drive)

    def end(self) -> None:
        """Ends the episode or the motion by hand after its present step. Raises Refused without one."""
        self._require_policy().end()

    def set_mode(self, mode: Mode) -> None:
        """Of what runs. Raises Refused if nothing runs, or without a policy for the mode."""
        try:
            self._require_policy().set_mode(mode)
        except ValueError as failure:
            raise Refused(str(failure)) from None

    def jog(self, arm: str, jog: FloatArray) -> None:
        """Moves an arm by hand (`OperatedPolicy.set_jog`). Raises Refused outside of teleoperation or without it."""
        policy, rig = self._policy, self._rig
        if policy is None or rig is None or policy.mode != "teleoperation":
            raise Refused("an arm is moved by hand in the mode teleoperation only; start it")
        if arm not in rig.arms:
            raise Refused(f"no arm '{arm}'")
        try:
            policy.set_jog(arm, jog)
        except ValueError as failure:
            raise Refused(str(failure)) from None

    def take_references(self) -> None:
        """Makes the present pictures the references I0. Raises Refused while a gel is touched, or during an episode."""
        failures: list[Exception] = []

        def take(rig: Rig) -> str:
            try:
                assert self._references is not None
                self._references.take()
                return "references taken"
            except Exception as failure:
                failures.append(failure)
                return f"no new reference: {describe(failure)}"

        self._begin("busy", "taking references", take)
        with self._change:  # until the rig is at rest again: a request that follows at once is not refused
            is_done = self._change.wait_for(lambda: self._phase != "busy", REFERENCE_TIMEOUT)
        if not is_done:
            raise Refused(f"no picture for {REFERENCE_TIMEOUT:g} s; check the cameras")
        if failures:
            raise Refused(describe(failures[0])) from failures[0]

    def recover(self) -> None:
        """Ends the fault of each arm, as far as it can be ended from here. Moves nothing. Raises Refused."""

        def recover(rig: Rig) -> str:
            for arm in rig.arms.values():
                if isinstance(arm, CommandedArm):
                    arm.recover()
            return "recovered"

        self._begin("busy", "recovering", recover)

    def answer(self, yes: bool) -> None:
        """To the question that is shown. Raises Refused without one."""
        with self._change:
            if self._question is None:
                raise Refused("there is no question")
            self._answer = yes
            self._change.notify_all()

    def _require_policy(self) -> OperatedPolicy:
        policy = self._policy
        if self._phase != "running" or policy is None:
            raise Refused(f"nothing runs: the rig is {self._phase}")
        return policy

    def _begin_motion(self, move: Callable[[Rig], str]) -> None:
        """As `_begin`; a STOP after this call prevents or ends the motion."""
        count = self._stop.count

        def begin(rig: Rig) -> str:
            words = move(rig) if self._stop.release(count) else ""
            return self._stop_words if self._stop.is_pressed else words

        self.note_heartbeat()
        self._begin("starting", "starting", begin)

    def _begin(self, phase: Phase, words: str, command: Callable[[Rig], str]) -> None:
        """Gives the thread of the rig a command, which returns the words to show after it. Raises Refused."""
        with self._change:
            if self._phase not in ("watching", "failed") or self._rig is None:
                raise Refused(f"not possible while the rig is {self._phase}: {self._words}")
            self._phase, self._words = phase, words
            self._signal_change()
        self._commands.put(command)

    # -- the thread of the rig --------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            with open_rig(
                self._loaded, confirm=self._confirm, report=self._show_reset, check=self._episodes.require_fit
            ) as rig:
                self._stop.connect({name: arm for name, arm in rig.arms.items() if isinstance(arm, CommandedArm)})
                colour_heights(np.zeros((1, 1), np.float32))  # loads matplotlib now, not in a control period
                self._references, self._rig = References(rig), rig
                self._show_words("ready", "watching")
                while not self._closing.is_set():
                    self._serve_one(rig)
        except Exception as failure:
            self.failure = failure
            self._show_words(describe(failure), "failed")
            self._on_failure()
        finally:
            self._rig = None

    def _serve_one(self, rig: Rig) -> None:
        try:
            command = self._commands.get(timeout=rig.spec.period)
        except queue.Empty:
            self._watch(rig)
            return
        try:
            self._show_words(command(rig), "watching")
        except Exception as failure:
            rig.stop()
            if self._stop.is_pressed:  # a halted arm ends a reset so
                self._show_words(self._stop_words, "watching")
            else:
                self._show_words(describe(failure), "failed")
        finally:
            self._policy = None
            assert self._references is not None
            self._references.note_reset()

    def _watch(self, rig: Rig) -> None:
        """Shows the rig at rest."""
        if self._loaded.config.clock != "wall" and self._view_number > 1:
            return  # nothing changes in a simulation or a recording that does not run
        try:
            if self._references is not None and self._references.are_taken:
                self._show(rig, rig.observe())
            else:
                self._show_frames(rig)
        except Exception as failure:  # a lost picture, a lost arm, light that has changed: shown, and tried again
            self._show_words(describe(failure))
            try:
                self._show_frames(rig)
            except Exception as again:
                self._show_words(describe(again))

    def _run_episode(self, rig: Rig, options: StartOptions) -> str:
        folder = self.recordings.next_folder() if options.record else None
        self._step = None
        words, is_recorded = self._episodes.run(rig, options, self._watcher(rig), folder)
        if is_recorded and folder is not None:
            self.recordings.add(folder)
        return words or "the episode has ended"

    def _drive(self, rig: Rig) -> str:
        self._step = None
        self._episodes.drive(rig, self._watcher(rig))
        return "the motion by hand has ended"

    def _watcher(self, rig: Rig) -> Watcher:
        def on_begin(policy: OperatedPolicy) -> None:
            self._policy = policy

        def on_step(step: Step) -> None:
            self._step = step
            if warning := self._episodes.outside_training(self._policy, step):
                self._show_words(warning)

        def on_observation(observation: Observation) -> None:
            if self._phase == "starting" and not self._stop.is_pressed:
                is_episode = self._policy is not None and self._policy.inner is not None
                words = f"an episode with policy '{self._policy_name}'" if is_episode else "arms move by hand"
                self._show_words(words, "running")
                assert self._references is not None
                self._references.note_reset()
            self._show(rig, observation)

        return Watcher(on_begin, on_step, on_observation, self._must_stop)

    def _must_stop(self) -> bool:
        return self._stop.is_pressed or self._closing.is_set()

    # -- views ------------------------------------------------------------------------------------------------------

    def _show(self, rig: Rig, observation: Observation) -> None:
        if self._is_view_due():
            self._set_view(view_of_observation(observation, rig.frames))

    def _show_frames(self, rig: Rig, timeout: float = READ_TIMEOUT) -> None:
        if self._is_view_due():
            frames = {name: sensor.read(timeout) for name, sensor in rig.sensors.items()}
            self._set_view(view_of_frames(frames, {name: arm.state() for name, arm in rig.arms.items()}, rig.now()))

    def _is_view_due(self) -> bool:
        return time.monotonic() - self._view_time >= MIN_VIEW_INTERVAL

    def _set_view(self, view: LiveView) -> None:
        with self._change:
            self._view, self._view_time = view, time.monotonic()
            self._signal_change()

    def _show_words(self, words: str, phase: Phase | None = None) -> None:
        with self._change:
            self._words = words
            self._phase = phase or self._phase
            self._signal_change()

    def _signal_change(self) -> None:
        """Wakes who waits for a view; `_change` is held."""
        self._view_number += 1
        self._change.notify_all()

    def _show_reset(self, words: str) -> None:
        """What the arms are doing in a reset."""
        if self._must_stop():
            raise Refused(self._stop_words)
        self._show_words(words)
        if (rig := self._rig) is not None and self._loaded.config.clock == "wall":
            with suppress(TimeoutError):  # the approach itself checks that pictures arrive; this must not delay it
                self._show_frames(rig, timeout=0.0)

    def _confirm(self, question: str) -> bool:
        """Asks the operator; False when the motion is stopped or the page is silent."""
        with self._change:
            self._question, self._answer = question, None
            self._signal_change()
            try:
                while not (self._change.wait_for(self._has_answer, 0.2) or self._must_stop()):
                    pass
                return self._is_confirmed()
            finally:
                self._question = None
                self._signal_change()

    def _has_answer(self) -> bool:
        return self._answer is not None

    def _is_confirmed(self) -> bool:
        return bool(self._answer) and not self._must_stop()
