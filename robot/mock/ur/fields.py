"""The fields of the RTDE: names, types, and sources of their values (Real-Time Data Exchange guide, Universal Robots,
and the recipes of its clients for Python and C++, all of whose fields are here).

Computed: joints, TCP, elbow, forces on the tool, modes, registers, inputs and outputs, payload. Not modelled, and
constant like in a controller at rest: temperatures, voltages, currents, moments, momentum, energy, wrenches from
currents, ratios of position deviation and collision, encoders, Euromap 67, inputs, devices at the tool, accelerometer.
Every version has a field without `since`, also if the guide does not give the version that introduced it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from robot.common.kinematics import pose
from robot.mock.ur.machine.arm import PERIOD
from robot.mock.ur.machine.forces import GRAVITY
from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.state import REGISTERS, Mode

FORMATS = {  # struct codes, big endian
    "DOUBLE": "d",
    "VECTOR6D": "6d",
    "VECTOR3D": "3d",
    "VECTOR6INT32": "6i",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
}

Value = float | int | bool
Values = list[float] | tuple[Value, ...] | Value


@dataclass(frozen=True)
class Output:
    """One output field: its type, how to read it, and the first version of each generation that has it."""

    type: str
    read: Callable[[Machine], Values]
    since: tuple[tuple[int, ...], ...] = ()

    def known(self, version: tuple[int, ...]) -> bool:
        """True for a controller of this version."""
        same = [minimum for minimum in self.since if minimum[0] == version[0]]
        if same:
            return any(version >= minimum for minimum in same)
        return version[0] > max((minimum[0] for minimum in self.since), default=0)


def _register(array: str, index: int) -> Callable[[Machine], Values]:
    def read(machine: Machine) -> Value:
        values: list[Value] = getattr(machine, array)
        return values[index]

    return read


JOINT_MODES = {Mode.RUNNING: 253, Mode.IDLE: 255}  # running, idle; any other: POWERED_OFF
POWERED_OFF = 239


def _constant(*values: float) -> Callable[[Machine], Values]:
    value: Values = values if len(values) > 1 else values[0]
    return lambda machine: value


def _powered(count: int) -> Callable[[Machine], Values]:
    volts = 48.0  # of all powered devices [V]

    def read(machine: Machine) -> Values:
        value = 0.0 if machine.mode is Mode.POWER_OFF else volts
        return (value,) * count if count > 1 else value

    return read


def _bits(first: int, count: int) -> Callable[[Machine], Values]:
    return lambda machine: machine.in_bits >> first & ((1 << count) - 1)


def _elbow(machine: Machine) -> Values:
    """Position (3,) of the end of the upper arm, base axes [m]."""
    lengths, (q1, q2, *_) = machine.arm.kinematics.lengths, machine.arm.q.tolist()
    out = lengths.a2 * math.cos(q2)
    return out * math.cos(q1), out * math.sin(q1), lengths.d1 + lengths.a2 * math.sin(q2)


def _elbow_velocity(machine: Machine) -> Values:
    """(3,), base axes [m/s]."""
    (q1, q2, *_), (w1, w2, *_) = machine.arm.q.tolist(), machine.arm.qd.tolist()
    x, y, _ = cast("tuple[float, ...]", _elbow(machine))
    a2 = machine.arm.kinematics.lengths.a2
    outwards = -a2 * math.sin(q2) * w2
    return -y * w1 + outwards * math.cos(q1), x * w1 + outwards * math.sin(q1), a2 * math.cos(q2) * w2


OUTPUTS: dict[str, Output] = {
    "timestamp": Output("DOUBLE", lambda m: m.time + m.clock_offset),
    "target_q": Output("VECTOR6D", lambda m: m.arm.target_q.tolist()),
    "target_qd": Output("VECTOR6D", lambda m: m.arm.target_qd.tolist()),
    "target_qdd": Output("VECTOR6D", lambda m: m.arm.target_qdd.tolist()),
    "target_current": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "target_moment": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "actual_q": Output("VECTOR6D", lambda m: m.arm.q.tolist()),
    "actual_qd": Output("VECTOR6D", lambda m: m.arm.qd.tolist()),
    "actual_current": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "actual_current_as_torque": Output("VECTOR6D", _constant(*[0.0] * 6), since=((5, 23), (10, 9))),
    "actual_current_window": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "joint_control_output": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "actual_TCP_pose": Output("VECTOR6D", lambda m: m.arm.pose.tolist()),
    "actual_TCP_speed": Output("VECTOR6D", lambda m: m.arm.twist.tolist()),
    "actual_TCP_force": Output("VECTOR6D", lambda m: m.load.zeroed_wrench.tolist()),
    "target_TCP_pose": Output("VECTOR6D", lambda m: pose(m.arm.target_frame).tolist()),
    "target_TCP_speed": Output("VECTOR6D", lambda m: m.arm.target_twist.tolist()),
    "actual_TCP_acceleration": Output("VECTOR6D", lambda m: m.arm.acceleration.tolist()),
    "target_TCP_acceleration": Output("VECTOR6D", lambda m: m.arm.target_acceleration.tolist()),
    "actual_digital_input_bits": Output("UINT64", _constant(0)),
    "actual_configurable_digital_input_bits": Output("UINT64", _constant(0)),
    "joint_temperatures": Output("VECTOR6D", _constant(*[30.0] * 6)),
    "actual_execution_time": Output("DOUBLE", lambda m: m.work_time),
    "target_execution_time": Output("DOUBLE", _constant(PERIOD)),
    "control_step": Output("UINT64", lambda m: m.ticks),
    "robot_mode": Output("INT32", lambda m: int(m.mode)),
    "joint_mode": Output("VECTOR6INT32", lambda m: (JOINT_MODES.get(m.mode, POWERED_OFF),) * 6),
    "safety_mode": Output("INT32", lambda m: int(m.safety)),
    "safety_status": Output("INT32", lambda m: int(m.safety), since=((3, 10), (5, 4))),
    "actual_tool_accelerometer": Output("VECTOR3D", lambda m: (GRAVITY * m.arm.frame[2, :3]).tolist()),
    "speed_scaling": Output("DOUBLE", lambda m: m.limiter),
    "target_speed_fraction": Output("DOUBLE", lambda m: m.slider),
    "actual_momentum": Output("DOUBLE", _constant(0.0)),
    "actual_main_voltage": Output("DOUBLE", _powered(1)),
    "actual_robot_voltage": Output("DOUBLE", _powered(1)),
    "actual_robot_current": Output("DOUBLE", _constant(0.0)),
    "actual_robot_energy_consumed": Output("DOUBLE", _constant(0.0), since=((5, 23), (10, 11))),
    "actual_robot_braking_energy_dissipated": Output("DOUBLE", _constant(0.0), since=((5, 23), (10, 11))),
    "actual_joint_voltage": Output("VECTOR6D", _powered(6)),
    "actual_digital_output_bits": Output("UINT64", lambda m: m.outputs.digital),
    "actual_configurable_digital_output_bits": Output("UINT64", lambda m: m.outputs.digital >> 8 & 0xFF),
    "runtime_state": Output("UINT32", lambda m: int(m.runtime)),
    "elbow_position": Output("VECTOR3D", _elbow, since=((3, 5), (5, 0))),
    "elbow_velocity": Output("VECTOR3D", _elbow_velocity, since=((3, 5), (5, 0))),
    "tcp_force_scalar": Output("DOUBLE", lambda m: math.hypot(*m.load.zeroed_wrench[:3].tolist())),
    "joint_position_deviation_ratio": Output("DOUBLE", _constant(0.0)),
    "collision_detection_ratio": Output("DOUBLE", _constant(0.0)),
    "time_scale_source": Output("INT32", _constant(0)),
    "analog_io_types": Output("UINT32", lambda m: m.outputs.analog_types),
    "tool_mode": Output("UINT32", lambda m: JOINT_MODES.get(m.mode, POWERED_OFF)),
    "tool_analog_input_types": Output("UINT32", _constant(0)),
    "tool_analog_input0": Output("DOUBLE", _constant(0.0)),
    "tool_analog_input1": Output("DOUBLE", _constant(0.0)),
    "tool_output_voltage": Output("INT32", _constant(0)),
    "tool_output_current": Output("DOUBLE", _constant(0.0)),
    "tool_temperature": Output("DOUBLE", _constant(30.0)),
    "tool_output_mode": Output("UINT8", _constant(0)),  # digital outputs
    "tool_digital_output0_mode": Output("UINT8", _constant(1)),  # sinking (NPN)
    "tool_digital_output1_mode": Output("UINT8", _constant(1)),
    "standard_analog_input0": Output("DOUBLE", _constant(0.0)),
    "standard_analog_input1": Output("DOUBLE", _constant(0.0)),
    "standard_analog_output0": Output("DOUBLE", lambda m: m.outputs.analog_value(0)),
    "standard_analog_output1": Output("DOUBLE", lambda m: m.outputs.analog_value(1)),
    "io_current": Output("DOUBLE", _constant(0.0)),
    "euromap67_input_bits": Output("UINT32", _constant(0)),
    "euromap67_output_bits": Output("UINT32", _constant(0)),
    "euromap67_24V_voltage": Output("DOUBLE", _constant(0.0)),
    "euromap67_24V_current": Output("DOUBLE", _constant(0.0)),
    "encoder0_raw": Output("INT32", _constant(0)),
    "encoder1_raw": Output("INT32", _constant(0)),
    "robot_status_bits": Output("UINT32", lambda m: m.status_bits),
    "safety_status_bits": Output("UINT32", lambda m: m.safety_status_bits),
    "ft_raw_wrench": Output("VECTOR6D", lambda m: m.raw_wrench.tolist(), since=((5, 9),)),
    "wrench_calc_from_currents": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "target_gravity": Output("VECTOR3D", lambda m: m.load.gravity.tolist()),
    "target_base_acceleration": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "target_base_wrench": Output("VECTOR6D", _constant(*[0.0] * 6)),
    "payload": Output("DOUBLE", lambda m: m.load.configured_payload.mass, since=((3, 11), (5, 5, 1))),
    "payload_cog": Output("VECTOR3D", lambda m: m.load.configured_payload.centre, since=((3, 11), (5, 5, 1))),
    "payload_inertia": Output("VECTOR6D", lambda m: m.load.inertia.tolist(), since=((3, 15), (5, 11))),
    "tcp_offset": Output("VECTOR6D", lambda m: pose(m.arm.tool).tolist(), since=((5, 3),)),
    "script_control_line": Output("UINT32", _constant(0), since=((3, 14), (5, 9))),
    "output_bit_registers0_to_31": Output("UINT32", _constant(0)),
    "output_bit_registers32_to_63": Output("UINT32", _constant(0)),
    **{f"output_bit_register_{i}": Output("BOOL", _constant(False)) for i in range(64, 128)},
    "input_bit_registers0_to_31": Output("UINT32", _bits(0, 32)),
    "input_bit_registers32_to_63": Output("UINT32", _bits(32, 32)),
    **{f"input_bit_register_{i}": Output("BOOL", _bits(i, 1)) for i in range(64, 128)},
    **{f"output_int_register_{i}": Output("INT32", _register("out_int", i)) for i in range(REGISTERS)},
    **{f"output_double_register_{i}": Output("DOUBLE", _register("out_double", i)) for i in range(REGISTERS)},
    **{f"input_int_register_{i}": Output("INT32", _register("in_int", i)) for i in range(REGISTERS)},
    **{f"input_double_register_{i}": Output("DOUBLE", _register("in_double", i)) for i in range(REGISTERS)},
}

INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    **{f"{kind}_digital_output": "UINT8" for kind in ("standard", "configurable", "tool")},
    **{f"{kind}_digital_output_mask": "UINT8" for kind in ("standard", "configurable", "tool")},
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    **{f"input_bit_register_{i}": "BOOL" for i in range(64, 128)},
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
_DIGITAL = {"standard": (0, 8), "configurable": (8, 8), "tool": (16, 2)}  # first bit, number of bits


def apply_inputs(machine: Machine, given: dict[str, Value | tuple[Value, ...]]) -> None:
    """Writes the values of one input package into the machine."""
    for name, value in given.items():
        kind, _, index = name.rpartition("_")
        if kind == "input_int_register":
            machine.in_int[int(index)] = int(value)  # type: ignore[arg-type]  # by its type in INPUTS
            machine.on_int_register(int(index))
        elif kind == "input_double_register":
            machine.in_double[int(index)] = float(value)  # type: ignore[arg-type]
        elif name.startswith("input_bit_register"):
            first, count = (0, 32) if index == "31" else (32, 32) if index == "63" else (int(index), 1)
            mask = ((1 << count) - 1) << first
            machine.in_bits = machine.in_bits & ~mask | int(value) << first  # type: ignore[arg-type]
    _outputs(machine, given)


def _outputs(machine: Machine, given: dict[str, Value | tuple[Value, ...]]) -> None:
    def number(name: str) -> int:
        value = given.get(name, 0)
        return int(value) if not isinstance(value, tuple) else 0

    for kind, (first, count) in _DIGITAL.items():
        mask = (number(f"{kind}_digital_output_mask") & ((1 << count) - 1)) << first
        if mask:
            wanted = number(f"{kind}_digital_output") << first
            machine.outputs.digital = machine.outputs.digital & ~mask | wanted & mask
    mask = number("standard_analog_output_mask")
    for index in range(2):
        value = given.get(f"standard_analog_output_{index}", 0.0)
        if mask >> index & 1 and not isinstance(value, tuple):
            machine.outputs.analog[index] = float(np.clip(value, 0.0, 1.0))
            machine.outputs.analog_is_voltage[index] = bool(number("standard_analog_output_type") >> index & 1)
    fraction = given.get("speed_slider_fraction")
    if fraction is not None and not isinstance(fraction, tuple) and number("speed_slider_mask"):
        machine.set_slider(float(fraction))
