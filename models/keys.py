"""Reads a document into a dataclass: an unknown key names the nearest known one, a wrong value what belongs there."""

import dataclasses as dc
import difflib
import math
import types
from collections.abc import Iterable
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from weldcal.models.documents import as_number, shown
from weldcal.models.errors import InputError

Part = TypeVar("Part")

LIKENESS = 0.6
"""Smallest likeness (0 to 1) of a word that is suggested."""


def nearest(word: str, known: Iterable[str], likeness: float = LIKENESS) -> str | None:
    """Find the known word that is most like ``word``; None where none is like it."""
    return next(iter(difflib.get_close_matches(word, list(known), 1, likeness)), None)


def did_you_mean(word: str, known: Iterable[str], otherwise: str, likeness: float = LIKENESS) -> str:
    """The end of a sentence about an unknown word: the nearest known one, or ``otherwise``."""
    near = nearest(word, known, likeness)
    return otherwise if near is None else f"did you mean '{near}'?"


def read_part(kind: type[Part], document: Any, file: str, place: str = "") -> Part:
    """A part of a file as its dataclass; ``place`` names the part in messages, such as `tip`.

    Raises:
        InputError: an unknown key, a missing value, or one of another type; the message names file and key.
    """
    if not isinstance(document, dict):
        raise InputError(f"'{file}': {place or 'the file'} must hold keys and values, not {shown(document)}.")
    types_ = get_type_hints(kind)
    for key in document:
        if key not in types_:
            near = nearest(str(key), types_, 0.5)
            hint = f"did you mean {near}?" if near else f"known are {', '.join(types_)}."
            raise InputError(f"'{file}': {_dotted(place, str(key))} is not a known key: {hint}")
    read: Any = {key: _value(types_[key], value, file, _dotted(place, key)) for key, value in document.items()}
    return kind(**read)


def _dotted(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key


def _value(kind: Any, value: Any, file: str, key: str) -> Any:
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        (kind,) = (k for k in get_args(kind) if k is not types.NoneType)
    if dc.is_dataclass(kind) and isinstance(kind, type):
        return read_part(kind, value, file, key)
    if get_origin(kind) is list:
        if not isinstance(value, list):
            raise InputError(f"'{file}': {key} must be a list, not {shown(value)}.")
        return [_value(get_args(kind)[0], item, file, f"{key}[{i}]") for i, item in enumerate(value)]
    if get_origin(kind) is tuple:
        numbers = [as_number(v) for v in value] if isinstance(value, list) else []
        if len(numbers) != len(get_args(kind)) or not all(math.isfinite(v) for v in numbers):
            raise InputError(f"'{file}': {key} must be {len(get_args(kind))} numbers, not {shown(value)}.")
        return tuple(numbers)
    if kind is str:
        if not isinstance(value, str):
            raise InputError(f"'{file}': {key} must be a text, not {shown(value)}.")
        return value
    number = as_number(value)
    if not math.isfinite(number) or (kind is int and number != int(number)):
        raise InputError(f"'{file}': {key} must be a {'whole ' if kind is int else ''}number, not {shown(value)}.")
    return kind(number)
