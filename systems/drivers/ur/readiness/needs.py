"""What the pre-flight reads over RTDE, and which check needs which to have passed."""

OUTPUTS = (
    "runtime_state",
    "robot_mode",
    "safety_mode",
    "speed_scaling",
    "target_speed_fraction",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "tcp_offset",
)
# Without power there are no joint positions and no kinematics; without a dashboard remote control cannot be checked.
WAITS_FOR = {
    "standstill": ("power",),
    "joint limits": ("power",),
    "kinematics": ("power",),
    "flange pose": ("power", "kinematics"),
    "model": ("program",),
    "operational mode": ("program",),
    "remote control": ("program",),
}
