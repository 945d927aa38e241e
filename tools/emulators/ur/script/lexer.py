"""Splits URScript text into tokens, and a stream into programs."""

import re
from dataclasses import dataclass

from weldcal.tools.emulators.ur.script.syntax import ScriptError

OPENING = frozenset({"def", "thread", "sec", "if", "while"})
KEYWORDS = OPENING | {
    *("elif", "else", "end", "global", "local", "return", "break", "continue", "halt", "pass", "run", "kill", "join"),
    *("and", "or", "not", "xor", "True", "False", "enter_critical", "exit_critical"),
}
_TOKEN = re.compile(
    r"""(?P<space>[ \t\r;]+|\#[^\n]*|\$[^\n]*)
      | (?P<newline>\n)
      | (?P<number>(\d+\.\d*|\.\d+|\d+)([eE][+-]?\d+)?)
      | (?P<text>"[^"\n]*")
      | (?P<word>[A-Za-z_][A-Za-z_0-9]*)
      | (?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:.])""",
    re.VERBOSE,
)


@dataclass(frozen=True)
class Token:
    """kind is newline, number, text, word, keyword, sign or end; line and column count from 1."""

    kind: str
    text: str
    line: int
    column: int = 0


def tokenize(source: str) -> list[Token]:
    """All tokens, comments and labels ($ lines) left out, one token of kind `end` at the end.

    Raises:
        ScriptError: a character that no URScript word starts with.
    """
    tokens: list[Token] = []
    position, line, line_start = 0, 1, 0
    while position < len(source):
        column = position - line_start + 1
        match = _TOKEN.match(source, position)
        if match is None:
            raise ScriptError(
                f"The script has an unexpected character {source[position]!r} in line {line}.", line, column
            )
        kind, text = str(match.lastgroup), match.group()
        position = match.end()
        if kind == "newline":
            tokens.append(Token(kind, text, line, column))
            line, line_start = line + 1, position
        elif kind != "space":
            tokens.append(Token("keyword" if text in KEYWORDS else kind, text, line, column))
    tokens.append(Token("end", "", line))
    return tokens


def split_programs(buffer: str) -> tuple[list[str], str]:
    """The complete programs at the start of what has arrived, and the rest that waits for more.

    A program is a def or sec with its matching `end`, in whatever column, or a single line.
    """
    programs: list[str] = []
    while True:
        buffer = buffer.lstrip()
        if "\n" not in buffer:
            return programs, buffer
        length = _program_length(buffer)
        if length is None:
            return programs, buffer
        programs.append(buffer[:length])
        buffer = buffer[length:]


def _program_length(buffer: str) -> int | None:
    first_line = buffer.split("\n", 1)[0]
    if first_line.split(" ", 1)[0] not in ("def", "sec"):
        return len(first_line) + 1
    depth, position = 0, 0
    while position < len(buffer):
        match = _TOKEN.match(buffer, position)
        if match is None:
            position += 1
            continue
        position = match.end()
        if match.lastgroup == "word":
            if match.group() in OPENING:
                depth += 1
            elif match.group() == "end":
                depth -= 1
                if depth == 0:
                    # an `end` that is the last thing to have arrived may be the start of a longer word
                    return position if position < len(buffer) else None
    return None
