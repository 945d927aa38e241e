"""A terminal of 80 columns: commands run in one process on a pseudo-terminal, and what remains on the screen."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from dataclasses import dataclass
from pathlib import Path

COLUMNS = 80
MARK = "\x1e"
CONTROL = re.compile(r"\x1b\[([?\d;]*)([A-Za-z])")
HOST = f"""
import json, sys
from weldcal.tools.cli.app import app
for words in json.loads(sys.argv[1]):
    try:
        app(words)
    except SystemExit as ended:
        code = ended.code
    sys.stdout.flush(); sys.stderr.flush()
    print("{MARK}" + str(code), flush=True)
"""


@dataclass(frozen=True)
class Shown:
    """What a command left on the terminal, line by line, its exit code, and all that went to the terminal."""

    lines: list[str]
    code: int
    raw: str

    @property
    def text(self) -> str:
        """The lines as one text without breaks."""
        return " ".join(" ".join(self.lines).split())


def remaining(raw: str) -> list[str]:
    """The lines that remain on a screen, after what was erased and written over; a long line is one line."""
    lines, row, column = [""], 0, 0
    at = 0
    while at < len(raw):
        found = CONTROL.match(raw, at)
        if found:
            number = int(found[1]) if found[1].isdecimal() else 1
            if found[2] == "A":
                row = max(row - number, 0)
            elif found[2] == "K":
                lines[row] = "" if found[1] == "2" else lines[row][:column]
            at = found.end()
            continue
        character = raw[at]
        at += 1
        if character == "\n":
            row, column = row + 1, 0
            lines += [""] * (row + 1 - len(lines))
        elif character == "\r":
            column = 0
        else:
            lines[row] = lines[row][:column].ljust(column) + character + lines[row][column + 1 :]
            column += 1
    return [line.rstrip() for line in lines]


def run_in_terminal(commands: list[list[str]], folder: Path) -> list[Shown]:
    """Run commands of weldcal one after the other, each on the same terminal."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR")}
    host = subprocess.Popen(
        [sys.executable, "-P", "-c", HOST, json.dumps(commands)], cwd=folder, stdin=theirs, stdout=theirs,
        stderr=theirs, env={**environment, "TERM": "xterm", "BROWSER": "true", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    os.close(theirs)
    pieces = []
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:  # the host has ended
            break
        if not piece:
            break
        pieces.append(piece)
    os.close(ours)
    host.wait(60)
    raw = b"".join(pieces).decode(errors="replace")
    parts = re.split(rf"{MARK}(\w+)\r?\n", raw)
    assert len(parts) == 2 * len(commands) + 1, raw[-2000:]
    shown = []
    for text, code in zip(parts[:-1:2], parts[1::2], strict=True):
        lines = remaining(text)
        while lines and not lines[-1]:
            lines.pop()
        shown.append(Shown(lines, int(code), text))
    return shown
