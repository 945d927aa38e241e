"""Checks the numbers of a scenario: finite, within stated bounds, with the required sign and list length."""

import dataclasses as dc
import math
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

import numpy as np

from weldcal.models.arms.kinematics import load_arm
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
    *("exposure_s", "latency_s", "noise_grey", "hidden_from_s", "knock_s", "verification_scans", "payload_kg"),
    *("repeatability_mm", "kinematic_error_mm", "warp_mm", "work_radius_mm"),
    *("translation_mm", "rotation_deg", "mounting_translation_mm", "mounting_rotation_deg"),
    *("placement_translation_mm", "placement_rotation_deg", "margin_m"),
}
LENGTHS = {
    "xyz_m": 3,
    "rpy_deg": 3,
    "work_point_m": 3,
    "start_m": 3,
    "home_deg": 6,
    "payload_cog_m": 3,
    "box_m": 3,
    "gradient_error_per_m": 2,
    "knock_mm": 3,
    "knock_deg": 3,
}


LARGEST = {
    "width": 4096, "height": 4096, "samples": 8192, "recording_fps": 60, "cloud_points": 1_000_000, "maximum_scans": 200,
    "minimum_scans": 200, "verification_scans": 200, "scans": 500, "held_out": 500, "touches": 500, "passes": 50, "columns": 100,
    "rows": 100, "length_mm": 3000, "seam_length_mm": 3000, "maximum_time_s": 86_400, "rate_hz": 1000, "focal_px": 100_000,
    "hole_from_mm": 3000, "theta_max_deg": 89, "speed_mm_s": 500, "control_period_s": 1, "exposure_s": 60, "latency_s": 10,
}  # fmt: skip
"""Largest value of a key, in any part of a scenario."""
LARGEST_OF_UNIT = {
    "_mm": 100_000, "_m": 100, "_deg": 36_000, "_rad": 1000, "_s": 1_000_000, "_px": 100_000, "_mm_s": 10_000, "_kg": 10_000,
    "_per_m": 1e9, "_Hz": 10_000, "_hz": 10_000,
}  # fmt: skip
"""Largest size of any other key that names its unit; the longest unit counts."""
LARGEST_AT_ALL = 1e9
"""Largest size of any number."""


def largest(name: str) -> float:
    """The largest size that the value of a key of this name may have."""
    units = sorted((u for u in LARGEST_OF_UNIT if name.endswith(u)), key=len)
    return LARGEST.get(name, LARGEST_OF_UNIT[units[-1]] if units else LARGEST_AT_ALL)


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
        if isinstance(value, list) and value and all(dc.is_dataclass(item) for item in value):
            for k, item in enumerate(value):
                check_numbers(item, f"{key}[{k}].")
            continue
        _check_type(key, field.type, value)
        if isinstance(value, list) and value and dc.is_dataclass(value[0]):
            for number, item in enumerate(value):
                check_numbers(item, f"{key}[{number}].")
            continue
        if isinstance(value, list) and len(value) != LENGTHS.get(field.name, len(value)):
            raise InputError(f"{key} must hold {LENGTHS[field.name]} numbers, not {len(value)}.")
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check(key, field.name, number)


def _check_type(key: str, kind: Any, value: Any) -> None:
    """Refuses a word where a number belongs: Drake's YAML reader converts plain types, and leaves an optional one as it was."""
    kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
    if value is None and NoneType not in kinds:
        raise InputError(f"{key} has no value; write one, or omit the key.")
    if isinstance(value, str) and str not in kinds and any(k in (int, float, bool) for k in kinds):
        raise InputError(f"{key} must be a number, not '{value}'.")
    listed = next((get_args(k) for k in kinds if get_origin(k) is list), None)
    if isinstance(value, list) and listed in ((float,), (int,)) and not all(isinstance(v, int | float) for v in value):
        raise InputError(f"{key} must hold numbers, not {value}.")
    if isinstance(value, float) and float not in kinds and int in kinds and not value.is_integer():
        raise InputError(f"{key} must be a whole number, not {value:g}.")


def _check(key: str, name: str, number: float) -> None:
    if abs(number) > LARGEST_AT_ALL and math.inf > abs(number):  # a whole number may be too long to be printed
        raise InputError(f"{key} is beyond {LARGEST_AT_ALL:g}.")
    if not math.isfinite(number):
        raise InputError(f"{key} must be finite, not {number}.")
    if abs(number) > largest(name):
        bound = f"at most {largest(name):g}" if number > 0.0 else f"at least {-largest(name):g}"
        raise InputError(f"{key} is {number:g}; it may be {bound}.")
    if name in POSITIVE and number <= 0.0:
        raise InputError(f"{key} must be a positive number, not {number:g}.")
    if name in NOT_NEGATIVE and number < 0.0:
        raise InputError(f"{key} must not be negative, and it is {number:g}.")


def check_home(home_deg: list[float], arm: str, key: str = "home_deg") -> None:
    """Check that an arm can be at home; `key` is the scenario's name of ``home_deg`` (6,).

    Raises:
        InputError: a joint is outside its limits; the message names the first one.
    """
    model = load_arm(arm)
    limits = np.degrees([model.position_lower, model.position_upper]).T
    for joint, (angle, (low, high)) in enumerate(zip(home_deg, limits, strict=True), start=1):
        if not low <= angle <= high:
            raise InputError(
                f"{key} puts joint {joint} of the {arm} at {angle:g} deg, and its limits are {low:g} to {high:g} deg: give an angle "
                "between them."
            )
