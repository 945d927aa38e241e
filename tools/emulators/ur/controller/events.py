"""What the controller tells the clients of its primary port, in the order in which it happened."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Started:
    """A program began; `text` is its name."""

    text: str


@dataclass(frozen=True)
class Stopped:
    """A program ended; `text` is its name."""

    text: str


@dataclass(frozen=True)
class Text:
    """textmsg."""

    text: str


@dataclass(frozen=True)
class Popup:
    """A window on the pendant."""

    text: str
    title: str
    warning: bool
    error: bool
    blocking: bool


@dataclass(frozen=True)
class ScriptStopped:
    """A script that does not compile, or that stops at a mistake; line and column count from 1."""

    text: str
    line: int
    column: int


@dataclass(frozen=True)
class ErrorCode:
    """A numbered report such as C209A0; `level` is 1 information, 2 warning, 3 violation, 4 fault."""

    code: int
    argument: int
    level: int
    text: str


@dataclass(frozen=True)
class SafetyChanged:
    """The safety mode has changed to the one with this number."""

    mode: int


Event = Started | Stopped | Text | Popup | ScriptStopped | ErrorCode | SafetyChanged
