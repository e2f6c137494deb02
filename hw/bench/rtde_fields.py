"""Names and types of the controller's real-time data, as far as ur_rtde asks for them."""

from __future__ import annotations

VECTOR6D, VECTOR3D, VECTOR6INT32 = "VECTOR6D", "VECTOR3D", "VECTOR6INT32"
DOUBLE, UINT64, UINT32, INT32 = "DOUBLE", "UINT64", "UINT32", "INT32"

STRUCT = {
    VECTOR6D: "6d",
    VECTOR3D: "3d",
    VECTOR6INT32: "6i",
    DOUBLE: "d",
    UINT64: "Q",
    UINT32: "I",
    INT32: "i",
}
"""struct's code of each type; all of it is big-endian."""

_SIX = [
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "joint_temperatures",
    "actual_joint_voltage",
    "actual_current_as_torque",
    "ft_raw_wrench",
    "payload_inertia",
    "tcp_offset",
]
_NUMBERS = [
    "timestamp",
    "actual_execution_time",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "standard_analog_input0",
    "standard_analog_input1",
    "standard_analog_output0",
    "standard_analog_output1",
    "payload",
]

OUTPUTS: dict[str, str] = {
    **dict.fromkeys(_SIX, VECTOR6D),
    **dict.fromkeys(_NUMBERS, DOUBLE),
    "joint_mode": VECTOR6INT32,
    "actual_tool_accelerometer": VECTOR3D,
    "payload_cog": VECTOR3D,
    "actual_digital_input_bits": UINT64,
    "actual_digital_output_bits": UINT64,
    "runtime_state": UINT32,
    "robot_status_bits": UINT32,
    "safety_status_bits": UINT32,
    "robot_mode": INT32,
    "safety_mode": INT32,
    **{f"output_int_register_{k}": INT32 for k in range(48)},
    **{f"output_double_register_{k}": DOUBLE for k in range(48)},
}

INPUTS: dict[str, str] = {
    **{f"input_int_register_{k}": INT32 for k in range(48)},
    **{f"input_double_register_{k}": DOUBLE for k in range(48)},
    "external_force_torque": VECTOR6D,
}

_SINCE: dict[str, tuple[tuple[int, int], ...]] = {
    "actual_current_as_torque": ((5, 23),),
    "ft_raw_wrench": ((5, 9),),
    "payload": ((3, 11), (5, 5)),
    "payload_cog": ((3, 11), (5, 5)),
    "payload_inertia": ((3, 15), (5, 11)),
    "tcp_offset": ((5, 0),),
}


def output_type(name: str, version: tuple[int, ...]) -> str:
    """Type of an output variable; ``NOT_FOUND`` where a controller of that version has none."""
    since = _SINCE.get(name)
    if since and not any(version[0] == major and version[1] >= minor for major, minor in since):
        return "NOT_FOUND"
    return OUTPUTS.get(name, "NOT_FOUND")
