"""The register protocol: what ur_rtde's control script does when it runs on a controller.

The text of the script is recognised, not interpreted: which registers it uses, which calls its `$version` lines left in
it, and the path that was written into it. Its loop, its threads and its answers are done here, by the numbers of
ur_rtde 1.6.5. Whatever has no sound model here ends the program with a line in the log, as a run-time error does on a
controller: direct torque, mass matrix, Coriolis torques, external force sensors, force modes 1 and 3.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from robot.kinematics import matrix, pose
from robot.mock import motion
from robot.mock.arm import PERIOD, Arm, Motion, ProgramError
from robot.mock.motion import Waypoint
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from robot.mock.machine import Machine

# Commands that the script takes up in every cycle; all others once, until the client writes 0.
REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
READY, DONE, STOP_SCRIPT, CONTACT = 1, 2, 255, 254

# Calls that older controllers lack: without them in the text, the command does nothing.
NEEDS = {
    20: "force_mode_set_damping(",
    21: "force_mode_set_gain_scaling(",
    25: "tool_contact(",
    26: "get_steptime(",
    27: "get_actual_joint_positions_history(",
    28: "get_target_waypoint(",
    31: "protective_stop()",
    40: "get_tcp_offset(",
    51: "tool_contact(",
    52: "freedrive_mode(",
    53: "end_freedrive_mode(",
    54: "get_freedrive_status(",
    60: "get_inverse_kin_has_solution(",
    61: "get_inverse_kin_has_solution(",
    62: "tool_contact(",
    66: "direct_torque(",
    67: "get_mass_matrix(",
    68: "get_coriolis_and_centrifugal_torques(",
    69: "get_target_joint_accelerations(",
    70: "get_jacobian(",
    71: "get_jacobian_time_derivative(",
}
NOT_MODELLED = {66: "direct_torque", 67: "get_mass_matrix", 68: "get_coriolis_and_centrifugal_torques"}
CONTACT_FORCE, CONTACT_ONSET = 5.0, 1.0  # a contact is felt from the one, and began at the other [N]
NEAR_SINGULAR, SINGULAR = 0.05, 0.02  # of Kinematics.singularity, for get_freedrive_status

_MOVE = re.compile(r"(movej|movel|movep)\((p?)\[([^\]]*)\],\s*a=([^,]+),\s*v=([^,]+)(?:,\s*r=([^,)]+))?\)")
_PROGRESS = re.compile(r"signal_async_progress\((\d+)\)")


class Program:
    """One running program. `step` is one control period."""

    def __init__(self, machine: Machine, text: str) -> None:
        self.machine: Machine = machine
        self.arm: Arm = machine.arm
        self.text = _of_version(text, machine.version)
        named = re.search(r"^\s*(def|sec)\s+(\w+)", self.text, re.M)
        self.kind, self.name = named.groups() if named else ("", "?")
        self.known = self.name == "rtde_control"
        self.int_offset, self.float_offset = (self._offset(kind) for kind in ("int", "float"))
        self.threads: dict[str, Motion] = {}
        self.writes = self.operation = 0  # of the asynchronous progress word
        self.stops_linear = False
        self.internal = 0
        self.contact_steps = 0
        self.damping = 0.005
        self.servo_target: tuple[tuple[float, ...], FloatArray] | None = None  # pose asked for, its joints
        self.main = self._loop()

    @property
    def compliant(self) -> bool:
        return "force" in self.threads

    def step(self) -> None:
        """Main program, then its threads. Raises ProgramError where the program ends with an error."""
        if not _go_on(self.main):
            self.machine.stop("stopped by its client")
            return
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is thread and not _go_on(thread):
                self.threads.pop(name, None)

    # -- registers ---------------------------------------------------------------------------------------------------

    def double(self, index: int) -> float:
        return self.machine.in_double[index + self.float_offset]

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        begin = first + self.float_offset
        return np.array(self.machine.in_double[begin : begin + count])

    def frame(self, first: int) -> FloatArray:
        """The pose in six registers, as frame (4, 4)."""
        values = self.doubles(first)
        if not np.isfinite(values).all():
            raise ProgramError("pose with a number that is not finite")
        return matrix(values)

    def integer(self, index: int) -> int:
        return self.machine.in_int[index + self.int_offset]

    def answer(self, values: FloatArray) -> None:
        begin = self.float_offset
        self.machine.out_double[begin : begin + len(values)] = values.tolist()

    def answer_integer(self, value: int, index: int = 1) -> None:
        self.machine.out_int[index + self.int_offset] = value

    def _offset(self, kind: str) -> int:
        found = re.search(rf"reg_offset_{kind} = # {kind} register offset\s*(\d+)", self.text)
        return int(found.group(1)) if found else 0

    # -- the script's loop -------------------------------------------------------------------------------------------

    def _loop(self) -> Motion:
        self._signal(-1)
        self.answer_integer(READY, 0)
        executing = False
        while True:
            command = self.integer(0)
            if command == 0:
                command, self.internal = self.internal, 0
            if command in REALTIME:
                yield from self._process(command)
                self.answer_integer(READY, 0)
            elif command == 0:
                executing = False
                self.answer_integer(READY, 0)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._process(command)
                self.answer_integer(DONE, 0)
                executing = True
            yield

    def _process(self, command: int) -> Motion:
        if NEEDS.get(command, "") not in self.text:
            return
        if command in NOT_MODELLED:
            raise ProgramError(f"{NOT_MODELLED[command]} is not modelled by the mock")
        work = _COMMANDS.get(command)
        if work is not None:
            yield from work(self) or ()

    def _signal(self, progress: int) -> None:
        """The asynchronous word: 0 begins an operation, more is its progress, -1 its end."""
        self.writes = (self.writes + 1) % 128
        if progress == 0:
            self.operation = (self.operation + 1) % 128
        word = self.writes << 16 | self.operation << 24
        self.answer_integer(word | (min(progress, 32767) | 1 << 15 if progress >= 0 else 0), 2)

    def _run(self, name: str, work: Motion, *, tracked: bool = False) -> None:
        def tracking() -> Motion:
            self._signal(0)
            yield from work
            self._signal(-1)

        self.threads[name] = tracking() if tracked else work

    def _kill(self, name: str) -> bool:
        killed = self.threads.pop(name, None) is not None
        if killed and name in ("move", "stop"):
            self._signal(-1)
            self.arm.waypoint = None
        return killed

    # -- moves -------------------------------------------------------------------------------------------------------

    def _move(self, work: Motion) -> Motion:
        self._kill("move")
        if self.integer(1) == 1:
            self._run("move", work, tracked=True)
        else:
            yield from work

    def _movej(self) -> Motion:
        return self._move(motion.movej(self.arm, self.doubles(0), self.double(7), self.double(6)))

    def _movej_ik(self) -> Motion:
        goal = self.arm.solve(self.frame(0))
        return self._move(motion.movej(self.arm, goal, self.double(7), self.double(6)))

    def _movel(self) -> Motion:
        return self._move(motion.movel(self.arm, self.frame(0), self.double(7), self.double(6)))

    def _movel_fk(self) -> Motion:
        goal = self.arm.kinematics.forward(self.doubles(0), self.arm.tool)
        return self._move(motion.movel(self.arm, goal, self.double(7), self.double(6)))

    def _move_path(self) -> Motion:
        return self._move(self._path())

    def _path(self) -> Motion:
        """The path in the text. Blended waypoints are one motion; progress is signalled where they begin."""
        block = re.search(r"# inject move path\n(.*?)\n\s*end", self.text, re.S)
        waiting: list[Waypoint] = []
        for line in filter(None, map(str.strip, block.group(1).splitlines() if block else ())):
            if progress := _PROGRESS.fullmatch(line):
                self._signal(int(progress.group(1)))
                continue
            move = _MOVE.fullmatch(line)
            if move is None:
                raise ProgramError(f"path: the mock does not know '{line}'")
            kind, is_pose, numbers, *rest = move.groups()
            target = np.array([float(number) for number in numbers.split(",")])
            acceleration, speed, blend = (float(number or 0) for number in rest)
            if kind == "movej":
                yield from motion.path(self.arm, waiting)
                waiting = []
                goal = self.arm.solve(matrix(target)) if is_pose else target
                yield from motion.movej(self.arm, goal, acceleration, speed)
                continue
            frame = matrix(target) if is_pose else self.arm.kinematics.forward(target, self.arm.tool)
            waiting.append(Waypoint(frame, acceleration, speed, blend))
            if blend <= 0:
                yield from motion.path(self.arm, waiting)
                waiting = []
        yield from motion.path(self.arm, waiting)

    def _stop(self) -> Motion:
        """stopL and stopJ. As in the script: stopj until a first asynchronous stop, stopl ever after."""
        if not self._kill("stop"):
            self._kill("move")
        if self.integer(1) == 1:
            self.stops_linear = True
            self._run("stop", motion.stopl(self.arm, self.double(0)), tracked=True)
        else:
            yield from (motion.stopl if self.stops_linear else motion.stopj)(self.arm, self.double(0))

    # -- servo, speed, force, jog ------------------------------------------------------------------------------------

    def _thread(self, name: str, again: Callable[[], Motion]) -> None:
        """A thread that repeats one call for ever, unless it runs already."""

        def repeat() -> Motion:
            while True:
                yield from again()

        if name not in self.threads:
            self._run(name, repeat())

    def _servoj(self) -> None:
        self._servo(self.doubles(0))

    def _servol(self) -> None:
        asked = tuple(self.doubles(0).tolist())
        if self.servo_target is None or self.servo_target[0] != asked:
            self.servo_target = asked, self.arm.solve(self.frame(0))
        self._servo(self.servo_target[1])

    def _servo(self, q: FloatArray) -> None:
        self._servo_call = (q, self.double(8), self.double(9))
        self._thread("servo", lambda: motion.servoj(self.arm, *self._servo_call))

    def _servoc(self) -> None:
        call = (self.frame(0), self.double(7), self.double(6))
        self._servoc_call = call
        self._thread("servoc", lambda: motion.servoc(self.arm, *self._servoc_call))

    def _servo_stop(self) -> Motion:
        self._kill("servo")
        self._kill("servoc")
        self.servo_target = None
        return motion.stopl(self.arm, self.double(0))

    def _speed(self, call: Callable[..., Motion]) -> None:
        self._speed_call = (call, self.doubles(0), self.double(6), self.double(7))

        def again() -> Motion:
            kind, *arguments = self._speed_call
            return kind(self.arm, *arguments)

        self._thread("speed", again)

    def _speedj(self) -> None:
        self._speed(motion.speedj)

    def _speedl(self) -> None:
        self._speed(motion.speedl)

    def _speed_stop(self) -> Motion:
        linear = self._kill("speed") and self._speed_call[0] is motion.speedl
        return (motion.stopl if linear else motion.stopj)(self.arm, self.double(0))

    def _force(self) -> None:
        kind = self.integer(1)
        if kind != 2:
            raise ProgramError(f"force_mode of type {kind} is not modelled by the mock, only type 2")
        selection = [self.integer(index) for index in range(2, 8)]
        self._force_call = (self.frame(0), selection, self.doubles(6), np.abs(self.doubles(12)))
        self._thread("force", self._comply)

    def _comply(self) -> Motion:
        frame, selection, wrench, limits = self._force_call
        if self.arm.commanded:
            raise ProgramError("motion during force_mode is not modelled by the mock")
        turn = frame[:3, :3]
        wanted = np.concatenate([turn @ wrench[:3], turn @ wrench[3:]])
        push = (wanted + self.machine.load.felt) / motion.FORCE_DAMPING
        motion.admit(self.arm, frame, selection, push, limits)
        yield

    def _force_stop(self) -> Motion:
        self._kill("force")
        return motion.stopl(self.arm, 10.0)

    def _jog_start(self) -> None:
        self._jog_call = (self.doubles(0), int(self.double(6)), self.double(7), self.frame(8))
        self._thread("jog", self._jog)

    def _jog(self) -> Motion:
        speed, feature, acceleration, custom = self._jog_call
        turn = {0: np.eye(3), 1: self.arm.frame[:3, :3], 2: custom[:3, :3]}.get(feature)
        if turn is None:
            raise ProgramError(f"jog: feature {feature} is none of 0, 1, 2")
        twist = np.concatenate([turn @ speed[:3], turn @ speed[3:]])
        return motion.speedl(self.arm, twist, acceleration, 0.01)

    def _jog_stop(self) -> Motion | None:
        return motion.stopl(self.arm, 1.2) if self._kill("jog") else None

    # -- contact -----------------------------------------------------------------------------------------------------

    def _steps_since_contact(self, direction: FloatArray) -> int:
        """tool_contact(): periods since the contact against `direction` (3,) began; 0 without contact."""
        size = float(np.linalg.norm(direction[:3]))

        def against(force: FloatArray) -> float:
            return float(np.linalg.norm(force[:3])) if size == 0 else -float(force[:3] @ direction[:3]) / size

        history = self.machine.load.history
        if not history or against(history[-1]) < CONTACT_FORCE:
            return 0
        steps = 0
        for force in reversed(history):
            if against(force) < CONTACT_ONSET:
                break
            steps += 1
        return steps

    def _past_joints(self, steps: int) -> FloatArray:
        history = self.arm.history
        if not 0 <= steps < len(history):
            raise ProgramError(f"joint positions {steps} steps ago are not kept, only {len(history)}")
        return history[-1 - steps]

    def _tool_contact(self) -> None:
        self.answer_integer(self._steps_since_contact(self.doubles(0)))

    def _joint_history(self) -> None:
        self.answer(self._past_joints(self.integer(1)))

    def _return_to_contact(self, steps: int) -> Motion:
        q = self._past_joints(steps)
        yield from motion.stopl(self.arm, 3.0)
        yield from motion.movel(self.arm, self.arm.kinematics.forward(q, self.arm.tool), 1.2, 0.25)

    def _move_until_contact(self) -> Motion:
        speed, direction, acceleration = self.doubles(0), self.doubles(6), self.double(12)
        while (steps := self._steps_since_contact(direction)) == 0:
            yield from motion.speedl(self.arm, speed, acceleration, PERIOD)
        yield from self._return_to_contact(steps)

    def _contact_start(self) -> None:
        self.threads.pop("contact", None)
        self.contact_steps = 0
        self._run("contact", self._wait_for_contact(self.doubles(0)))

    def _wait_for_contact(self, direction: FloatArray) -> Motion:
        def steps() -> int:
            # the script's own test of "no direction given"
            return self._steps_since_contact(self.arm.target_twist if direction.sum() < 1e-10 else direction)

        while steps() > 0:
            yield
        while steps() == 0:
            yield
        self.contact_steps = steps()
        self.internal = CONTACT

    def _contact_stop(self) -> None:
        self.threads.pop("contact", None)
        self.answer_integer(self.contact_steps)

    def _contact_read(self) -> None:
        self.answer_integer(self.contact_steps)

    def _contact_found(self) -> Motion:
        self._kill("speed")
        return self._return_to_contact(self.contact_steps)

    # -- settings ----------------------------------------------------------------------------------------------------

    def _zero_sensor(self) -> None:
        self.machine.load.zero(self.arm)

    def _payload(self) -> None:
        self.machine.payload, centre = self.double(0), self.doubles(1, 3)
        if centre.any():
            self.machine.payload_centre = centre

    def _target_payload(self) -> None:
        self._payload()
        self.machine.payload_inertia = self.doubles(4)

    def _tool(self) -> None:
        self.arm.tool = self.frame(0)
        self.arm.look()
        self.machine.load.look(self.arm)

    def _gravity(self) -> None:
        self.machine.gravity = self.doubles(0, 3)

    def _watchdog(self) -> None:
        frequency = self.double(0)
        if not frequency > 0:
            raise ProgramError(f"rtde_set_watchdog: frequency must be positive, got {frequency:g}")
        self.machine.watchdog, self.machine.fed = (self.int_offset, 1.0 / frequency), self.machine.ticks

    def _teach(self) -> None:
        self.machine.freedrive = np.eye(4), (1,) * 6

    def _teach_end(self) -> None:
        self.machine.freedrive = None

    def _freedrive(self) -> None:
        self.machine.freedrive = self.frame(0), tuple(self.integer(index) for index in range(1, 7))

    def _freedrive_status(self) -> None:
        measure = self.arm.kinematics.singularity(self.arm.q)
        self.answer_integer((measure < NEAR_SINGULAR) + (measure < SINGULAR))

    def _protective_stop(self) -> None:
        self.machine.protective_stop("asked for by the program")

    def _damping(self) -> None:
        value = self.double(0)
        if not 0 <= value <= 1:
            raise ProgramError(f"force_mode_set_damping: {value:g} is not within 0 and 1")

    def _gain_scaling(self) -> None:
        value = self.double(0)
        if not 0 <= value <= 2:
            raise ProgramError(f"force_mode_set_gain_scaling: {value:g} is not within 0 and 2")

    def _external_sensor(self) -> None:
        if self.integer(1) == 1:
            raise ProgramError("external force sensors are not modelled by the mock: push through its door")

    # -- questions ---------------------------------------------------------------------------------------------------

    def _inverse(self) -> None:
        self.answer(self.arm.solve(self.frame(0)))

    def _inverse_near(self) -> None:
        self.answer(self.arm.solve(self.frame(0), self.doubles(6)))

    def _reaches(self, seed: FloatArray | None = None) -> None:
        near = self.arm.target_q if seed is None else seed
        self.answer_integer(self.arm.kinematics.inverse(self.frame(0), near, self.arm.tool) is not None)

    def _reaches_near(self) -> None:
        self._reaches(self.doubles(6))

    def _joints_allowed(self) -> None:
        self.answer_integer(bool(np.abs(self.doubles(0)).max() <= 2 * np.pi))

    def _compose(self) -> None:
        self.answer(pose(self.frame(0) @ self.frame(6)))

    def _forward_of(self) -> None:
        self.answer(pose(self.arm.kinematics.forward(self.doubles(0), self.frame(6))))

    def _waypoint(self) -> None:
        self.answer(pose(self.arm.target_frame if self.arm.waypoint is None else self.arm.waypoint))

    def _torques(self) -> None:
        """What the joints bear of the load on the tool."""
        jacobian = self.arm.kinematics.jacobian(self.arm.q, self.arm.tool)
        self.answer(-jacobian.T @ self.machine.load.true)

    def _matrix(self, values: FloatArray) -> None:
        """A 6 x 6 matrix by columns: registers 0 to 23, then 36 to 47."""
        flat = values.T.ravel().tolist()
        self.machine.out_double[:24], self.machine.out_double[36:48] = flat[:24], flat[24:]

    def _jacobian(self) -> None:
        self._matrix(self.arm.kinematics.jacobian(self.arm.q, self.arm.tool))

    def _jacobian_rate(self) -> None:
        arm, h = self.arm, 1e-5
        before, after = (arm.kinematics.jacobian(arm.q + step * arm.qd, arm.tool) for step in (-h, h))
        self._matrix((after - before) / (2 * h))


_COMMANDS: dict[int, Callable[[Program], Motion | None]] = {
    1: Program._movej,
    2: Program._movej_ik,
    3: Program._movel,
    4: Program._movel_fk,
    45: Program._move_path,
    6: Program._force,
    7: Program._force_stop,
    20: Program._damping,
    21: Program._gain_scaling,
    8: Program._zero_sensor,
    17: Program._payload,
    65: Program._target_payload,
    29: Program._tool,
    9: Program._speedj,
    10: Program._speedl,
    15: Program._speed_stop,
    41: Program._jog_start,
    42: Program._jog_stop,
    11: Program._servoj,
    24: Program._servol,
    12: Program._servoc,
    16: Program._servo_stop,
    18: Program._teach,
    19: Program._teach_end,
    52: Program._freedrive,
    53: Program._teach_end,
    54: Program._freedrive_status,
    25: Program._tool_contact,
    27: Program._joint_history,
    26: lambda program: program.answer(np.array([PERIOD])),
    28: Program._waypoint,
    31: Program._protective_stop,
    30: Program._inverse_near,
    46: Program._inverse,
    60: Program._reaches,
    61: Program._reaches_near,
    33: Program._stop,
    34: Program._stop,
    35: Program._watchdog,
    36: Program._reaches,
    37: Program._joints_allowed,
    38: Program._torques,
    39: Program._compose,
    44: Program._forward_of,
    40: lambda program: program.answer(pose(program.arm.tool)),
    43: lambda program: program.answer(pose(program.arm.target_frame)),
    47: lambda program: program.answer_integer(program.machine.steady),
    51: Program._move_until_contact,
    56: Program._external_sensor,
    57: Program._external_sensor,
    58: lambda program: program.answer(pose(program.arm.kinematics.forward(program.arm.q))),
    59: Program._gravity,
    62: Program._contact_start,
    63: Program._contact_stop,
    64: Program._contact_read,
    69: lambda program: program.answer(program.arm.target_qdd),
    70: Program._jacobian,
    71: Program._jacobian_rate,
    CONTACT: Program._contact_found,
}


def _go_on(work: Motion) -> bool:
    """One control period of `work`; False when it has ended."""
    try:
        next(work)
    except StopIteration:
        return False
    return True


def _of_version(text: str, version: tuple[int, ...]) -> str:
    """The text without lines for newer controllers. `$5.10|3.15 line` needs 5.10, or 3.15 of that major version."""

    def kept(line: str) -> Iterator[str]:
        mark = re.match(r"\s*\$([\d.|]+)(.*)", line)
        if mark is None:
            yield line
            return
        for least in mark.group(1).split("|"):
            wanted = tuple(int(number) for number in least.split(".") if number)
            if wanted[:1] == tuple(version[:1]) and tuple(version[: len(wanted)]) >= wanted:
                yield mark.group(2)
                return

    return "\n".join(part for line in text.splitlines() for part in kept(line))
