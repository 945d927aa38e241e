"""weldcal robots: list the supported robots, with the sources of their numbers."""

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
    """List the known robots: flange by ISO 9409-1, payload, reach, joint limits; with NAME the source of each."""
    chosen = [get_robot(name)] if name else list(ROBOTS.values())
    summary = {"state": "done", "robots": [_row(robot) for robot in chosen]}
    return Outcome(summary, text=partial(_print_one, chosen[0]) if name else partial(_print_all, chosen))


def _row(robot: Robot) -> Mapping[str, object]:
    """Return a robot for JSON: metres, kilograms, radians, and degrees where the key says so."""
    chain = robot.chain
    return {
        "name": robot.name,
        "title": robot.title,
        "flange": robot.flange,
        "dowel_deg": robot.dowel_deg,
        "payload_kg": robot.payload_kg,
        "reach_m": robot.reach_m,
        "repeatability_mm": robot.repeatability_m and 1e3 * robot.repeatability_m,
        "tcp": robot.tcp,
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
        "sources": dict(robot.sources),
    }


def _print_all(robots: list[Robot]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for k, heading in enumerate(("name", "flange", "dowel", "kg", "reach m", "repeat mm", "axes", "inverse")):
        table.add_column(heading, justify="right" if 2 <= k <= 6 else "left", no_wrap=True)
    for r in robots:
        repeatability = "-" if r.repeatability_m is None else f"{1e3 * r.repeatability_m:g}"
        table.add_row(
            *(r.name, r.flange, "-" if r.dowel_deg is None else f"{r.dowel_deg:g}", f"{r.payload_kg:g}"),
            *(f"{r.reach_m:g}", repeatability, str(len(r.chain.joint_names)), r.inverse),
        )
    screen = Console()
    screen.print(table)
    screen.print(
        "-: not in a public source. dowel: degrees about the tool's z, from x. repeat: repeatability, plus or minus."
        " inverse: all joint angles of a pose are found, or some.",
        highlight=False,
    )
    screen.print(
        "'weldcal robots' with a name shows one robot, joint by joint, with the source of each number.", highlight=False
    )


def _print_one(robot: Robot) -> None:
    values = {
        "flange": robot.flange,
        "dowel": "" if robot.dowel_deg is None else f"{robot.dowel_deg:g} degrees about the tool's z, from x",
        "payload": f"{robot.payload_kg:g} kg",
        "reach": f"{robot.reach_m:g} m",
        "repeatability": "" if robot.repeatability_m is None else f"± {1e3 * robot.repeatability_m:g} mm",
        "joint limits": f"{robot.joints} axes, below",
        "kinematics": f"inverse: {robot.inverse} joint angles of a pose",
        "TCP": robot.tcp,
    }
    rows = {
        fact: f"{value} ({robot.sources[fact]})" if value else "not in a public source"
        for fact, value in values.items()
    }
    chain = robot.chain
    limits = zip(chain.joint_names, chain.position_lower, chain.position_upper, chain.velocity_limit, strict=True)
    for joint, lower, upper, speed in limits:
        rows[joint] = (
            f"{math.degrees(lower):.1f} to {math.degrees(upper):.1f} degrees, {math.degrees(speed):.0f} degrees/s"
        )
    console.emit_summary(robot.title, rows)
