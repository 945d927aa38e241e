"""Reads YAML and JSON files of bounded size and depth, and takes typed values out of them by key."""

import dataclasses as dc
import difflib
import json
import math
import types
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import DEEPEST, LARGEST_DOCUMENT, LARGEST_NUMBER, MOST_NODES, read_text

_SHORT = 3000  # characters, which the reader in Python reads in a moment


def read_document(path: Path) -> Any:
    """Return the contents of a YAML file, or of a JSON file where its name ends so.

    Raises:
        InputError: no regular file, no UTF-8, not YAML or JSON, a key twice, or larger than the bounds in limits.
    """
    return parse_document(
        path.name, read_text(path, LARGEST_DOCUMENT), "JSON" if path.suffix.lower() == ".json" else "YAML"
    )


def parse_document(name: str, text: str, kind: str = "YAML") -> Any:
    """Return the contents of a text of YAML or JSON, ``name`` of which appears in messages.

    Raises InputError as read_document.
    """
    if not text.strip():
        raise InputError(f"'{name}' is empty.")
    try:
        if kind == "JSON":
            document = json.loads(text, object_pairs_hook=_once)
        else:
            _check_events(name, text)
            document = yaml.load(text, Loader=_Loader)
    except InputError:
        raise
    except _Twice as e:
        raise InputError(f"'{name}' gives the key '{e}' twice; keep one.") from None
    except MemoryError:
        raise InputError(f"'{name}' needs more memory than there is: give a smaller file.") from None
    except Exception as e:  # PyYAML and its constructors raise several types; a mark says the line
        raise InputError(f"'{name}' cannot be read as {kind}{_where(e, text)}.") from e
    _weight(name, document, 0, {})
    return document


def _where(error: Exception, text: str) -> str:
    """What a reader's error says of the place, in brackets; empty where it says nothing."""
    if isinstance(error, json.JSONDecodeError):
        return f" ({error.msg}, line {error.lineno})"
    if isinstance(error, yaml.MarkedYAMLError) and len(text) < _SHORT:
        try:  # the reader in Python names the line where a bracket opens, the one in C the file's end
            for _ in yaml.parse(text, Loader=yaml.SafeLoader):
                pass
        except yaml.MarkedYAMLError as plain:
            error = plain
        except (ValueError, RecursionError):
            pass
    if not isinstance(error, yaml.MarkedYAMLError):
        return ""
    parts = ((error.context, error.context_mark), (error.problem, error.problem_mark))
    said = [f"{text}{'' if mark is None else f' in line {mark.line + 1}'}" for text, mark in parts if text]
    return f" ({', '.join(said)})"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain values only; a mapping with a tag of its own keeps it as the key `_tag`, as Drake's reader does."""


def _tagged(loader: Any, tag: str, node: Any) -> dict[Any, Any]:
    return {**loader.construct_mapping(node, deep=True), "_tag": tag}


_Loader.add_multi_constructor("", _tagged)


class _Twice(Exception):
    """Name a key that is twice in a mapping."""


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise _Twice(next(k for k in found if sum(k == other for other, _ in pairs) > 1))
    return found


def _check_events(name: str, text: str) -> None:
    """Depth, number and repeated keys of a YAML text, before its readers, which recurse, see it."""
    levels: list[tuple[set[str], bool] | None] = []  # of each open mapping its keys, and whether the next node is a key
    count = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.NodeEvent):
            count += 1
            if levels and levels[-1] is not None:
                keys, is_key = levels[-1]
                if is_key and isinstance(event, yaml.ScalarEvent) and event.value != "<<":
                    if event.value in keys:
                        raise _Twice(event.value)
                    keys.add(event.value)
                levels[-1] = keys, not is_key
        if isinstance(event, yaml.CollectionStartEvent):
            levels.append((set(), True) if isinstance(event, yaml.MappingStartEvent) else None)
        elif isinstance(event, yaml.CollectionEndEvent):
            levels.pop()
        if count > MOST_NODES or len(levels) > DEEPEST:
            raise _too_much(name)


def _weight(name: str, value: Any, level: int, known: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """Values and levels of a document, aliases in full; each part is looked at once.

    An alias of an alias ... of YAML is a small text and an endless document.
    """
    if not isinstance(value, Mapping | list | tuple):
        return 1, 1
    if id(value) in known or level > DEEPEST:
        if (found := known.get(id(value))) is None:  # a list within itself, or too deep
            raise _too_much(name)
        return found
    known[id(value)] = None
    inside = [_weight(name, v, level + 1, known) for v in (value.values() if isinstance(value, Mapping) else value)]
    count, height = 1 + sum(n for n, _ in inside), 1 + max((h for _, h in inside), default=0)
    if count > MOST_NODES or height > DEEPEST + 1:
        raise _too_much(name)
    known[id(value)] = count, height
    return count, height


def _too_much(name: str) -> InputError:
    return InputError(
        f"'{name}' holds more than {MOST_NODES} values, its aliases counted in full, or {DEEPEST} levels."
    )


@dataclass(frozen=True)
class DocumentSection:
    """A mapping of a document.

    Its getters raise InputError naming ``file`` and key where a value is missing or wrong.
    """

    file: str
    values: Mapping[Any, Any]
    place: str = field(default="")

    @staticmethod
    def of(file: str, value: Any, place: str = "") -> "DocumentSection":
        """Return the mapping as a section. Raises InputError where it is none."""
        if not isinstance(value, Mapping):
            raise InputError(
                f"'{file}': {place or 'the file'} must be a mapping of keys to values, not {shown(value)}."
            )
        return DocumentSection(file, value, place)

    def has(self, key: str) -> bool:
        """Return whether the key is there with a value."""
        return self.values.get(key) is not None

    def section(self, key: str) -> "DocumentSection":
        """Return the mapping under a key; empty where there is none."""
        return DocumentSection.of(self.file, self.values[key] if self.has(key) else {}, self._at(key))

    def items(self, key: str) -> list[Any]:
        """Return the list under a key; empty where there is none."""
        value = self.values[key] if self.has(key) else []
        if not isinstance(value, list):
            raise self.wrong(key, "a list")
        return value

    def number(self, key: str, default: float | None = None, *, low: float = -LARGEST_NUMBER) -> float:
        """Return the finite number under a key, from ``low`` to LARGEST_NUMBER."""
        if not self.has(key) and default is not None:
            return default
        value = as_number(self.values.get(key))
        if not low <= value <= LARGEST_NUMBER:
            raise self.wrong(key, "a finite number" if low < 0.0 else f"a finite number, {low:g} or more")
        return value

    def optional(self, key: str) -> float | None:
        """Return the finite number under a key; None where there is none."""
        return self.number(key) if self.has(key) else None

    def whole(self, key: str, default: int = 0) -> int:
        """Return the whole number from 0 under a key."""
        value = self.number(key, default, low=0.0)
        if value != int(value):
            raise self.wrong(key, "a whole number")
        return int(value)

    def text(self, key: str, default: str = "") -> str:
        """Return the text under a key."""
        if not self.has(key):
            return default
        if not isinstance(self.values[key], str | int | float) or isinstance(self.values[key], bool):
            raise self.wrong(key, "a text")
        return str(self.values[key])

    def texts(self, key: str) -> tuple[str, ...]:
        """Return the texts of the list under a key."""
        found = self.items(key)
        if not all(isinstance(v, str) for v in found):
            raise self.wrong(key, "a list of texts")
        return tuple(found)

    def records(self, key: str, kind: type["Part"]) -> tuple["Part", ...]:
        """Return the records of the list under a key; none where there is none. Raises InputError as read_part."""
        return tuple(read_part(kind, v, self.file, f"{self._at(key)}[{k}]") for k, v in enumerate(self.items(key)))

    def numbers(self, key: str) -> dict[str, float | None]:
        """Return the numbers under the keys of the mapping under a key; null stays None."""
        inside = self.section(key)
        return {str(name): inside.optional(name) for name in inside.values}

    def array(self, key: str, *shape: int) -> Array:
        """Return the finite numbers (shape) of the nested lists under a key; -1 in the shape: any length."""
        try:
            value = np.array(self.values.get(key), dtype=float)
        except (TypeError, ValueError, OverflowError):
            value = np.zeros(())
        fits = value.ndim == len(shape) and all(s in (-1, n) for s, n in zip(shape, value.shape, strict=True))
        if not fits or not (np.abs(value) <= LARGEST_NUMBER).all():
            size = " by ".join("any number" if s < 0 else str(s) for s in shape)
            raise self.wrong(key, f"{size} finite numbers")
        return value

    def wrong(self, key: str, wanted: str) -> InputError:
        """Return the sentence for a value that is not what was wanted."""
        return InputError(f"'{self.file}': {self._at(key)} must be {wanted}, not {shown(self.values.get(key))}.")

    def _at(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else str(key)


def as_number(value: Any) -> float:
    """Return a number, or a text that is one (YAML 1.1 leaves 1e-05 as text).

    NaN for anything else, true and false included.
    """
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def shown(value: Any) -> str:
    """Return a value as a message shows it: short, on one line."""
    if value is None:
        return "nothing"
    text = (
        " ".join(str(value).split())
        if not isinstance(value, int)
        else f"{value:.6g}"
        if abs(value) < 1e300
        else "a huge number"
    )
    return f"'{text[:40]}...'" if len(text) > 40 else f"'{text}'"


Part = TypeVar("Part")

LIKENESS = 0.6
"""Smallest likeness (0 to 1) of a word that is suggested."""


def nearest(word: str, known: Iterable[str], likeness: float = LIKENESS) -> str | None:
    """Find the known word that is most like ``word``; None where none is like it."""
    return next(iter(difflib.get_close_matches(word, list(known), 1, likeness)), None)


def did_you_mean(word: str, known: Iterable[str], otherwise: str, likeness: float = LIKENESS) -> str:
    """The end of a sentence about an unknown word: the nearest known one, where there is one, and ``otherwise``."""
    near = nearest(word, known, likeness)
    return otherwise if near is None else f"did you mean '{near}'? {otherwise[:1].upper()}{otherwise[1:]}"


def read_part(kind: type[Part], document: Any, file: str, place: str = "") -> Part:
    """Return a part of a file as its dataclass; ``place`` names the part in messages, such as `tip`.

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
    for field_ in dc.fields(kind):  # type: ignore[arg-type]
        if field_.name not in document and field_.default is field_.default_factory is dc.MISSING:
            raise InputError(f"'{file}': {_dotted(place, field_.name)} is missing.")
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
    if get_origin(kind) is list or (get_origin(kind) is tuple and get_args(kind)[-1] is Ellipsis):
        if not isinstance(value, list):
            raise InputError(f"'{file}': {key} must be a list, not {shown(value)}.")
        return get_origin(kind)(_value(get_args(kind)[0], v, file, f"{key}[{i}]") for i, v in enumerate(value))
    if get_origin(kind) is tuple:
        numbers = [as_number(v) for v in value] if isinstance(value, list) else []
        if len(numbers) != len(get_args(kind)) or not all(math.isfinite(v) for v in numbers):
            raise InputError(f"'{file}': {key} must be {len(get_args(kind))} numbers, not {shown(value)}.")
        return tuple(numbers)
    if kind is str:
        if not isinstance(value, str):
            raise InputError(f"'{file}': {key} must be a text, not {shown(value)}.")
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise InputError(f"'{file}': {key} must be true or false, not {shown(value)}.")
        return value
    number = as_number(value)
    if not math.isfinite(number) or (kind is int and number != int(number)):
        raise InputError(f"'{file}': {key} must be a {'whole ' if kind is int else ''}number, not {shown(value)}.")
    return kind(number)
