"""Names the keys and drivers of a scenario that its schema does not have, each with the nearest known one."""

import dataclasses as dc
from difflib import get_close_matches
from types import UnionType
from typing import Any, get_args, get_origin

from weldcal.models.errors import InputError

NEAREST = 0.6  # smallest likeness of a suggestion


def check_keys(schema: type, document: Any, place: str = "") -> None:
    """Check the keys of a parsed YAML document against a dataclass, in all its parts.

    Raises:
        InputError: the first unknown key or driver, with the nearest known one.
    """
    if not isinstance(document, dict):
        return
    known = {field.name: field.type for field in dc.fields(schema)}
    for key, value in document.items():
        if key == "_tag":
            continue
        if key not in known:
            where = f" in {place.rstrip('.')}" if place else ""
            raise InputError(f"The key '{key}'{where} is not known{_suggestion(str(key), known)}.")
        _check_value(known[key], value, f"{place}{key}")


def _check_value(kind: Any, value: Any, place: str) -> None:
    if get_origin(kind) is list and isinstance(value, list):
        for k, item in enumerate(value):
            _check_value(get_args(kind)[0], item, f"{place}[{k}]")
        return
    kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
    choices = {c.__name__: c for c in kinds if isinstance(c, type) and dc.is_dataclass(c)}
    if not choices or not isinstance(value, dict):
        return
    tag = str(value.get("_tag", "")).lstrip("!")
    if tag and tag not in choices:
        raise InputError(f"{place}: there is no driver '!{tag}'{_suggestion(tag, choices, '!')}.")
    check_keys(choices[tag] if tag else next(iter(choices.values())), value, f"{place}.")


def _suggestion(word: str, known: Any, mark: str = "") -> str:
    near = get_close_matches(word, list(known), n=1, cutoff=NEAREST)
    if near:
        return f"; the nearest one is '{mark}{near[0]}'"
    listed = ", ".join(f"{mark}{name}" for name in known)
    return f"; known are {listed}"
