"""Recipes of the RTDE that other clients ask for: every field is known, with its type."""

from __future__ import annotations

import math
import time

import pytest

from robot.common.kinematics import MODELS
from robot.mock import MockUR
from tests.robot.mock.wire_client import TIMEOUT, RtdeClient

ROS = """timestamp actual_q actual_qd speed_scaling target_speed_fraction runtime_state actual_TCP_force actual_TCP_pose
target_TCP_pose tcp_offset actual_digital_input_bits actual_digital_output_bits standard_analog_input0
standard_analog_input1 standard_analog_output0 standard_analog_output1 analog_io_types tool_mode tool_analog_input_types
tool_analog_input0 tool_analog_input1 tool_output_voltage tool_output_current tool_temperature robot_mode safety_mode
robot_status_bits safety_status_bits actual_current"""


RECORD = """timestamp:DOUBLE target_q:VECTOR6D target_qd:VECTOR6D target_qdd:VECTOR6D target_current:VECTOR6D
target_moment:VECTOR6D actual_q:VECTOR6D actual_qd:VECTOR6D actual_current:VECTOR6D joint_control_output:VECTOR6D
actual_TCP_pose:VECTOR6D actual_TCP_speed:VECTOR6D actual_TCP_force:VECTOR6D target_TCP_pose:VECTOR6D
target_TCP_speed:VECTOR6D actual_digital_input_bits:UINT64 joint_temperatures:VECTOR6D actual_execution_time:DOUBLE
robot_mode:INT32 joint_mode:VECTOR6INT32 safety_status:INT32 actual_tool_accelerometer:VECTOR3D speed_scaling:DOUBLE
target_speed_fraction:DOUBLE actual_momentum:DOUBLE actual_main_voltage:DOUBLE actual_robot_voltage:DOUBLE
actual_robot_current:DOUBLE actual_joint_voltage:VECTOR6D actual_digital_output_bits:UINT64 runtime_state:UINT32
joint_position_deviation_ratio:DOUBLE"""

OTHERS = """payload:DOUBLE payload_cog:VECTOR3D payload_inertia:VECTOR6D ft_raw_wrench:VECTOR6D
script_control_line:UINT32 actual_current_window:VECTOR6D elbow_position:VECTOR3D elbow_velocity:VECTOR3D
robot_status_bits:UINT32
safety_status_bits:UINT32 safety_mode:INT32 io_current:DOUBLE tool_mode:UINT32 tcp_force_scalar:DOUBLE
tcp_offset:VECTOR6D analog_io_types:UINT32 standard_analog_input0:DOUBLE standard_analog_output1:DOUBLE
tool_analog_input_types:UINT32 tool_output_voltage:INT32 tool_output_current:DOUBLE tool_output_mode:UINT8
tool_digital_output0_mode:UINT8 tool_digital_output1_mode:UINT8 euromap67_input_bits:UINT32
euromap67_output_bits:UINT32 euromap67_24V_voltage:DOUBLE euromap67_24V_current:DOUBLE
actual_configurable_digital_input_bits:UINT64 actual_configurable_digital_output_bits:UINT64 encoder0_raw:INT32
encoder1_raw:INT32 output_bit_register_127:BOOL output_int_register_47:INT32 output_double_register_47:DOUBLE
actual_TCP_acceleration:VECTOR6D target_TCP_acceleration:VECTOR6D target_execution_time:DOUBLE control_step:UINT64
collision_detection_ratio:DOUBLE wrench_calc_from_currents:VECTOR6D time_scale_source:INT32 target_gravity:VECTOR3D
target_base_acceleration:VECTOR6D target_base_wrench:VECTOR6D"""


@pytest.mark.parametrize("recipe", [RECORD, OTHERS], ids=["record", "others"])
def test_recipes_of_ur_clients_are_accepted(mock: MockUR, recipe: str) -> None:
    """record_configuration.xml of RTDE_Python_Client_Library, which refuses a controller that answers other types; the
    other fields of it and of Universal_Robots_Client_Library."""
    expected = dict(each.split(":") for each in recipe.split())
    with RtdeClient(mock.host) as client:
        client.protocol()
        number, types = client.outputs(*expected, frequency=125.0)
        assert dict(zip(expected, types, strict=True)) == expected and number == 1
        assert client.start()
        state = client.receive()
    assert all(math.isfinite(value) for values in state.values() for value in values)


def test_fields_of_newer_controllers_need_their_version(mock: MockUR) -> None:
    names = ("actual_robot_energy_consumed", "actual_robot_braking_energy_dissipated")
    for version, types in (((5, 22), ["NOT_FOUND"] * 2), ((5, 23), ["DOUBLE"] * 2), ((10, 10), ["NOT_FOUND"] * 2)):
        mock.faults.version(*version)
        with RtdeClient(mock.host) as client:
            assert client.protocol() and client.outputs(*names)[1] == types


def test_recipe_of_ros_driver_is_accepted(mock: MockUR) -> None:
    """ur_robot_driver/resources/rtde_output_recipe.txt of the ROS 2 driver."""
    with RtdeClient(mock.host) as client:
        client.protocol()
        assert client.outputs(*ROS.split())[0] == 1
        client.start()
        state = client.receive()
    assert state["tool_mode"] == (253,) and state["analog_io_types"] == (0,)


def test_bit_registers_and_elbow_have_values(mock: MockUR) -> None:
    inputs = [f"input_bit_register{which}" for which in ("s0_to_31", "s32_to_63", "_64", "_127")]
    with RtdeClient(mock.host) as client:
        client.protocol()
        client.outputs(*inputs, "elbow_position", "output_bit_register_64", "tcp_force_scalar")
        recipe, _ = client.inputs(*inputs)
        client.start()
        for bits in ((0xFFFFFFFF, 0x80000001, True, True), (5, 0, False, True)):
            client.send(recipe, *bits)
            deadline = time.monotonic() + TIMEOUT
            while tuple(client.receive()[name][0] for name in inputs) != bits:
                assert time.monotonic() < deadline
        mock.faults.wrench([3, 4, 12, 1, 1, 1])
        while (state := client.receive())["tcp_force_scalar"][0] != 13:
            assert time.monotonic() < deadline
    upper_arm = MODELS["ur5e"].d1 - MODELS["ur5e"].a2  # upright: joint 2 is at -90 degrees
    assert state["elbow_position"] == pytest.approx((0, 0, upper_arm), abs=1e-9)
