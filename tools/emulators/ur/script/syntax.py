"""Syntax tree of a URScript program."""

from __future__ import annotations

from dataclasses import dataclass, field

from weldcal.models.errors import WeldcalError

LONGEST = 1000  # characters of a message


class ScriptError(WeldcalError):
    """A URScript program that the controller refuses to start, or that stops while it runs.

    `line` and `column` count from 1; 0 where they are not known.
    """

    def __init__(self, message: str, line: int = 0, column: int = 0) -> None:
        super().__init__(message if len(message) < LONGEST else f"{message[:LONGEST]} ...")
        self.line, self.column = line, column


@dataclass(frozen=True)
class Literal:
    """A number, a text or a truth value."""

    value: float | int | str | bool


@dataclass(frozen=True)
class Name:
    """A variable that is read."""

    name: str


@dataclass(frozen=True)
class Items:
    """[a, b, ...], or p[x, y, z, rx, ry, rz] where `pose` is set."""

    items: tuple[Expression, ...]
    pose: bool


@dataclass(frozen=True)
class CallExpression:
    """name(a, b, key=c); `run` is set where the call starts a thread."""

    name: str
    arguments: tuple[Expression, ...]
    keywords: tuple[tuple[str, Expression], ...]
    run: bool = False
    line: int = 0
    column: int = 0


@dataclass(frozen=True)
class Method:
    """target.name(a, b)."""

    target: Expression
    name: str
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Index:
    """target[index], or target.member with the member's name as index."""

    target: Expression
    index: Expression


@dataclass(frozen=True)
class Operation:
    """An operator and its one or two operands."""

    operator: str
    operands: tuple[Expression, ...]


Expression = Literal | Name | Items | CallExpression | Method | Index | Operation


@dataclass(frozen=True)
class Assign:
    """name = value, name[i][j] = value; scope is "global", "local" or ""."""

    line: int
    name: str
    indices: tuple[Expression, ...]
    value: Expression
    scope: str


@dataclass(frozen=True)
class Evaluate:
    """An expression for its effect."""

    line: int
    value: Expression


@dataclass(frozen=True)
class Conditional:
    """if / elif branches in order, and what follows `else`."""

    line: int
    branches: tuple[tuple[Expression, tuple[Statement, ...]], ...]
    otherwise: tuple[Statement, ...]


@dataclass(frozen=True)
class Loop:
    """while."""

    line: int
    condition: Expression
    body: tuple[Statement, ...]


@dataclass(frozen=True)
class ControlStatement:
    """return, break, continue, halt, pass, kill, join, enter_critical or exit_critical, with what it applies to."""

    line: int
    word: str
    value: Expression | None = None


Statement = Assign | Evaluate | Conditional | Loop | ControlStatement


@dataclass(frozen=True)
class Routine:
    """A def, thread or sec: parameters with their defaults, its statements, and the routines defined inside it."""

    line: int
    kind: str
    name: str
    parameters: tuple[tuple[str, Expression | None], ...]
    body: tuple[Statement, ...]
    inner: tuple[Routine, ...] = field(default=())
