"""Reads the keys of a configuration dataclass, with the comment that stands beside or above each in the source."""

import ast
import dataclasses as dc
import inspect
import io
import textwrap
import tokenize
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, get_args, get_origin


@dataclass(frozen=True)
class Key:
    """One key: its name, its type, its default value, and what it means."""

    name: str
    kind: Any
    default: Any
    meaning: str

    @property
    def parts(self) -> tuple[type, ...]:
        """The dataclasses that its value may be; empty where it is a plain value."""
        kinds = get_args(self.kind) if isinstance(self.kind, UnionType) else (self.kind,)
        inner = (get_args(k)[0] if get_origin(k) is list else k for k in kinds)
        return tuple(k for k in inner if isinstance(k, type) and dc.is_dataclass(k))

    @property
    def listed(self) -> bool:
        """Whether the value is a list."""
        return get_origin(self.kind) is list

    @property
    def optional(self) -> bool:
        """Whether null is a value."""
        return isinstance(self.kind, UnionType) and NoneType in get_args(self.kind)


def keys_of(config: type) -> tuple[Key, ...]:
    """The keys of a dataclass, those of its base classes included, in their order."""
    comments: dict[str, str] = {}
    for base in reversed(config.__mro__):
        if dc.is_dataclass(base) and "__dataclass_fields__" in vars(base):
            comments |= _comments(base)
    default = config() if not inspect.isabstract(config) else None
    return tuple(
        Key(field.name, field.type, getattr(default, field.name), comments.get(field.name, ""))
        for field in dc.fields(config)
    )


def _comments(config: type) -> dict[str, str]:
    """Comments of the fields that a class itself defines; empty for a class made at run time, which has no source."""
    try:
        source = textwrap.dedent(inspect.getsource(config))
    except (OSError, TypeError):
        return {}
    comments = {
        token.start[0]: (token.start[1], token.string.lstrip("# ").rstrip())
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    lines = source.splitlines()
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        beside = [comments[n][1] for n in range(node.lineno, (node.end_lineno or node.lineno) + 1) if n in comments]
        above: list[str] = []
        n = node.lineno - 1
        while not beside and n in comments and lines[n - 1].lstrip().startswith("#"):
            above.insert(0, comments[n][1])
            n -= 1
        found[node.target.id] = " ".join(beside or above)
    return found
