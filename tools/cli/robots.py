"""weldcal robots: the robots that are known by name, their flanges, limits and kinematics."""

from __future__ import annotations

from typing import Annotated

import typer

from weldcal.tools import console


def robots(
    name: Annotated[
        str, typer.Argument(metavar="[NAME]", help="Only this robot, joint by joint.", show_default=False)
    ] = "",
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    """List the known robots: flange by ISO 9409-1, payload, reach, joint limits, and where the numbers are from."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.models.robots import ROBOTS, get_robot

        chosen = [get_robot(name)] if name else list(ROBOTS.values())
        found = [_row(robot) for robot in chosen]
    if json:
        console.emit_json({"state": "done", "robots": found})
    elif name:
        _print_one(found[0])
    else:
        _print_all(found)


def _row(robot: object) -> dict[str, object]:
    """A robot for JSON: metres, kilograms, radians, and degrees where the key says so."""
    import numpy as np

    from weldcal.models.robots import Robot

    assert isinstance(robot, Robot)
    chain = robot.chain
    return {
        "name": robot.name,
        "title": robot.title,
        "flange": robot.flange,
        "dowel_deg": float(np.degrees(robot.pin_angle_rad)),
        "payload_kg": robot.payload_kg,
        "reach_m": robot.reach_m,
        "repeatability_mm": 1e3 * robot.repeatability_m,
        "joints": [
            {
                "name": joint,
                "lower_deg": float(np.degrees(chain.position_lower[k])),
                "upper_deg": float(np.degrees(chain.position_upper[k])),
                "speed_deg_s": float(np.degrees(chain.velocity_limit[k])),
            }
            for k, joint in enumerate(chain.joint_names)
        ],
        "inverse_kinematics": robot.inverse,
        "source": robot.source,
        "confirmed": dict(robot.confirmed),
        "unconfirmed": list(robot.unconfirmed),
    }


def _print_all(rows: list[dict[str, object]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for k, heading in enumerate(("name", "flange", "dowel", "kg", "reach m", "± mm", "axes", "inverse")):
        table.add_column(heading, justify="right" if 2 <= k <= 6 else "left", no_wrap=True)
    for r in rows:
        joints = r["joints"]
        assert isinstance(joints, list)
        open_ = r["unconfirmed"]
        assert isinstance(open_, list)
        doubt = {what: "?" if what in open_ else "" for what in ("flange", "payload", "reach", "repeatability")}
        cells = (
            *(r["name"], f"{r['flange']}{doubt['flange']}", f"{r['dowel_deg']:.0f}"),
            *(f"{r['payload_kg']:g}{doubt['payload']}", f"{r['reach_m']:g}{doubt['reach']}"),
            *(f"{r['repeatability_mm']:g}{doubt['repeatability']}", str(len(joints)), r["inverse_kinematics"]),
        )
        table.add_row(*map(str, cells))
    console = Console()
    console.print(table)
    console.print(
        "? unconfirmed: as the maker's data sheet is remembered, no public source was found.", highlight=False
    )
    console.print("weldcal robots NAME shows one, joint by joint, with its sources.", highlight=False)


def _print_one(row: dict[str, object]) -> None:
    joints = row["joints"]
    assert isinstance(joints, list)
    rows = {
        "flange": f"{row['flange']}, dowel at {row['dowel_deg']:.0f} degrees",
        "payload": f"{row['payload_kg']:g} kg",
        "reach": f"{row['reach_m']:g} m",
        "repeatability": f"± {row['repeatability_mm']:g} mm",
        "inverse kinematics": str(row["inverse_kinematics"]),
        "source": str(row["source"]),
    }
    confirmed, unconfirmed = row["confirmed"], row["unconfirmed"]
    assert isinstance(confirmed, dict)
    assert isinstance(unconfirmed, list)
    rows |= {f"{what}, confirmed by": str(where) for what, where in confirmed.items()}
    rows["unconfirmed"] = ", ".join(unconfirmed)
    for joint in joints:
        rows[joint["name"]] = (
            f"{joint['lower_deg']:.1f} to {joint['upper_deg']:.1f} degrees, {joint['speed_deg_s']:.0f} degrees/s"
        )
    console.emit_summary(str(row["title"]), rows)
