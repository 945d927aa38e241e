"""The faults for which the UR driver stops the arm, each with its message and operator action."""

from enum import IntEnum

from weldcal.models.errors import WeldcalError


class RobotRefused(WeldcalError):
    """The robot or its state does not allow the job to start; nothing has moved."""


class RobotUnreachable(RobotRefused):
    """Nothing answers at the robot's address."""


class Fault(IntEnum):
    """The first fault is latched; only a new start clears it."""

    NONE = 0
    LINK_STALE = 1
    LINK_CLOSED = 2
    WORKER_DIED = 3
    CONTROLLER_DEAF = 4
    CLOCK_JUMPED = 5
    STATE_IMPLAUSIBLE = 6
    STATE_DAMAGED = 7
    STATE_NOT_FINITE = 8
    SET_POINT = 9
    COMMAND_LATE = 10
    COMMAND_NOT_FINITE = 11
    COMMAND_TOO_FAST = 12
    COMMAND_JUMPED = 13
    JOINT_LIMIT = 14
    TRACKING = 15
    POSE_MISMATCH = 16
    SPEED_SLIDER = 17
    GUARD_LATCHED = 18
    PROCESS_OUTPUT = 19
    PROTECTIVE_STOP = 20
    SAFEGUARD_STOP = 21
    EMERGENCY_STOP = 22
    SAFETY_VIOLATION = 23
    RECOVERY_MODE = 24
    ROBOT_NOT_RUNNING = 25
    PROGRAM_STOPPED = 26
    PROGRAM_PAUSED = 27
    ARC_FAULT = 28
    ARC_INPUT = 29
    GUARD_REFUSED = 30
    UPLOAD_REFUSED = 31
    CONTROL_REFUSED = 32
    START_FAILED = 33
    TCP_NOT_ZERO = 34
    OUTPUT_IN_USE = 35
    PAYLOAD_NOT_SET = 36


SENTENCES = {
    Fault.LINK_STALE: (
        "LINK: the robot's newest state is {detail:.0f} ms old; check the network cable and the load of this computer,"
        " then start again."
    ),
    Fault.LINK_CLOSED: (
        "LINK: the controller closed the connection; check the network cable and that the controller is on, then start"
        " again."
    ),
    Fault.WORKER_DIED: (
        "LINK: the connection failed, and its worker process ended; check that the controller is on, and the cable,"
        " then start again."
    ),
    Fault.CONTROLLER_DEAF: (
        "LINK: the controller has not taken a command for {detail:.0f} ms; "
        "check the cable, and that no other program runs or writes its registers; start again."
    ),
    Fault.CLOCK_JUMPED: (
        "LINK: the controller's clock jumped by {detail:.3f} s; if it was restarted, start again when it is ready."
    ),
    Fault.STATE_IMPLAUSIBLE: (
        "LINK: a joint was reported {detail:.3f} rad from where it was 4 ms before; check the network and start again."
    ),
    Fault.STATE_DAMAGED: (
        "LINK: the controller's mode was reported as {detail:.0f}, which does not exist: its packages arrive damaged;"
        " check the cable, the switch and the network card, and start again."
    ),
    Fault.STATE_NOT_FINITE: (
        "LINK: the controller reported {reason} as not a finite number; check the network, restart the control box, and"
        " start again."
    ),
    Fault.COMMAND_LATE: (
        "COMMAND LATE: the cell gave no new velocity for {detail:.0f} ms while the arm moved or the process was on; "
        "close other programs here and start again."
    ),
    Fault.COMMAND_NOT_FINITE: (
        "COMMAND: a velocity that is not a number was refused; this is a mistake of the program, report it."
    ),
    Fault.COMMAND_TOO_FAST: (
        "COMMAND: a joint velocity of {detail:.2f} rad/s was refused; this is a mistake of the program, report it."
    ),
    Fault.COMMAND_JUMPED: (
        "COMMAND: a jump of {detail:.2f} rad/s in joint velocity was refused; this is a mistake of the program,"
        " report it."
    ),
    Fault.JOINT_LIMIT: (
        "JOINT LIMIT: joint {detail:.0f} would have reached its limit; start the job from another arm configuration."
    ),
    Fault.TRACKING: (
        "TRACKING: a joint is {detail:.3f} rad from where its commands lead; check payload, speed slider and that"
        " nothing holds the arm."
    ),
    Fault.POSE_MISMATCH: (
        "POSE: the controller's pose is {detail:.2f} mm off that of the joints; set the TCP to zero in Installation >"
        " General > TCP."
    ),
    Fault.SPEED_SLIDER: (
        "SPEED SLIDER: the controller lets {detail:.0f} % of the speed through; move the speed slider to 100 % on the"
        " pendant and start again."
    ),
    Fault.GUARD_LATCHED: (
        "GUARD: the script on the controller stopped the arm, {reason}; check the cable and the load of this computer,"
        " then start again."
    ),
    Fault.PROCESS_OUTPUT: (
        "PROCESS OUTPUT: the torch's output {reason}; find what else writes it "
        "(a program, a PLC, Modbus, an action in Installation > I/O), stop that and start again."
    ),
    Fault.SET_POINT: (
        "SET POINT: an analog output of the power source is at {detail:.0f} % of its range and not at its set point;"
        " find what else writes it (a program, a PLC, Modbus, the I/O tab) or changed its range, stop that and start"
        " again."
    ),
    Fault.PROTECTIVE_STOP: (
        "PROTECTIVE STOP: look for the cause, press Enable Robot on the pendant after 5 s, and start again."
    ),
    Fault.SAFEGUARD_STOP: "SAFEGUARD STOP: close the safeguard, press its reset, and start again.",
    Fault.EMERGENCY_STOP: (
        "EMERGENCY STOP: release the button, switch the arm on and release its brakes on the pendant, and start again."
    ),
    Fault.SAFETY_VIOLATION: (
        "SAFETY FAULT: the safety system reports mode {detail:.0f}; restart the safety system on the pendant, then"
        " start again."
    ),
    Fault.RECOVERY_MODE: (
        "RECOVERY MODE: the arm is outside its safety limits; move it back by hand in recovery mode, then start again."
    ),
    Fault.ROBOT_NOT_RUNNING: (
        "ROBOT NOT RUNNING: the arm is in mode {detail:.0f}; switch it on and release its brakes on the pendant, then"
        " start again."
    ),
    Fault.PROGRAM_STOPPED: "PROGRAM STOPPED: the program on the controller was stopped; start again.",
    Fault.PROGRAM_PAUSED: (
        "PROGRAM PAUSED: the program on the controller was paused; press Stop, not Play, on the pendant, and start"
        " again."
    ),
    Fault.ARC_FAULT: (
        "ARC: the power source reports a fault; look for its message (gas, wire, cooling, no contact), clear it and"
        " start again."
    ),
    Fault.ARC_INPUT: (
        "ARC INPUT: the power source's input reports an arc although the torch is off; look whether somebody else burns"
        " it, and at the input's wire (robot.arc_input), then start again."
    ),
    Fault.GUARD_REFUSED: (
        "An old command in the controller's registers could not be cleared: close the program that writes them and"
        " start again."
    ),
    Fault.UPLOAD_REFUSED: (
        "The controller did not start the guard script: switch it to Remote Control (top right of the pendant), or see"
        " its Log tab for an error."
    ),
    Fault.CONTROL_REFUSED: (
        "The controller refused the connection: its registers may be in use by EtherNet/IP or another client; run"
        " `weldcal check-robot`."
    ),
    Fault.TCP_NOT_ZERO: (
        "The TCP could not be set to zero: set it to zero in Installation > General > TCP on the pendant and start"
        " again."
    ),
    Fault.PAYLOAD_NOT_SET: (
        "The controller did not take the payload: set it in Installation > General > Payload on the pendant and start"
        " again."
    ),
    Fault.OUTPUT_IN_USE: (
        "An output of the torch (robot.process_output, or a set point) is taken: close the other RTDE client or"
        " fieldbus that writes the outputs."
    ),
    Fault.START_FAILED: (
        "The worker process of the robot link could not start; run `weldcal check-robot` and try again."
    ),
}


# codes that the guard script writes into its output register when it latches
GUARD_REASONS = {
    3: "because no new command came for 40 ms while the torch was on",
    4: "because a joint velocity was too high",
    5: "because no new command came for 150 ms",
}


# the detail of a PROCESS_OUTPUT fault: the output's level
OUTPUT_REASONS = {0: "is off although it should be on", 1: "went on although it should be off"}


# the detail of a STATE_NOT_FINITE fault: what the output's name begins with
REPORTED = (
    "an output",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "speed_scaling",
    "target_speed_fraction",
    "timestamp",
    "output_double_register",
    "standard_analog_output",
    "tcp_offset",
    "payload",
)


def reported_as(name: str) -> float:
    """Return the detail of a STATE_NOT_FINITE fault for this RTDE output."""
    return float(max(k for k, start in enumerate(REPORTED) if k == 0 or name.startswith(start)))


def sentence(fault: Fault, detail: float = 0.0) -> str:
    """Return the message of a fault, with the operator action."""
    lists = {Fault.PROCESS_OUTPUT: OUTPUT_REASONS, Fault.STATE_NOT_FINITE: dict(enumerate(REPORTED))}
    reasons = lists.get(fault, GUARD_REASONS)
    return SENTENCES[fault].format(detail=detail, reason=reasons.get(int(detail), "for an unknown reason"))
