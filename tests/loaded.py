"""Print how many lines of weldcal a command loads, and how many of them it enters.

python -m tests.loaded COMMAND [OPTIONS...]      such as: demo --no-browser --out DIR

A module counts whole once it is imported, a function whole once it is entered. Compiled loops and other processes are
not seen. Where the call needs no entered lines, --loaded leaves out the profiler, which slows a run by a half.
"""

from __future__ import annotations

import ast
import sys
import threading
from pathlib import Path
from types import CodeType, FrameType

from typer.testing import CliRunner

from tests.places import ROOT

SHOWN = 40  # modules that are loaded and not entered


class Entered:
    """A profile function that keeps the code objects of weldcal's functions that were called."""

    def __init__(self) -> None:
        self.codes: set[CodeType] = set()

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """Keep the function of a call."""
        if event == "call":
            self.codes.add(frame.f_code)

    def lines(self) -> dict[str, int]:
        """Lines of the entered functions, those inside them once, by file."""
        found: dict[str, set[int]] = {}
        functions: dict[str, dict[int, int]] = {}
        for code in self.codes:
            path = str(Path(code.co_filename).resolve())
            if _own(path) and code.co_name != "<module>":
                if path not in functions:
                    functions[path] = _ends(path)
                end = functions[path].get(code.co_firstlineno)
                if end is not None:
                    found.setdefault(path, set()).update(range(code.co_firstlineno, end + 1))
        return {path: len(lines) for path, lines in found.items()}


def _own(path: str) -> bool:
    inside = path.endswith(".py") and Path(path).is_relative_to(ROOT)
    return inside and Path(path).relative_to(ROOT).parts[0] not in ("tests", ".venv")


def _ends(path: str) -> dict[int, int]:
    """The last line of each function by its first, decorators included."""
    tree = ast.parse(Path(path).read_text(encoding="utf-8"))
    return {
        min([node.lineno, *(d.lineno for d in node.decorator_list)]): node.end_lineno or node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def loaded() -> dict[str, int]:
    """Lines of weldcal's modules that are imported in this process, by file."""
    found = {}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] == "weldcal" and file and file.endswith(".py"):
            path = Path(file).resolve()
            found[str(path)] = len(path.read_text(encoding="utf-8").splitlines())
    return found


def main() -> int:
    """Run a command of weldcal in this process and print its figures; the exit code is the command's."""
    from weldcal.tools.cli.app import app

    words, entered = sys.argv[1:], Entered()
    if "--loaded" in words:
        words.remove("--loaded")
    else:
        threading.setprofile(entered)
        sys.setprofile(entered)
    finished = CliRunner().invoke(app, words)
    sys.setprofile(None)
    print(finished.output, end="")
    modules = loaded()
    print(f"loaded: {sum(modules.values())} lines in {len(modules)} modules")
    if entered.codes:
        lines = entered.lines()
        print(f"entered: {sum(lines.values())} lines in {len(lines)} modules; loaded and not entered, the longest:")
        idle = sorted((n, path) for path, n in modules.items() if path not in lines)
        print(*(f"{n:6d} {Path(path).relative_to(ROOT)}" for n, path in idle[: -SHOWN - 1 : -1]), sep="\n")
    return finished.exit_code


if __name__ == "__main__":
    raise SystemExit(main())
