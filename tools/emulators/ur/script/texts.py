"""URScript functions of strings and lists; positions count from 0."""

import re
from typing import Any

from weldcal.tools.emulators.ur.script.arithmetic import MOST_PARTS, Effort, Pose, Struct, bounded, copied, whole
from weldcal.tools.emulators.ur.script.syntax import ScriptError

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def text_of(value: Any) -> str:
    """What to_str, str_cat and textmsg make of a value: six significant digits, True, [1, 2], p[...]."""
    if isinstance(value, str):
        return value
    if isinstance(value, list | Struct):
        Effort.spend(10 * len(value))
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(text_of(part) for part in value) + "]"
    if isinstance(value, Struct):
        return "struct(" + ", ".join(f"{name}={text_of(part)}" for name, part in value.items()) + ")"
    return str(value)


def str_cat(op1: Any, op2: Any) -> str:
    """Both operands as text, one after the other."""
    return str(bounded(text_of(op1) + text_of(op2)))


def str_len(str: str) -> int:
    """Number of characters."""
    return len(_text(str))


def str_empty(str: str) -> bool:
    """Whether there is no character."""
    return not _text(str)


def str_at(src: str, index: int) -> str:
    """The character at `index`."""
    _position(src, index)
    return src[index]


def str_sub(src: str, index: int, len: int | None = None) -> str:
    """The part from `index` on, at most `len` characters; to the end where that is left out or negative."""
    _position(src, index)
    return src[index:] if len is None or len < 0 else src[index : index + len]


def str_find(src: str, target: str, start_from: int = 0) -> int:
    """Where `target` starts, or -1."""
    return _text(src).find(_text(target), start_from)


def to_num(str: str) -> int | float:
    """The number that a text starts with."""
    match = _NUMBER.match(_text(str))
    if match is None:
        raise ScriptError(f"to_num: {str!r} does not start with a number.")
    found = match.group().strip()
    return int(whole(int(found))) if re.fullmatch(r"[-+]?\d+", found) else float(found)


def length(v: Any) -> int:
    """Number of elements of a list, or characters of a text."""
    if not isinstance(v, list | str):
        raise ScriptError(f"length needs a list or a text, it got {v!r}.")
    return len(v)


def size(v: Any) -> Any:
    """Number of elements of a list; rows and columns of a matrix."""
    if isinstance(v, list) and v and isinstance(v[0], list):
        return [len(v), len(v[0])]
    return length(v)


def transpose(m: Any) -> Any:
    """Rows become columns."""
    if not isinstance(m, list) or not all(isinstance(row, list) for row in m):
        raise ScriptError("transpose needs a matrix.")
    return [list(column) for column in zip(*m, strict=True)]


def make_list(length: int, initial_value: Any = 0, capacity: int = 0) -> list[Any]:
    """A list of `length` equal elements."""
    if length > MOST_PARTS:
        raise ScriptError(f"A list has no more than {MOST_PARTS} elements.")
    parts = [initial_value] * int(length)
    bounded(parts)
    return list(copied(parts))


def binary_list_to_integer(l: Any) -> int:  # noqa: E741  (URScript's own name)
    """The number whose bits are in a list, the lowest first."""
    value = sum(1 << i for i, bit in enumerate(l[:32]) if bit)
    return value - (1 << 32) if len(l) == 32 and l[31] else value


def struct(**members: Any) -> Struct:
    """A struct with these members."""
    made: Struct = bounded(copied(Struct(members)))
    return made


TEXTS = {
    **{f.__name__: f for f in (str_cat, str_len, str_empty, str_at, str_sub, str_find, to_num)},
    **{f.__name__: f for f in (length, size, transpose, make_list, binary_list_to_integer, struct)},
    "to_str": text_of,
    "get_list_length": length,
}
"""By their URScript name."""


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ScriptError(f"A text is needed, this is {value!r}.")
    return value


def _position(text: Any, index: Any) -> None:
    if not 0 <= index < max(1, len(_text(text))):
        raise ScriptError(f"There is no character {index} in a text of {len(text)}.")
