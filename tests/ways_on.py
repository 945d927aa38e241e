"""Every printed way on is walked: `python -m tests.ways_on` makes results of all kinds, executes each command and line
that their screens, messages and pages offer as it is printed, and prints how many lead on."""

from __future__ import annotations

import argparse
import html
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import typer.main

from tests.documents.command_lines import CommandLine
from tests.documents.props import lay_out, needs_data
from tests.documents.scans import write_scans
from tests.documents.test_examples import ONCE
from tests.places import ROOT, SHARED_DATA
from weldcal.tools.cli.app import app

# Results that the pages do not make: limits that are met or missed, too little data, mistakes, runs that are held.
OTHERS = (
    "calibrate my_scans --limit-mm 0.5 --out good",
    "calibrate my_scans --limit-mm 0.01 --out missed",
    "calibrate my_scans --no-scanner-correction --out plain",
    "calibrate scaled_scans --out corrected",
    "calibrate my_scans --poses pose01:pose05 --out five",
    "calibrate no_such_scans",
    "verify my-calibration my_scans --out again",
    "verify my-calibration other_scans --limit-mm 0.001 --out refuted",
    "verify my-calibration other_scans --limit-mm 0.5 --out confirmed",
    "verify my-calibration three_scans --out few",
    "verify my-profiler other_scans",
    "hand-eye ax-yb pairs.npz --limit-mm 0.01 --out hand_missed",
    "hand-eye ax-yb pairs.npz --limit-mm 1 --out hand_good",
    "hand-eye ax-xb fixed_camera.npz --mounting eye_in_hand",
    "hand-eye ax-yb two_robots.npz",
    "hand-eye axb-ycz pairs.npz",
    "profiler sphere sphere.npz --limit-mm 0.01 --out profiler_missed",
    "profiler seam groove.npz --calibration my-profiler --limit-mm 0.01 --out seam_missed",
    "tablet calibrate touches.csv --poses poses.csv --camera camera.yaml --seen seen.csv --limit-mm 0.01 --out tablet_missed",
    "doctor my-calibration",
    "new my_clamp --part clamp.stl",
    "new my_cell --part bracket.step --edges 99",
    "new example --dataset",
    "demo --scenario my_cell.yaml --no-browser --out held",
    "demo --scenario short.yaml --no-browser --out short",
    "weld --scenario my_scenario.yaml --no-browser --out welded",
    "view no_such_folder",
    "replay my-calibration",
    "fleet cells",
    "import my_scans --out imported",
    "monitor my_scans --calibration my-calibration",
    "plan-passes s_groove",
    "robots nobody",
    "check-robot 127.0.0.9",
)
# What a user has who is told to name it: the end of the sentence, and the file.
SUPPLIED = (
    ("and name their folder", "other_scans"),
    ("and name the file of its scans", "groove.npz"),
    ("and name their file", "sphere.npz"),
    ("with your scenario", "s_groove"),
    ("and the name of a scan", "my_scans/clouds/pose03.npz"),
    ("with its file", "bracket.step"),
)
SHOWN_S = 60.0  # a job that is a way on is interrupted after so long; it leads on once a phase has begun
DEEPEST = 2  # ways on of ways on
QUOTED = re.compile(r"['`](weldcal [a-z](?:[^'`]|'[^' ]+')*?)['`](?=[\s.,;:)]|$)")
BARE = re.compile(r"(?:^|\s{2,}|: )(weldcal [a-z][^\n]*)$", re.MULTILINE)
NAMED_FILE = re.compile(r"\b(?:[Ss]ee|in|to|report|written to) +([\w./-]+\.(?:html|csv|md|yaml|json))\b")
LOOSE = re.compile(r"\bweldcal [a-z][a-z-]+(?: [a-z][a-z-]+)?")  # in a sentence, without quotes
COMMANDS = {name.split()[0] for name in typer.main.get_command(app).commands}  # type: ignore[attr-defined]
PLACEHOLDER = re.compile(r"(?<![\w./-])[A-Z][A-Z_]{3,}(?![\w./-])")
MADE = {"scaled_scans": lambda path: write_scans(path, 12, 0, scale=1.003)}  # beside those of the pages
NO_FILES_OF_RESULTS = ("dataset.yaml", "poses.csv", "scenario.yaml", "cell.yaml")  # of the user, by their names


@dataclass(frozen=True)
class Ran:
    """A command that has been executed: its exit code and what it printed."""

    line: str
    code: int
    out: str
    err: str
    begun: bool = False

    @property
    def printed(self) -> str:
        """What a terminal shows."""
        return f"{self.out}\n{self.err}"


Shell = Callable[[str, Path], Ran]


def environment() -> dict[str, str]:
    """What a reader has: `weldcal` on PATH, and no web browser."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "BROWSER": "true", "OMP_NUM_THREADS": "1", "COLUMNS": "80"}


def in_shell(line: str, folder: Path) -> Ran:
    """Execute a line in a shell; a job is interrupted after SHOWN_S, as an operator does it."""
    process = subprocess.Popen(
        ["sh", "-c", f"exec {line}"], cwd=folder, env=environment(), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    job = CommandLine(line).begins("demo", "weld", "monitor follow")
    begun = False
    try:
        out, err = process.communicate(timeout=SHOWN_S if job else 1200.0)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300.0)
        begun = "%]" in err
    return Ran(line, process.returncode, out, err, begun)


@dataclass
class Way:
    """A way on that was offered: by what, as printed, and why it does not lead on (empty: it does)."""

    of: str
    printed: str
    wrong: str = ""


def offered(text: str) -> tuple[list[str], list[str]]:
    """The commands that a text offers to run as they are, and those that it names for a reader to complete."""
    whole = [found.strip() for found in BARE.findall(text)]
    flat = " ".join(text.split())
    named = []
    for found in QUOTED.finditer(flat):
        rest = flat[found.end() : found.end() + 60]
        end = next((prop for words, prop in SUPPLIED if rest.lstrip(" ").startswith(words)), None)
        (named if end is None else whole).append(found[1] + (f" {end}" if end else ""))
    loose = [found for found in LOOSE.findall(flat) if not any(text.startswith(found) for text in (*whole, *named))]
    named += [text for text in loose if text.split()[1] in COMMANDS]
    return list(dict.fromkeys(whole)), list(dict.fromkeys(named))


def copied(page: Path) -> Iterator[str]:
    """The texts that the buttons of a page copy, and the commands that it shows as code."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r'data-copies="([^"]+)"', text):
        found = re.search(rf'<(\w+)[^>]*\bid="{re.escape(name)}"[^>]*>(.*?)</\1>', text, re.DOTALL)
        yield html.unescape(re.sub(r"<[^>]+>", "", found[2])) if found else f"no text for the button {name}"
    yield from (html.unescape(found) for found in re.findall(r"<code[^>]*>(weldcal [^<]+)</code>", text))


@dataclass
class Walk:
    """A reader in a folder, who follows what they are told."""

    folder: Path
    shell: Shell = in_shell
    known: dict[str, Ran] = field(default_factory=dict)
    ways: list[Way] = field(default_factory=list)

    def result(self, words: str) -> list[Way]:
        """Make a result and walk the ways on from it."""
        line = f"weldcal {words}"
        made = CommandLine(line).makes
        lay_out(words, self.folder, made)
        for name, make in MADE.items():
            if name in words and not (self.folder / name).exists():
                make(self.folder / name)
        before, count = set(self.folder.rglob("*.html")), len(self.ways)
        ran = self._run(line)
        self._judge(line, ran, ())
        self._follow(ran, (line,), sorted(set(self.folder.rglob("*.html")) - before))
        return self.ways[count:]

    def _run(self, line: str) -> Ran:
        if line not in self.known:
            self.known[line] = self.shell(line, self.folder)
        return self.known[line]

    def _follow(self, ran: Ran, path: tuple[str, ...], pages: list[Path]) -> None:
        whole, named = offered(ran.printed)
        for page in pages:
            of_page = [text.strip() for text in copied(page)]
            whole += [text for text in of_page if text.startswith("weldcal ") and text not in whole]
            self.ways += [
                Way(path[-1], text, "a button without a text") for text in of_page if text.startswith("no text")
            ]
        placed = [text for text in whole if PLACEHOLDER.search(text)]
        self.ways += [Way(path[-1], text, "a placeholder stands in it") for text in placed]
        whole = [text for text in whole if text not in placed]
        self.ways += [Way(path[-1], text, self._unusable(text)) for text in named]
        self.ways += [Way(path[-1], text, "no such file") for text in self._absent(ran)]
        for line in whole:
            if line in path:
                self.ways.append(Way(path[-1], line, "it leads back"))
                continue
            for words, prop in SUPPLIED:
                if line.endswith(f" {prop}") and words:
                    lay_out(prop, self.folder)
            before = set(self.folder.rglob("*.html"))
            after = self._run(line)
            self._judge(path[-1], after, path)
            if after.code == 1 and after.err and after.err == ran.err:
                self.ways.append(Way(path[-1], line, "it says the same again"))
            if after.code == 2:
                continue
            if len(path) <= DEEPEST and not after.begun:
                self._follow(after, (*path, line), sorted(set(self.folder.rglob("*.html")) - before))

    def _judge(self, of: str, ran: Ran, path: tuple[str, ...]) -> None:
        said = " ".join(ran.err.split())
        wrong = ""
        if (
            ran.code == 2
            or "Traceback" in ran.printed
            or "Internal error" in ran.printed
            or (ran.code not in (0, 1) and not ran.begun)
        ):
            wrong = f"exit code {ran.code}: {said[-300:]}"
        elif ran.code == 1 and "weldcal:" not in said and "weldcal:" not in ran.out:
            wrong = f"no sentence: {said[-300:]}"
        elif path and re.search(r"There is no file|No such file|There is no '", said):
            wrong = f"it names what does not exist: {said[-300:]}"
        if path or wrong:
            self.ways.append(Way(of, ran.line, wrong))

    def _absent(self, ran: Ran) -> list[str]:
        """The files that a message sends a reader to and that are not there."""
        texts = set(NAMED_FILE.findall(ran.printed)) - set(NO_FILES_OF_RESULTS)
        places = [self.folder, ROOT, *self.folder.glob("weldcal-out/*")]
        out = re.search(r"(\S+)/report\.html", ran.printed)
        places += [self.folder / out[1]] if out else []
        places += [
            self.folder / Path(word).parent for word in ran.printed.split() if "/" in word
        ]  # named with its folder
        return sorted(text for text in texts if ran.code == 0 and not any((p / text).exists() for p in places))

    def _unusable(self, text: str) -> str:
        """Why a command that a sentence names is none; empty where its name and options are known."""
        words = []
        for word in shlex.split(text)[1:]:
            if word.startswith("-") or not re.fullmatch(r"[a-z][a-z-]*", word):
                break
            words.append(word)
        options = re.findall(r"(?<= )--[a-z][\w-]*", text)
        for n in range(len(words), 0, -1):
            shown = self._run(f"weldcal {' '.join(words[:n])} --help")
            if shown.code == 0:
                missing = [o for o in options if o not in shown.out]
                return f"unknown options {missing}" if missing else ""
        return "no such command"


def results(only: str = "") -> list[str]:
    """The command lines whose results are walked: those of the pages that take seconds, and OTHERS."""
    lines = [*(line.name for line in ONCE.values()), *OTHERS]
    return [line for line in lines if re.search(only, line) and (SHARED_DATA.exists() or not needs_data(line))]


def main() -> int:
    """Walk all, print what does not lead on and the count; the exit code is 1 if something does not."""
    parser = argparse.ArgumentParser(prog="python -m tests.ways_on", description=__doc__)
    parser.add_argument("--only", default="", metavar="REGEX", help="Only the results whose command it matches.")
    asked = parser.parse_args()
    ok = total = leading = 0
    with tempfile.TemporaryDirectory(prefix="weldcal-ways-") as scratch:
        walk = Walk(Path(scratch))
        for words in results(asked.only):
            began = time.monotonic()
            ways = walk.result(words)
            wrong = [way for way in ways if way.wrong]
            ok, total, leading = ok + (not wrong), total + 1, leading + bool(ways)
            mark = "leads on" if not wrong else "DOES NOT"
            sys.stdout.write(f"{mark}  {time.monotonic() - began:6.1f} s  {len(ways)} ways  {words}\n")
            sys.stdout.writelines(f"    {way.printed}\n        {way.wrong}\n" for way in wrong)
            sys.stdout.flush()
    steps = len({way.printed for way in walk.ways})
    sys.stdout.write(f"\n{ok} of {total} lead on: {leading} of them offer {steps} different ways\n")
    return 0 if ok == total else 1


if __name__ == "__main__":
    sys.exit(main())
