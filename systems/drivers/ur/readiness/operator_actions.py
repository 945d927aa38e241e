"""Operator actions, one sentence for each condition that prevents a start, in the menu names of PolyScope 5.

`as_on_x` puts those of PolyScope X in their place.
"""

ROBOT_MODES = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: "RUNNING",
    8: "UPDATING_FIRMWARE",
}
SAFETY_MODES = {
    1: "NORMAL",
    2: "REDUCED",
    3: "PROTECTIVE_STOP",
    4: "RECOVERY",
    5: "SAFEGUARD_STOP",
    6: "SYSTEM_EMERGENCY_STOP",
    7: "ROBOT_EMERGENCY_STOP",
    8: "VIOLATION",
    9: "FAULT",
    10: "VALIDATE_JOINT_ID",
    11: "UNDEFINED_SAFETY_MODE",
}
RUNTIME_STATES = {0: "STOPPING", 1: "STOPPED", 2: "PLAYING", 3: "PAUSING", 4: "PAUSED", 5: "RESUMING"}

VERSION = "The controller's software is not supported: install PolyScope 5.12 or newer, or PolyScope X 10.10 or newer."
DASHBOARD = "The dashboard's answer does not follow the PolyScope 5 protocol: restart the control box."
LOCAL = (
    "The robot is in local control: tap the Local icon at the upper right of the pendant and choose Remote Control "
    "(where there is none, enable it first under Settings > System > Remote Control)."
)
STANDSTILL = "The arm is moving: let go of Freedrive and of the Move tab's arrows, and wait until it stands still."
TCP = (
    "The TCP is not zero: open Installation > General > TCP on the pendant, set X, Y, Z, RX, RY and RZ of the default "
    "TCP to 0, and save the installation."
)
NO_PAYLOAD = "The controller does not report its payload: update PolyScope to 5.12 or newer."
MANUAL = (
    "The robot is in Manual mode, in which the arm moves only while the three-position enabling device is held: tap the"
    " mode at the upper right of the pendant and choose Automatic."
)
SLIDER = (
    "The speed slider is not at 100 %: drag the slider at the bottom of the pendant's screen all the way to the right."
)
REGISTERS = (
    "Input registers are in use by EtherNet/IP, PROFINET or another client: press Disable under Installation > Fieldbus"
    " > EtherNet/IP and > PROFINET on the pendant, and close every other program that controls this robot."
)
NO_REGISTERS = "The controller lacks the input registers that the driver needs: update PolyScope to 5.12 or newer."
POSE = (
    "The flange pose computed here is not the controller's: set the TCP to zero under Installation > General > TCP, "
    "restart the control box so that it reads the arm's calibration again, and do not run this robot until they agree."
)

_INITIALIZE = "press Initialize at the lower left of the pendant"
_ON_START = f"{_INITIALIZE}, then ON, then START"


def power(robot_mode: int) -> str:
    """Return the operator action where the arm is not RUNNING."""
    match robot_mode:
        case 1:
            return "The safety configuration is not confirmed: confirm it in the pop-up on the pendant."
        case 4 | 5:
            return f"The brakes are on: {_INITIALIZE}, then START."
        case 6:
            return "The arm is in backdrive: leave it with the button on the Initialize screen, then press START there."
        case 8:
            return "The controller updates its firmware: wait until the pendant says that it is done."
        case 3:
            return f"The arm has no power: {_ON_START}."
    return f"The controller is not connected to its arm: wait until PolyScope has started, then {_ON_START}."


def safety(safety_mode: int) -> str:
    """Return the operator action where the safety system has stopped the arm."""
    match safety_mode:
        case 3:
            return (
                "The robot is in a protective stop: find out what stopped it, clear the way, and press Enable Robot in "
                "the pop-up on the pendant, which works 5 s after the stop."
            )
        case 4:
            return (
                "The robot is in recovery mode because a safety limit is violated: move the arm back within its limits "
                "with Freedrive or the Move tab."
            )
        case 5:
            return (
                "A safeguard stop is active: close the safety gate (or press the enabling device), and press the "
                "safeguard's reset button where it has one."
            )
        case 6 | 7:
            where = "in the cell (system emergency stop)" if safety_mode == 6 else "on the pendant"
            return (
                f"An emergency stop is pressed {where}: make sure that nobody is in danger, turn the red button to "
                f"release it, and {_ON_START}."
            )
    return (
        f"The safety system reports {SAFETY_MODES.get(safety_mode, safety_mode)}: read the Log tab of the pendant,"
        " correct the error that it shows, and press Restart Safety in the pop-up."
    )


def outputs(missing: list[str]) -> str:
    """The operator action where a controller of a supported version does not report what each of them reports."""
    return (
        f"The controller does not report {', '.join(missing)}, which every supported PolyScope reports: restart the"
        " control box, and connect this computer to it directly, not through a program that passes RTDE on."
    )


def payload(owner: str, text: str) -> str:
    """Return the operator action where the payload is not the expected one."""
    return (
        f"The payload is not that of {owner}: set {text} under Installation > General > Payload on the pendant and save"
        " the installation, or give what hangs on the flange as payload_kg and payload_cog_m in the scenario."
    )


def mounting(wanted: str) -> str:
    """Return the operator action where the robot's mounting is not the scenario's."""
    return (
        "The robot's mounting is not that of the scenario: set it under Installation > General > Mounting on the"
        f" pendant, or correct base.rpy_deg in the scenario, by which up is {wanted} in the robot's base."
    )


def model(told: str, wanted: str) -> str:
    """Return the operator action where the controller's arm is another model than the scenario's."""
    return (
        f"The controller says that its arm is a {told}, and the scenario's is a {wanted}: connect a {wanted}, or write"
        " this robot's arm in the scenario as arm."
    )


def limits(joint: str) -> str:
    """Return the operator action where a joint is too near its limit."""
    return (
        f"The {joint} joint is less than 5 degrees from its limit, or beyond it: turn it back with the Move tab of the"
        " pendant."
    )


def program(state: str, name: str) -> str:
    """Return the operator action where another program runs or is paused."""
    which = f"the program {name}" if name and not name.startswith("<") else "a program"
    return (
        f"The robot is busy with {which} ({state}): press Stop at the bottom of the pendant's screen; weldcal "
        "does not stop other programs."
    )


# PolyScope 5's menus, and PolyScope X's: https://www.universal-robots.com/manuals SW10_12 (safety overview, mode
# selection), and the pictures and files of UR's client library (Robot State, Speed, Application, Services). The first
# that fit are taken first.
X_MENUS = (
    (
        "tap the Local icon at the upper right of the pendant and choose Remote Control (where there is none, enable it"
        " first under Settings > System > Remote Control)",
        "tap the safety overview at the upper right of the pendant, then Mode Selection > Automatic > Remote",
    ),
    (
        "tap the mode at the upper right of the pendant and choose Automatic",
        "tap the safety overview at the upper right of the pendant, then Mode Selection > Automatic",
    ),
    ("switch it to Remote Control (top right of the pendant)", "choose Remote in the pendant's safety overview"),
    (_ON_START, "tap Robot State at the lower left of the pendant, switch the arm on and release its brakes"),
    (f"{_INITIALIZE}, then START", "tap Robot State at the lower left of the pendant and release them"),
    ("the Initialize screen, then press START there", "the Robot State panel, then release the brakes there"),
    ("Installation > General > TCP", "Application > End Effector"),
    ("Installation > General > Payload", "Application > End Effector"),
    ("Installation > General > Mounting", "Application > Mounting"),
    ("save the installation", "save the program"),
    ("of the default TCP", "of the active TCP"),
    (
        "press Disable under Installation > Fieldbus > EtherNet/IP and > PROFINET on the pendant",
        "switch Ethernet/IP Adapter and Profinet Device off under Settings > Security > Services on the pendant",
    ),
    (
        "drag the slider at the bottom of the pendant's screen all the way to the right",
        "press + beside Speed at the lower right of the pendant's screen until it shows 100 %",
    ),
    ("The speed slider", "Speed"),
    ("press Enable Robot in the pop-up on the pendant", "unlock it in the message on the pendant"),
    ("press Enable Robot on the pendant", "unlock it on the pendant"),
    ("move the speed slider to 100 % on the pendant", "set Speed at the lower right of the pendant to 100 %"),
    ("check payload, speed slider", "check payload, speed"),
    ("an action in Installation > I/O", "an action of an output in Application"),
    ("read the Log tab of the pendant", "read the message on the pendant"),
    ("press Restart Safety in the pop-up", "restart the safety system there"),
    ("Move tab's arrows", "Move panel's arrows"),
    ("the Move tab", "the Move panel"),
    ("The dashboard's answer does not follow the PolyScope 5 protocol", "The Robot API's answer is not known"),
    ("update PolyScope to 5.12 or newer", "update PolyScope X to 10.12 or newer"),
    ("see its Log tab for an error", "see its log for an error"),
)


def as_on_x(action: str) -> str:
    """Return an operator action with the menus of PolyScope X in place of PolyScope 5's."""
    for five, ten in X_MENUS:
        action = action.replace(five, ten)
    return action
