"""Checks the numbers of a scenario: finite, with the required sign and list length."""

import dataclasses as dc
import math
from typing import Any

from weldcal.models.errors import InputError

POSITIVE = {
    *("required_error_mm", "theta_max_deg", "guess_radius_mm", "verification_limit_mm", "clearance_m", "clearance_mm"),
    *(
        "speed_mm_s",
        "deflection_mm",
        "axial_deflection_mm",
        "seam_length_mm",
        "length_mm",
        "hole_from_mm",
        "bend_radius_mm",
    ),
    *("maximum_time_s", "control_period_s", "following_error_rad"),
    *("pace", "velocity_share", "spread_deg", "travel_deg"),
    *("rate_hz", "focal_px", "field_of_view_deg", "width", "height", "recording_fps", "cloud_points"),
}
NOT_NEGATIVE = {
    *("exposure_s", "latency_s", "noise_grey", "hidden_from_s", "verification_scans", "payload_kg"),
    *("repeatability_mm", "work_radius_mm"),
    *("translation_mm", "rotation_deg", "mounting_translation_mm", "mounting_rotation_deg"),
    *("placement_translation_mm", "placement_rotation_deg"),
}
LENGTHS = {"xyz_m": 3, "rpy_deg": 3, "work_point_m": 3, "start_m": 3, "home_deg": 6, "payload_cog_m": 3}


def check_numbers(config: Any, place: str = "") -> None:
    """Check all numbers in a tree of configuration dataclasses.

    Raises:
        InputError: a number (or list of numbers) is invalid; the message names the first such key.
    """
    for field in dc.fields(config):
        value, key = getattr(config, field.name), f"{place}{field.name}"
        if dc.is_dataclass(value):
            check_numbers(value, f"{key}.")
            continue
        if isinstance(value, list) and len(value) != LENGTHS.get(field.name, len(value)):
            raise InputError(f"{key} must hold {LENGTHS[field.name]} numbers, not {len(value)}.")
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check(key, field.name, float(number))


def _check(key: str, name: str, number: float) -> None:
    if not math.isfinite(number):
        raise InputError(f"{key} must be finite, not {number}.")
    if name in POSITIVE and number <= 0.0:
        raise InputError(f"{key} must be a positive number, not {number:g}.")
    if name in NOT_NEGATIVE and number < 0.0:
        raise InputError(f"{key} must not be negative, and it is {number:g}.")
