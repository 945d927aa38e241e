"""Client of the PolyScope 5 dashboard: sends one command line and reads one answer, on a new connection each time."""

from weldcal.systems.drivers.ur.faults import RobotUnreachable
from weldcal.systems.drivers.ur.wire.line import SocketLine

DASHBOARD_PORT = 29999
SCRIPT_PORT = 30003


def ask(host: str, command: str, timeout_s: float = 2.0, port: int = DASHBOARD_PORT) -> str:
    """The controller's answer to one dashboard command, such as `is in remote control`.

    Args:
        host: name or address of the controller.
        command: one line, without its newline.
        timeout_s: longest time of the connection, and of the exchange.
        port: port of the dashboard.

    Raises:
        RobotUnreachable: no dashboard answers in time (PolyScope X has none).
    """
    with SocketLine(host, port, "Dashboard Server", timeout_s) as line:
        until = line.deadline()
        if not line.read_line(until).startswith("Connected"):
            raise line.nonsense()
        line.send(f"{command}\n".encode())
        return line.read_line(until)


def stop_program(host: str, timeout_s: float = 2.0) -> str:
    """Stop the running or paused program; returns "Stopped", the controller's refusal, or an empty text.

    After a fault only a stop is safe: `play` would continue with the velocity that the registers still hold. Where
    there is no dashboard (PolyScope X), the command goes to the script port, which does not answer.

    Raises:
        RobotUnreachable: neither port answers in time.
    """
    try:
        return ask(host, "stop", timeout_s)
    except RobotUnreachable:
        with SocketLine(host, SCRIPT_PORT, "Script", timeout_s) as line:
            line.send(b"stop program\n")
        return ""
