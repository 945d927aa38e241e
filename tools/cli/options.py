"""What all commands share: their common options, the folder of a result, progress, errors and the printed outcome."""

import inspect
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldcal.models.errors import InputError
from weldcal.models.files import whole_result
from weldcal.systems.interrupts import work
from weldcal.tools import console
from weldcal.tools.cli.result_folder import claimed

if TYPE_CHECKING:
    from weldcal.tools.report.first_screen import FirstScreen


LEAST_BYTES = 1 << 20
"""Bytes that must fit on the disk of a result before the work begins."""


def option(name: str, metavar: str, help: str, **settings: Any) -> Any:
    """An option with a value, as Typer's Option; `settings` are its other settings, such as min and show_default."""
    return typer.Option(name, metavar=metavar, help=help, **settings)


def switch(names: str, help: str, **settings: Any) -> Any:
    """Return an option without a value: "--name", or "--name/--no-name"; `settings` as in `option`."""
    return typer.Option(names, help=help, **settings)


ScenarioOption = Annotated[str, option("--scenario", "NAME", "Name of a scenario, or path of a scenario YAML file.")]
ScenarioArgument = Annotated[
    str | None, typer.Argument(metavar="SCENARIO", help="The same as --scenario.", show_default=False)
]
RecordOption = Annotated[bool, switch("--record", "Also write recording.html, the run in 3D.")]
CorrectionOption = Annotated[
    bool,
    switch(
        "--scanner-correction/--no-scanner-correction",
        "For a dataset: estimate and correct the scanner's scale error, or use the scans uncorrected.",
    ),
]
FlangeOption = Annotated[
    str | None, option("--flange", "NAME", "Flange standard, if the dataset does not name it: iso9409-1-50-4-m6.")
]

_BROWSER = "Open the dashboard with the live 3D view in the web browser, or do not."
_SHARE = "Show the dashboard, read-only, to the network too, at an address with a token."
_ROBOT = "simulated, emulated (a controller on loopback), or the address of a controller."
_ADDRESS = "Loopback address 127.x.y.z of the emulated controller."
_PACE = "Emulated controller only: speed relative to real time, 0.05 to 1."
_SLOWER = "Slow the arm's moves down: 0.05 to 1. The welding speed does not change."
_RECORD = "Also write recording.mcap, which weldcal replay plays back."
LimitOption = Annotated[
    float | None,
    option(
        "--limit-mm",
        "MM",
        "The error that your job allows, at 95 %: the verdict is measured against it.",
        show_default="not stated: use with care at best",
    ),
]
_WORKERS = "Processes on this computer."
_SCHEDULER = "Address of a Dask scheduler; its workers compute, with the same numbers."
_OUT = "Output folder; default: a new one in weldcal-out."
COMMON: dict[str, tuple[Any, object]] = {
    "browser": (Annotated[bool, switch("--browser/--no-browser", _BROWSER)], True),
    "share": (Annotated[bool, switch("--share", _SHARE)], False),
    "realtime": (Annotated[bool, switch("--realtime", "Do not run faster than real time.")], False),
    "record": (Annotated[bool, switch("--record", _RECORD)], False),
    "robot": (Annotated[str | None, option("--robot", "ROBOT", _ROBOT, show_default="as in the scenario")], None),
    "dry_run": (Annotated[bool, switch("--dry-run", "Only read the robot, then run on a simulated arm.")], False),
    "pace": (Annotated[float | None, option("--pace", "P", _PACE)], None),
    "speed_factor": (Annotated[float | None, option("--speed-factor", "X", _SLOWER)], None),
    "address": (Annotated[str | None, option("--address", "ADDRESS", _ADDRESS, show_default="a free one")], None),
    "workers": (
        Annotated[int | None, option("--workers", "N", _WORKERS, min=1, show_default="all cores, as memory allows")],
        None,
    ),
    "scheduler": (Annotated[str | None, option("--scheduler", "ADDRESS", _SCHEDULER)], None),
    "out": (Annotated[Path | None, option("--out", "FOLDER", _OUT)], None),
    "overwrite": (
        Annotated[bool, switch("--overwrite", "Write over an earlier result in the folder of --out.")],
        False,
    ),
    "seed": (Annotated[int, option("--seed", "N", "Seed of all random numbers; the first of several.", min=0)], 0),
    "json": (Annotated[bool, switch("--json", "Print the result as one JSON object, the last line of stdout.")], False),
    "verbose": (
        Annotated[bool, typer.Option("--verbose", "-v", help="Print every figure, not only the verdict.")],
        False,
    ),
    "debug": (Annotated[bool, switch("--debug", "Show the traceback of an internal error.")], False),
}
"""Every common option with its default, by the name of its parameter."""

MOTION = ("dry_run", "pace", "speed_factor")
LIVE = ("browser", "share", "realtime", "robot", *MOTION)
FARM = ("workers", "scheduler")
RESULT = ("out", "overwrite", "seed", "json", "verbose", "debug")
LOOK = ("json", "debug")
"""Groups of common options: of arm motion, of a live run, of a study of many tasks, of a command that writes a result,
of one that only reads."""


@dataclass(frozen=True)
class Outcome:
    """The result of a command as it is printed.

    Attributes:
        summary: the JSON object; its `state`, if not "done", ends the command with exit code 1.
        values: printed as rows instead of the summary; {} for none.
        rows: printed below them.
        text: printed, or called to print, instead of all rows; beside a first screen only with -v.
        first: the first screen of its report, printed below the rows with the report's path; "do not use" ends the
            command with exit code 1.
        problem: a sentence for stderr, with exit code 1; None: taken from the summary, "": none.
    """

    summary: Mapping[str, object]
    values: Mapping[str, object] | None = None
    rows: Mapping[str, str] = field(default_factory=dict)
    text: str | Callable[[], object] | None = None
    problem: str | None = None
    first: "FirstScreen | None" = None


class Call:
    """One call of a command: the common options that were given, the result folder and the progress bar.

    ``reading`` holds what --as states, by key.
    """

    def __init__(self, title: str, given: Mapping[str, Any], stack: ExitStack) -> None:
        self.out: Path | None = given.get("out")
        self.seed: int = given.get("seed", 0)
        self.json: bool = given.get("json", False)
        self.verbose: bool = given.get("verbose", False)
        self.given = given
        self.reading: Mapping[str, Any] = given.get("as_", {})
        self.written: Path | None = None
        self._kept: list[Path] = []
        self._title, self._stack = title, stack
        self._report: console.Progress | None = None
        self._page: tuple[Callable[[FirstScreen | None, Path | None], None], Callable[[], None]] | None = None

    @property
    def live(self) -> dict[str, Any]:
        """The options of a live run; with --json no browser is opened."""
        found = {name: self.given[name] for name in (*LIVE, "record") if name in self.given}
        if self.json and (found.get("share") or "--browser" in sys.argv):
            console.emit_warning(
                "With --json no page is opened: --browser and --share have no effect. Omit --json to see the run."
            )
        return found | ({"browser": found["browser"] and not self.json} if "browser" in found else {})

    def folder(self, command: str, name: str) -> Path:
        """Where the result is written: --out, or a new folder named after the command and what it works on.

        Raises:
            InputError: nothing can be written there. Nothing is created.
        """
        self.written = self.out or fresh_folder(command, name, self.seed)
        self.keep(self.written)
        return self.written

    def keep(self, folder: Path, goes_on: bool = False) -> None:
        """Keeps a folder for the result of this call; `goes_on`: with the result that it holds.

        Raises:
            InputError: nothing can be written there, it holds an earlier result, or another command writes there.
        """
        if folder in self._kept:
            return
        check_writable(folder)
        overwrite, resumes = goes_on or bool(self.given.get("overwrite")), "workers" in self.given
        self._stack.enter_context(claimed(folder, overwrite=overwrite, resumes=resumes))
        self._stack.enter_context(whole_result(folder))
        self._kept.append(folder)

    def keep_page(self, show: "Callable[[FirstScreen | None, Path | None], None]", close: Callable[[], None]) -> None:
        """Keeps the dashboard of a run open until its result is printed; one of an earlier run closes."""
        self.close_page()
        self._page = show, close

    def show_result(self, first: "FirstScreen | None") -> None:
        """Shows the result on the dashboard that is open."""
        if self._page is not None:
            self._page[0](first, self.written)

    def close_page(self) -> None:
        """Closes the dashboard that is open."""
        if self._page is not None:
            self._page[1]()
        self._page = None

    def progress(self, stage: str, fraction: float) -> None:
        """Shows the stage and the completed fraction (0 to 1); the first call opens the progress bar."""
        if self._report is None:
            self._report = self._stack.enter_context(console.progress_bar(self._title))
        self._report(stage, fraction)


@dataclass(frozen=True)
class CliCommand:
    """A command: its full name ("tool check"), the function as Typer takes it, and the keys of its option --as.

    ``read`` refuses wrong numbers and words of --as, and returns what --as states, by key.
    """

    title: str
    function: Callable[..., None]
    keys: tuple[str, ...]
    read: Callable[[Mapping[str, Any]], dict[str, Any]]


LARGEST_OPTION = 1e6
"""Largest size of a number with a fraction on the command line: a kilometre in mm, eleven days in s."""


def _check_numbers(given: Mapping[str, Any]) -> None:
    """Refuses a number that is not finite or too large, as wrong usage. Raises typer.BadParameter."""
    for name, value in given.items():
        if isinstance(value, float) and not abs(value) <= LARGEST_OPTION:
            raise typer.BadParameter(
                f"{value:g} is not a number from {-LARGEST_OPTION:.0f} to {LARGEST_OPTION:.0f}.",
                param_hint=f"'--{name.replace('_', '-')}'",
            )


_FORM, _MM = ("a form, such as euler_xyz,deg", str), ("a number of millimetres", float)
YES_NO = ("yes or no", {"yes": True, "no": False}.__getitem__)
"""What the value is of a key that was an option without one."""
KEYS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "robot-form": _FORM,
    "camera-form": _FORM,
    "intrinsics": ("a file", Path),
    "motions": YES_NO,
    "scanner-correction": YES_NO,
    "sensor-correction": ("a file or folder", Path),
    "set": ("a name", str),
    "trial": ("a whole number", int),
    "pitch": _MM,
    "side": ("left or right", {word: word for word in ("left", "right")}.__getitem__),
    "z": ("away or towards", {word: word for word in ("away", "towards")}.__getitem__),
    "sigma-robot": _MM,
    "sigma-x": _MM,
    "sigma-z": _MM,
}
"""Every key of --as: what its value is, and how its text is read. docs/datasets.md explains them."""


def _read_keys(given: Iterable[str], keys: tuple[str, ...]) -> dict[str, Any]:
    """Read the words KEY=VALUE of --as by key. Raises typer.BadParameter."""
    found: dict[str, Any] = {}
    for word in given:
        key, _, text = word.partition("=")
        if key not in keys:
            from weldcal.models.documents import did_you_mean  # only here: an import of 80 ms

            known = did_you_mean(key, keys, f"the keys of this command are {', '.join(keys)}.", 0.5)
            raise typer.BadParameter(f"there is no key '{key}'; {known}", param_hint="'--as'")
        if key in found:
            raise typer.BadParameter(f"{key} is given twice: give it once.", param_hint="'--as'")
        what, read = KEYS[key]
        try:
            found[key] = {text: read(text)}[text or key]
        except (ValueError, KeyError):
            raise typer.BadParameter(f"{key} is {what}, not '{text}'.", param_hint="'--as'") from None
    _check_numbers({f"as {key}": value for key, value in found.items()})
    return found


Body = Callable[..., Outcome | Mapping[str, object] | None]


def command(
    title: str,
    *,
    short_help: str,
    keys: tuple[str, ...] = (),
    options: tuple[str, ...] = (),
    common: tuple[str, ...] = RESULT,
    defaults: Mapping[str, object] | None = None,
) -> Callable[[Body], CliCommand]:
    """Makes a command of a function body(call, own parameters ...) that returns an Outcome, a summary or None.

    The body gets the common options ``options`` and ``common`` through its Call, and what --as states by its ``keys``.
    It runs inside console.boundary, with a progress bar where it reports progress. Its outcome is printed, as JSON if
    --json is given. The title and ``short_help`` are literals: `find_commands` reads them from the module's text.
    ``short_help`` has at most 56 characters.
    """
    names = (*options, *common)
    preset = {name: (defaults or {}).get(name, COMMON[name][1]) for name in names}

    def decorate(body: Body) -> CliCommand:
        def read(given: Mapping[str, Any]) -> dict[str, Any]:
            _check_numbers(given)
            return _read_keys(given.get("as_", ()), keys)

        def run(**given: Any) -> None:
            # A signal in Python's logging below Drake's would be lost: C++ takes the exception. Set after the import,
            # the level holds in C++ (pydrake.common, _sync_spdlog_level), and Drake's notes never come to Python.
            logging.getLogger("drake").setLevel(logging.WARNING)
            shared = {"as_": read(given)} | {name: given.pop(name) for name in names}
            given.pop("as_", None)
            json, debug = shared.get("json", False), shared["debug"]
            with ExitStack() as pages:
                with console.boundary(json_wanted=json, debug=debug), work(), ExitStack() as stack:
                    call = Call(title, shared, stack)
                    pages.callback(call.close_page)
                    if call.out is not None:
                        call.keep(call.out)
                    outcome = body(call, **given)
                if outcome is not None:
                    report(title, outcome if isinstance(outcome, Outcome) else Outcome(outcome), call)

        own = list(inspect.signature(body, eval_str=True).parameters.values())[1:]
        shared = [
            inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=preset[n], annotation=COMMON[n][0])
            for n in names
        ]
        if keys:
            words = f"How to read the file, by the keys {', '.join(keys)} (docs/datasets.md)."
            as_ = Annotated[list[str], option("--as", "KEY=VALUE", words, show_default=False)]
            shared.insert(0, inspect.Parameter("as_", inspect.Parameter.KEYWORD_ONLY, default=(), annotation=as_))
        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own] + shared
        run.__doc__ = body.__doc__
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return CliCommand(title, run, keys, read)

    return decorate


def fresh_folder(command: str, name: str, seed: int) -> Path:
    """The first unused weldcal-out/<command>-<name>-seed<N>[-2, -3 ...]: an earlier result is never overwritten."""
    first = Path("weldcal-out") / f"{command}-{Path(name).stem}-seed{seed}"
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder


def check_writable(folder: Path) -> None:
    """Try whether files can be written in a folder, or in the nearest one above it that exists; leaves nothing.

    Raises:
        InputError: they cannot.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"'{folder}' is a file. Give a folder for the result.")
    there = next((one for one in (folder, *folder.absolute().parents) if one.exists()), folder)
    try:
        # the only test that holds for every file system, and for root
        with tempfile.TemporaryFile(dir=there) as file:
            file.write(bytes(LEAST_BYTES))
            file.flush()
            os.fsync(file.fileno())  # a full disk refuses the bytes, not the name
    except OSError as problem:
        raise InputError(
            f"Nothing can be written to '{folder}' ({problem.strerror or problem}). Give another folder with --out."
        ) from problem


MOST_LINES = 12
"""Lines of a result in the terminal: verdict, figure, pose, what could be wrong, next step, files."""


def _emit_first(title: str, first: "FirstScreen", written: Path | None) -> None:
    """Prints the verdict and what follows from it, with as many of the concerns and notes as fit."""
    files = "" if written is None else f"{written / 'report.html'} (-v: all)"
    for size in first.sizes:
        rows = first.brief(*size) | {"report": files}
        last = size == first.sizes[-1]
        if console.emit_summary(f"{title}: {first.named}", rows, most=None if last else MOST_LINES):
            return


def _emit_all(title: str, outcome: Outcome, first: "FirstScreen", written: Path | None) -> None:
    """Prints every row or the text, then the same as the first screen of the report, and the report's path."""
    values = dict(outcome.summary if outcome.values is None else outcome.values)
    values.pop("unobservable", None)  # what matters to the pose is among the first screen's concerns
    if isinstance(warnings := values.get("warnings"), list):
        values["warnings"] = [text for text in warnings if text not in (*first.concerns, *first.notes)]
    if isinstance(outcome.text, str):
        console.emit_text(outcome.text)
    else:
        console.emit_summary(title, console.rows(values) | dict(outcome.rows))
    rows = first.rows()
    if written is not None:
        rows |= {"written to": str(written), "report": str(written / "report.html")}
    typer.echo("")
    console.emit_summary("In short", rows)


def report(title: str, outcome: Outcome, call: Call) -> None:
    """Prints the outcome (with --json as JSON) and ends with exit code 1 where there is a problem or "do not use".

    Raises:
        typer.Exit: with code 1.
    """
    call.show_result(outcome.first)
    summary = outcome.summary
    state = str(summary.get("state", "done"))
    first = outcome.first
    if call.json:
        console.emit_json(summary if first is None else {"first_screen": first.document(), **summary})
    elif first is not None and not call.verbose:
        _emit_first(title, first, call.written)
    elif first is not None:
        _emit_all(f"{title}: {state}", outcome, first, call.written)
    elif callable(outcome.text):
        outcome.text()
    elif outcome.text is not None:
        console.emit_text(outcome.text)
    else:
        rows = console.rows(summary if outcome.values is None else outcome.values) | dict(outcome.rows)
        rows |= {} if call.written is None else {"written to": str(call.written)}
        console.emit_summary(f"{title}: {state}", rows)
    problem = outcome.problem
    if problem is None and state != "done":
        problem = str(summary.get("reason") or f"The {title} ended {state}; see the report for the reason.")
    if not problem and first is not None:
        problem = first.refusal if call.json or not first.refusal else f"The verdict is: {first.named}."
    if problem:
        console.emit_warning(problem)
        raise typer.Exit(1)
