"""How a command line of a page is executed: at once, with the long ones, in a short form, as a server, or elsewhere."""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import typer.main

from tests.figures.__main__ import app as figures
from tests.places import ROOT
from weldcal.tools.cli.app import app

ROBOT, EMULATED = "192.168.56.101", "127.30.0.9"  # the robot of the pages, and the emulated one in its place

# Commands that take less than some seconds and start no simulation, by their first words.
CHEAP = (
    *(
        "robots",
        "schema",
        "part",
        "tool check",
        "tool measure",
        "print-board",
        "verify",
        "compare",
        "apply",
        "export",
        "profiler edge",
        "profiler sphere",
    ),
    *(
        "tablet calibrate",
        "profiler seam",
        "profiler bead",
        "profiler compensate",
        "hand-eye ax-xb",
        "hand-eye ax-yb",
        "hand-eye axb-ycz",
    ),
)
# They run until they are interrupted.
SERVERS = ("emulate-cell", "emulate-ur", "tablet serve")
# Executed by another command than a check of these pages.
ELSEWHERE = {"test": "the test suite itself", "docs": "the build of these pages itself"}
# What is long is shortened: a pattern of the line, and its short form. The long form runs with `--full`.
SHORT = (
    (r"^demo( s_groove| straight_groove)?$", r"demo --scenario short.yaml"),
    (r"^demo --scenario (straight_groove|s_groove)", r"demo --scenario short.yaml"),
    (r"^demo --scenario my_cell/cell\.yaml", r"demo --scenario short_cell.yaml"),
    (r"^demo (--robot|--record|--seed|--share)", r"demo --scenario short.yaml \1"),
    (r"^demo --scenario wired_s_groove", "demo --scenario short_wired.yaml"),
    (r"^(figures .*?) --full", r"\1"),
)


@dataclass(frozen=True)
class CommandLine:
    """A line of a page that runs weldcal."""

    text: str

    @property
    def words(self) -> list[str]:
        """Its words after `weldcal` or `./tools/run`."""
        return shlex.split(self.text, comments=True)[1:]

    @property
    def name(self) -> str:
        """The line without the program's name: the same for `weldcal` and `./tools/run`."""
        return shlex.join(self.words)

    def begins(self, *names: str) -> bool:
        """Whether the command is one of these."""
        return any(self.words[: len(name.split())] == name.split() for name in names)

    @property
    def elsewhere(self) -> str:
        """By what else it is executed; empty: by a check of the pages."""
        if self.begins("tool measure") and "--scenario" in self.words:
            return "the test of the tool scan, whose calibration is that of its cell"
        return "the tests of a Dask cluster" if "--scheduler" in self.words else ELSEWHERE.get(self.words[0], "")

    @property
    def server(self) -> bool:
        """Whether it runs until it is interrupted."""
        return self.begins(*SERVERS)

    @property
    def cheap(self) -> bool:
        """Whether the tests execute it as it is written."""
        if self.begins("new"):
            return "--dataset" not in self.words
        if self.begins("calibrate"):
            return not {"--scenario", "--refine"} & set(self.words)
        if self.begins("verify"):
            return "--scenario" not in self.words
        if self.begins("doctor"):
            return not self.name.endswith(".mcap")
        return self.begins(*CHEAP) and not self.elsewhere

    @property
    def makes(self) -> tuple[str, ...]:
        """The files and folders that the line makes, as it names them."""
        if self.begins("new"):
            return (self.words[1],)
        return tuple(self.words[k + 1] for k, word in enumerate(self.words[:-1]) if word == "--out")

    def short(self) -> str:
        """Its short form, or the line itself."""
        for pattern, replacement in SHORT:
            if re.search(pattern, self.name):
                return re.sub(pattern, replacement, self.name, count=1)
        return self.name

    def arguments(self, *, full: bool) -> list[str]:
        """The words to run, in the short form or in full, with the emulated robot in place of the real one."""
        words = self.words if full else shlex.split(self.short())
        return [word.replace(ROBOT, EMULATED) for word in words]


@cache
def program() -> Any:
    """The whole command line, and below `figures` that of the studies; made once, since it takes a fifth of a second."""
    found: Any = typer.main.get_command(app)
    found.commands["figures"] = typer.main.get_command(figures)
    return found


def process(arguments: list[str]) -> list[str]:
    """The command of a process of its own."""
    if arguments[:1] == ["figures"]:
        return ["env", f"PYTHONPATH={ROOT}", sys.executable, "-P", "-m", "tests.figures", *arguments[1:]]
    return [sys.executable, "-P", "-m", "weldcal.tools", *arguments]
