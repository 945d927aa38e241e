"""Compares the controller's payload with the one that a job needs, and reads its operational mode."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.drivers.ur.readiness import operator_actions as actions
from weldcal.systems.drivers.ur.wire.rtde_client import Value

PAYLOAD_OUTPUTS = ("payload", "payload_cog")
GRAVITY_OUTPUT = "target_gravity"
MOUNTING_TOLERANCE_RAD = float(np.deg2rad(5.0))  # a mounting is set in whole degrees, and meant within a few
# A pendant shows hundredths of a kilogram and millimetres; a weighed tool is known no better than this.
MASS_TOLERANCE_KG = 0.05
COG_TOLERANCE_M = 0.005  # as many steps of the display: 0.5 N m at 10 kg

# whether it is right, what was found, and the operator action where it is not
Finding = tuple[bool, str, str]


@dataclass(frozen=True)
class ExpectedLoad:
    """The payload that a job sets (kg; centre of gravity in F, m), and whose it is."""

    mass_kg: float
    cog_m: tuple[float, ...]
    owner: str

    @property
    def text(self) -> str:
        """Such as: 1.40 kg at (30, 0, 50) mm."""
        return _text(self.mass_kg, self.cog_m)


def mounting_finding(seen: Mapping[str, Value], up: Array) -> Finding:
    """Compare the controller's gravity (3,) in the base with the scenario's `up` (3,).

    The gravity points up in the controller's convention.
    """
    wanted = _direction(up)
    if GRAVITY_OUTPUT not in seen or not np.linalg.norm(seen[GRAVITY_OUTPUT]) > 1.0:
        return True, f"not readable; Installation > General > Mounting must agree: up is {wanted} in the base", ""
    gravity = np.array(seen[GRAVITY_OUTPUT], dtype=np.float64)
    found = gravity / np.linalg.norm(gravity)
    right = float(np.arccos(np.clip(found @ up, -1.0, 1.0))) <= MOUNTING_TOLERANCE_RAD
    told = f"up is {_direction(found)} in the base"
    return right, told if right else f"{told}, not {wanted}", actions.mounting(wanted)


def payload_finding(seen: Mapping[str, Value], expected: ExpectedLoad | None) -> Finding:
    """Compare the payload with the expected one; without one it is only shown."""
    if not set(PAYLOAD_OUTPUTS) <= seen.keys():
        return False, "not readable", actions.NO_PAYLOAD
    mass, cog = float(np.array(seen["payload"])), np.array(seen["payload_cog"], dtype=np.float64)
    found = _text(mass, tuple(cog))
    if expected is None:
        return True, f"{found} (not compared)", ""
    right = abs(mass - expected.mass_kg) <= MASS_TOLERANCE_KG
    if expected.mass_kg > MASS_TOLERANCE_KG:
        # without a mass its centre means nothing
        right = right and bool(np.abs(cog - np.array(expected.cog_m)).max() <= COG_TOLERANCE_M)
    if right:
        return True, f"{found} ({expected.owner.removeprefix('the ')})", ""
    return False, f"{found}, not {expected.text}", actions.payload(expected.owner, expected.text)


def mode_finding(answer: str) -> Finding:
    """What the answer of dashboard or Robot API to `get operational mode` means.

    An answer that is no mode is shown and not judged.
    """
    mode = answer.strip().upper()
    if mode == "MANUAL":
        return False, "Manual", actions.MANUAL
    if mode == "AUTOMATIC":
        return True, "Automatic", ""
    if mode == "NONE":
        return True, "no operational mode is set up", ""
    return True, "not readable; look at the pendant", ""


def _text(mass_kg: float, cog_m: tuple[float, ...]) -> str:
    x, y, z = (round(1e3 * value) + 0 for value in cog_m)
    return f"{mass_kg:.2f} kg at ({x}, {y}, {z}) mm"


def _direction(up: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in up + 0.0) + ")"
