"""Executes the blocks of a page in order, in a scratch folder, as a reader would type them."""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from tests.documents.blocks import Block, blocks_of, is_command
from tests.documents.command_lines import EMULATED, ROBOT, CommandLine, process
from tests.documents.props import lay_out, needs_data
from tests.documents.yaml_blocks import check_yaml
from tests.places import ROOT, SHARED_DATA

WRITTEN, SHORT, ELSEWHERE, LEFT_OUT, FAILED = "as written", "in a short form", "elsewhere", "left out", "failed"
SCRIPT_PORT = 30002
ANSWERS_WITHIN_S = 180.0  # of a server or an emulated robot, also on a busy computer
LARGEST_TIME_S = 3600.0


@dataclass(frozen=True)
class Executed:
    """One command line, or one block of another kind: where it is, how it was executed, and what it said if it
    failed."""

    page: str
    line: int
    text: str
    how: str
    seconds: float = 0.0
    said: str = ""


@dataclass(frozen=True)
class Check:
    """How pages are checked: nothing shortened or what is long, without the lines that `omits` names, and without
    executing twice what an earlier page has executed (`done`: how, by its words) and leaves nothing for its own
    page."""

    full: bool = False
    omits: Callable[[str], bool] = lambda _: False
    done: dict[tuple[str, ...], str] = field(default_factory=dict)


class Page:
    """A reader of one page: a folder of their own, what runs beside, and the names that earlier Python blocks have
    defined."""

    def __init__(self, folder: Path, entry_points: str, check: Check | None = None) -> None:
        self.folder, self.entry_points, self.check = folder, entry_points, check or Check()
        self.names: dict[str, object] = {}
        self.beside = ExitStack()
        self.environment = {**os.environ, "BROWSER": "true", "OMP_NUM_THREADS": "1"}
        if SHARED_DATA.exists() and not (folder.parent / "shared").exists():
            (folder.parent / "shared").symlink_to(SHARED_DATA.parent)

    def execute(self, block: Block) -> Iterator[Executed]:
        """Execute a block; a listing that nothing reads is left out."""
        if block.kind == "shell":
            made = tuple(name for line in filter(is_command, block.commands()) for name in CommandLine(line).makes)
            for line in block.commands():
                yield self._timed(block, line, lambda line=line: self._command(CommandLine(line), made))
        elif block.kind in ("yaml", "toml"):
            yield self._timed(block, block.text.split("\n")[0], lambda: self._yaml(block))
        elif block.kind == "python":
            yield self._timed(block, block.text.split("\n")[0], lambda: self._python(block))

    def _timed(self, block: Block, text: str, work: Callable[[], str]) -> Executed:
        start = time.monotonic()
        try:
            how, said = work(), ""
        except Exception as error:  # whatever a block does, the others are executed
            how, said = FAILED, f"{type(error).__name__}: {error}"
        return Executed(block.page, block.line, text, how, time.monotonic() - start, said)

    def _command(self, line: CommandLine, made: tuple[str, ...]) -> str:
        if line.elsewhere or not is_command(line.text):
            return ELSEWHERE
        if self.check.omits(line.name) or (needs_data(line.name) and not SHARED_DATA.exists()):
            return LEFT_OUT
        arguments = line.arguments(full=self.check.full)
        leaves_nothing = not line.makes and not line.server
        if leaves_nothing and tuple(arguments) in self.check.done:
            return self.check.done[tuple(arguments)]
        lay_out(shlex.join(arguments), self.folder, made)
        if ROBOT in line.name:
            self._emulated_robot("calibrate_only" in line.words)
        if line.server:
            self._serve(arguments)
        else:
            finished = subprocess.run(
                process(arguments), cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False,
                stdin=subprocess.DEVNULL, timeout=LARGEST_TIME_S,
            )  # fmt: skip
            if finished.returncode != 0:
                raise RuntimeError(f"exit code {finished.returncode}: {' '.join(finished.stderr.split())[-600:]}")
        how = WRITTEN if shlex.join(arguments) in (line.name, line.name.replace(ROBOT, EMULATED)) else SHORT
        if leaves_nothing:
            self.check.done[tuple(arguments)] = how
        return how

    def _emulated_robot(self, bare: bool) -> None:
        """Start the emulated robot that takes the place of the real one, once for the page; an operator has entered the
        payload."""
        if "robot" not in self.names:
            self.names["robot"] = EMULATED
            self._serve(["emulate-ur", "--host", EMULATED, "--control-port", "30091"])
        payload = "0.0, [0.0, 0.0, 0.0]" if bare else "1.4, [0.03, 0.0, 0.05]"
        with socket.create_connection((EMULATED, SCRIPT_PORT), timeout=ANSWERS_WITHIN_S) as pendant:
            pendant.sendall(f"sec enter():\n  set_payload({payload})\nend\n".encode())
            time.sleep(1.0)

    def _serve(self, arguments: list[str]) -> None:
        """Start a server, wait for what it says first, and end it with the page, as an operator does."""
        said = (self.folder / f"server{len(list(self.folder.glob('server*')))}.log").open("w+")
        server = subprocess.Popen(
            process(arguments), cwd=self.folder, env=self.environment, stdout=said, stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip

        def end() -> None:
            server.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                server.wait(30)
            server.kill()
            said.close()

        self.beside.callback(end)
        deadline = time.monotonic() + ANSWERS_WITHIN_S
        while Path(said.name).stat().st_size == 0 and server.poll() is None and time.monotonic() < deadline:
            time.sleep(0.2)
        time.sleep(2.0)
        if server.poll() is not None or Path(said.name).stat().st_size == 0:
            raise RuntimeError(f"it did not start: {Path(said.name).read_text()[-600:]}")

    def _yaml(self, block: Block) -> str:
        with tempfile.TemporaryDirectory() as folder:
            if block.kind == "toml":
                example = next(b for b in blocks_of(ROOT / block.page) if "!MyScanner" in b.text)
                check_yaml(example, Path(folder), block.text)
            else:
                check_yaml(block, Path(folder), self.entry_points)
        return WRITTEN

    def _python(self, block: Block) -> str:
        lay_out(block.text, self.folder, ("my_result",) if 'out="my_result"' in block.text else ())
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(io.StringIO()):
            exec(compile(block.text, f"{block.page}:{block.line}", "exec"), self.names)
        return WRITTEN


def entry_points_of(pages: list[Path]) -> str:
    """The block of TOML by which the example of a driver is registered."""
    return next((block.text for page in pages for block in blocks_of(page) if block.kind == "toml"), "")


def execute_page(page: Path, folder: Path, check: Check) -> Iterator[Executed]:
    """Execute all blocks of a page in order."""
    reader = Page(folder, entry_points_of([ROOT / "docs" / "developers.md"]), check)
    with reader.beside:
        for block in blocks_of(page):
            yield from reader.execute(block)
