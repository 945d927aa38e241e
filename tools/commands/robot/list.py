"""weldcal robots: the known robots and the sources of their data."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated

import typer

from weldcal.models.robots import ROBOTS, Robot, get_robot
from weldcal.tools import console
from weldcal.tools.cli.options import LOOK, Call, Outcome, command


@command("robots", common=LOOK, short_help="List the known robots and their data.")
def robots(
    call: Call,
    name: Annotated[
        str, typer.Argument(metavar="[NAME]", help="Show only this robot, joint by joint.", show_default=False)
    ] = "",
) -> Outcome:
    """List the known robots: flange by ISO 9409-1, payload, reach, joint limits and the sources of the data."""
    chosen = [get_robot(name)] if name else list(ROBOTS.values())
    summary = {"state": "done", "robots": [_row(robot) for robot in chosen]}
    return Outcome(summary, text=partial(_print_one, chosen[0]) if name else partial(_print_all, chosen))


def _row(robot: Robot) -> Mapping[str, object]:
    """A robot for JSON: metres, kilograms, radians, and degrees where the key says so."""
    chain = robot.chain
    return {
        "name": robot.name,
        "title": robot.title,
        "flange": robot.flange,
        "dowel_deg": math.degrees(robot.pin_angle_rad),
        "payload_kg": robot.payload_kg,
        "reach_m": robot.reach_m,
        "repeatability_mm": 1e3 * robot.repeatability_m,
        "joints": [
            {
                "name": joint,
                "lower_deg": math.degrees(chain.position_lower[k]),
                "upper_deg": math.degrees(chain.position_upper[k]),
                "speed_deg_s": math.degrees(chain.velocity_limit[k]),
            }
            for k, joint in enumerate(chain.joint_names)
        ],
        "inverse_kinematics": robot.inverse,
        "source": robot.source,
        "confirmed": dict(robot.confirmed),
        "unconfirmed": list(robot.unconfirmed),
    }


def _print_all(robots: list[Robot]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for k, heading in enumerate(("name", "flange", "dowel", "kg", "reach m", "± mm", "axes", "inverse")):
        table.add_column(heading, justify="right" if 2 <= k <= 6 else "left", no_wrap=True)
    for r in robots:
        mark = {what: "?" if what in r.unconfirmed else "" for what in ("flange", "payload", "reach", "repeatability")}
        table.add_row(
            *(r.name, f"{r.flange}{mark['flange']}", f"{math.degrees(r.pin_angle_rad):.0f}"),
            *(f"{r.payload_kg:g}{mark['payload']}", f"{r.reach_m:g}{mark['reach']}"),
            *(f"{1e3 * r.repeatability_m:g}{mark['repeatability']}", str(len(r.chain.joint_names)), str(r.inverse)),
        )
    screen = Console()
    screen.print(table)
    screen.print("? unconfirmed: from memory of the maker's data sheet; no public source was found.", highlight=False)
    screen.print("weldcal robots NAME shows one robot, joint by joint, with its sources.", highlight=False)


def _print_one(robot: Robot) -> None:
    rows = {
        "flange": f"{robot.flange}, dowel at {math.degrees(robot.pin_angle_rad):.0f} degrees",
        "payload": f"{robot.payload_kg:g} kg",
        "reach": f"{robot.reach_m:g} m",
        "repeatability": f"± {1e3 * robot.repeatability_m:g} mm",
        "inverse kinematics": str(robot.inverse),
        "source": robot.source,
        **{f"{what}, confirmed by": str(where) for what, where in robot.confirmed},
        "unconfirmed": ", ".join(robot.unconfirmed),
    }
    chain = robot.chain
    limits = zip(chain.joint_names, chain.position_lower, chain.position_upper, chain.velocity_limit, strict=True)
    for joint, lower, upper, speed in limits:
        rows[joint] = (
            f"{math.degrees(lower):.1f} to {math.degrees(upper):.1f} degrees, {math.degrees(speed):.0f} degrees/s"
        )
    console.emit_summary(robot.title, rows)
