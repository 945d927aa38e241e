"""Output of the commands: progress, summary, JSON and the error boundary."""

import dataclasses
import enum
import json
import math
import re
import shutil
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import typer

from weldcal.models.errors import WeldcalError
from weldcal.systems.interrupts import INTERRUPTED, received

Progress = Callable[[str, float], None]
"""Called with the stage and the completed fraction (0 to 1)."""


def plain(value: object) -> object:
    """The value in JSON's own types: arrays and poses as nested lists, non-finite numbers as null, paths as text."""
    if value is None or isinstance(value, bool | int | str):
        return value.value if isinstance(value, enum.Enum) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    for converter in ("tolist", "GetAsMatrix4"):  # a NumPy array or scalar; a RigidTransform
        if hasattr(value, converter):
            return plain(getattr(value, converter)())
    raise TypeError(f"A {type(value).__name__} has no JSON form. Convert it first.")


def emit_json(result: Mapping[str, object]) -> None:
    """Writes the result as one line of strict JSON (no NaN) on stdout."""
    typer.echo(json.dumps(plain(result), allow_nan=False))


NARROW, WIDE = 40, 130
"""Widths of the terminal, in characters, within which text is wrapped; beyond it lines become hard to read."""


def emit_summary(title: str, rows: Mapping[str, str], most: int | None = None) -> bool:
    """Writes a heading and a two-column list on stdout, wrapped between words; rows with empty text are omitted.

    Lines of a text stay lines. A name that is too long for its column is on a line of its own.

    Returns:
        False where it has more than ``most`` lines: then nothing is written.
    """
    known = [name.rstrip() for name, text in rows.items() if text]
    column = min(max(map(len, known), default=0), MOST_NAME)
    wide = min(max(shutil.get_terminal_size((100, 24)).columns, NARROW), WIDE)
    lines = [line for name, text in rows.items() if text for line in summary_lines(name.rstrip(), text, column, wide)]
    if most is not None and len(lines) + bool(title) > most:
        return False
    if title:
        typer.secho(title, bold=True)
    for line in lines:
        typer.echo(line)
    return True


MOST_NAME = 26
WHOLE = ("p[", "weldcal ", "[[")
"""Beginnings of lines that an operator copies: they stay whole, as does a command between quotes."""
_JOINED = "\x1f"


def summary_lines(name: str, text: str, column: int, wide: int) -> list[str]:
    """Lay out one row: the name in a column of so many characters, then the text, wrapped to a width."""
    indent = " " * (2 + column + 2)
    found: list[str] = []
    for line in text.splitlines():
        if line.startswith(WHOLE):
            found.append(line)
            continue
        inner = " " * (len(line) - len(line.lstrip()) + (2 if line.startswith("- ") else 0))
        whole = re.sub(r"'weldcal [^']+'", lambda command: command[0].replace(" ", _JOINED), line)
        wrapped = textwrap.wrap(
            whole, max(wide - len(indent), 20), subsequent_indent=inner, break_long_words=False, break_on_hyphens=False
        )
        found += [text.replace(_JOINED, " ") for text in wrapped] or [""]
    lines = [indent + line for line in found]
    if len(name) > column:
        return [f"  {name}", *lines]
    return [f"  {name:<{column}}  {found[0]}", *lines[1:]]


NAMES = {
    "n_used": "scans used",
    "n_scans": "scans taken",
    "held_out_mm": "held-out error",
    "k_fold_mm": "k-fold error",
    "tilt_deg": "tilt error",
    "model_reason": "why this model",
    "torch_speed_cv": "torch speed variation",
    "peak_omega": "peak turning rate (rad/s)",
    "next_pose": "next best pose",
    "wall_seconds": "seconds",
    "late_ms": "largest delay while moving (ms)",
    "thinking_ms": "longest computation at rest (ms)",
    "reanchored": "times behind real time",
    "fell_behind": "note",
    "slowed_to_percent": "slowest rate of the path (%)",
    "slowed_s": "time added by slowing (s)",
    "held_by_person": "times held by an operator",
}
"""Printed names of the numbers of the JSON object whose keys are too short."""


def rows(result: Mapping[str, object]) -> dict[str, str]:
    """Return the result's short values as printed, by name, without matrices and `state`.

    A list of {id, reason} becomes one row per id, so that every refusal is named.
    """
    found: dict[str, str] = {}
    for key, value in result.items():
        unit = next((unit for unit in ("mm", "deg") if key.endswith(f"_{unit}")), "")
        name = NAMES.get(key) or key.removesuffix(f"_{unit}").replace("_error", " error").replace(
            "torch_", "torch "
        ).replace("_at_", " at ")
        if isinstance(value, list) and all(
            isinstance(item, Mapping) and {"id", "reason"} <= set(item) for item in value
        ):
            found.update({f"{name} {item['id']}": str(item["reason"]) for item in value})
        elif key not in ("state", "reason"):
            text = f"{_short(value)} {unit}".strip() if _short(value) else ""
            found[name] = ", ".join(part for part in (found.get(name, ""), text) if part)
    return found


def _short(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {True: "yes", False: "no", None: ""}[value]
    if isinstance(value, float):
        if math.isnan(value):
            return ""
        return f"{value:,.0f}" if 1000.0 <= abs(value) < 1e12 else f"{value:.3g}"
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, Mapping):
        numbers = {name: item for name, item in value.items() if isinstance(item, int | float)}
        known = len(numbers) == len(value) and not any(isinstance(v, float) and math.isnan(v) for v in numbers.values())
        return ", ".join(f"{name} {_short(item)}" for name, item in numbers.items()) if known else ""
    if isinstance(value, list | tuple) and all(isinstance(item, str) for item in value):
        return "\n".join(value)
    return ""


def emit_text(text: str) -> None:
    """Write a text on stdout; wide lines are wrapped between words, below their second column."""
    wide = min(max(shutil.get_terminal_size((100, 24)).columns, NARROW), WIDE)
    for line in text.splitlines():
        column = re.match(r"\S.{0,14}?\s{2,}", line)
        inner = " " * (0 if column is None else column.end())
        lines = (
            [line]
            if len(line) <= wide or any(word in line for word in WHOLE)
            else textwrap.wrap(line, wide, subsequent_indent=inner, break_long_words=False, break_on_hyphens=False)
        )
        typer.echo("\n".join(lines))


def _sentence(text: str) -> str:
    """Return a sentence for stderr: one line, which a terminal gets wrapped between words."""
    line = f"weldcal: {text}"
    if not sys.stderr.isatty():
        return line
    wide = min(max(shutil.get_terminal_size((100, 24)).columns, NARROW), WIDE)
    return textwrap.fill(line, wide, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def emit_warning(text: str) -> None:
    """Writes one sentence on stderr; the command continues."""
    typer.secho(_sentence(text), err=True, fg=typer.colors.YELLOW)


def emit_address(name: str, url: str) -> None:
    """Writes the address of a page on stderr; the command continues."""
    typer.secho(f"{name}  {url}", err=True, bold=True)


@contextmanager
def boundary(*, json_wanted: bool, debug: bool) -> Iterator[None]:
    """Turns every failure inside the block into one sentence on stderr and exit code 1; with --json, into JSON too.

    Raises:
        typer.Exit: with code 1, for a WeldcalError, an OSError or (named an internal error) anything else; with code
            130 for Ctrl-C.
    """
    details: dict[str, object] = {}
    code = 1
    try:
        yield
    except KeyboardInterrupt as problem:
        code, sentence = INTERRUPTED, _ended(problem)
    except WeldcalError as problem:
        sentence, details = str(problem), getattr(problem, "details", {})
    except OSError as problem:
        place = f": {problem.filename}" if problem.filename else ""
        sentence = f"{problem.strerror or problem}{place}. Check that the path exists and is writable."
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except MemoryError:
        sentence = (
            "There is not enough memory for this. Give fewer or smaller files, or use a computer with more memory."
        )
    except Exception as problem:
        if debug:
            traceback.print_exc()
        advice = "" if debug else " Run the command again with --debug and report the traceback."
        sentence = f"Internal error of weldcal: {type(problem).__name__}: {problem}.{advice}"
        if received():
            code, sentence = INTERRUPTED, _ended(problem)
    else:
        return
    if json_wanted:
        emit_json({"state": "failed", "reason": sentence, **details})
    typer.secho(_sentence(sentence), err=True, fg=typer.colors.RED)
    raise typer.Exit(code)


def _ended(problem: BaseException) -> str:
    """Return the sentence of a command that a signal ended; it names the folder whose result is not complete."""
    folders = getattr(problem, "__notes__", ())
    begun = f"The result in '{folders[0]}' is not complete (UNFINISHED): run the command again." if folders else ""
    return f"Ctrl-C or SIGTERM ended the command. {begun or 'It leaves no incomplete result.'}"


SHARE_TOLD = 0.1
"""Completed share after which a stage that lasts is told again, where stderr is not a terminal."""
_NUMBER = re.compile(r"\d+(\.\d+)?")


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A progress bar on stderr, or one line per new stage where stderr is not a terminal; yields the reporter.

    The completed fraction never falls: a stage that reports less than an earlier one leaves it where it is. The text of
    a stage after a line break is printed on lines of its own, above the bar.
    """
    reached = 0.0

    def never_less(fraction: float) -> float:
        nonlocal reached
        reached = max(reached, min(fraction, 1.0))
        return reached

    if not sys.stderr.isatty():
        last, told = "", 0.0

        def report_line(stage: str, fraction: float) -> None:
            nonlocal last, told
            fraction = never_less(fraction)
            stage = stage.replace("\n", ". ")
            kind = _NUMBER.sub("", stage.partition(", ")[0])  # a count within a stage is no new stage
            if kind != last or fraction >= told + SHARE_TOLD:
                typer.echo(f"[{100 * fraction:3.0f} %] {title}: {stage}", err=True)
                last, told = kind, fraction

        yield report_line
        return

    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar
    from rich.table import Column

    words = TextColumn("{task.description}", table_column=Column(no_wrap=False))  # a long stage takes a second line
    columns = (words, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task, said = bar.add_task(title, total=1.0), ""

        def report_bar(stage: str, fraction: float) -> None:
            nonlocal said
            stage, _, more = stage.partition("\n")
            if more and more != said:  # the bar's line is cut where the terminal ends
                bar.console.print(more, markup=False, highlight=False, style="bold")
            said = more
            bar.update(task, completed=never_less(fraction), description=f"{title}: {stage}")

        yield report_bar
