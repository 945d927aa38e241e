"""Names the keys and drivers of a scenario that its schema does not have, each with the nearest known one."""

import dataclasses as dc
from types import UnionType
from typing import Any, get_args, get_origin

from weldcal.models.errors import InputError
from weldcal.models.keys import nearest


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
    near = nearest(word, known)
    if near is not None:
        return f"; the nearest one is '{mark}{near}'"
    listed = ", ".join(f"{mark}{name}" for name in known)
    return f"; known are {listed}"
