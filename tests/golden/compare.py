"""Reduce the JSON object of a command to what must hold, and compare two of them within stated tolerances."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

Value = float | int | bool | str | None
Figures = dict[str, Value]

# Keys that differ between two runs of the same code: processor and wall time, versions, hashes, places.
VOLATILE = re.compile(
    r"(^|\.)(seconds|wall_s|cpu_s|elapsed_s|wall_seconds|real_time_factor|pace|started|finished|version|software|hash(es)?|sha256|report|out|folder"
    r"|file|files|path|paths|written|dataset|calibration|recording|backends|compute_ms|timing|host)(\.|$)|_ms$|_wall_s$"
)
RELATIVE = 1e-6  # of a number: another order of additions changes far less
TOLERANCES = (
    # A key (regular expression over "call.key"), and what two processors may differ by, absolute.
    # The corners of a picture come from OpenCV's vector code, which rounds by the processor; seen: 0.06 microdegrees.
    (re.compile(r"^hand_eye_pictures\."), 1e-6),
    (re.compile(r"^(demo|weld|live)\w*\..*(_mm|mm)(\.|$)"), 0.01),
    (re.compile(r"^(demo|weld|live)\w*\."), 0.01),
)


def figures(document: object) -> Figures:
    """Every number, truth value and single word of a JSON object, by its path of keys; sentences are left out."""
    return {key: value for key, value in _walk(document, "") if not VOLATILE.search(key)}


def _walk(value: object, key: str) -> Iterator[tuple[str, Value]]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _walk(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _walk(item, f"{key}.{k}")
    elif isinstance(value, str):
        if re.fullmatch(r"[\w-]{1,40}", value):
            yield key, value
    elif isinstance(value, bool | int | float) or value is None:
        yield key, value


def tolerance(call: str, key: str) -> float:
    """The absolute difference that a key of a call may have, besides the relative one."""
    return next((most for pattern, most in TOLERANCES if pattern.search(f"{call}.{key}")), 1e-9)


def differences(call: str, held: Figures, now: Figures) -> list[str]:
    """What differs between the held figures and those of now, a line each."""
    found = [f"{key}: is gone (was {held[key]})" for key in held.keys() - now.keys()]
    found += [f"{key}: is new ({now[key]})" for key in now.keys() - held.keys()]
    for key in held.keys() & now.keys():
        a, b = held[key], now[key]
        if isinstance(a, float | int) and isinstance(b, float | int) and not isinstance(a, bool):
            if not math.isclose(a, b, rel_tol=RELATIVE, abs_tol=tolerance(call, key)):
                found.append(f"{key}: {b!r}, was {a!r}")
        elif a != b:
            found.append(f"{key}: {b!r}, was {a!r}")
    return sorted(found)


def rounded(found: Figures) -> Figures:
    """The figures with nine significant digits, as they are kept."""
    return {
        key: float(np.format_float_positional(v, 9, fractional=False)) if isinstance(v, float) and np.isfinite(v) else v
        for key, v in sorted(found.items())
    }


RESULTS = Path(__file__).with_name("results")
