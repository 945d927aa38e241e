"""The command line: every command that is found, in its group, in the order of the help text."""

import shlex
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

import typer
import typer.main
from typer.core import TyperCommand, TyperGroup

from weldcal.systems.interrupts import answer_signals
from weldcal.tools import console
from weldcal.tools.cli.discovery import PACKAGES, Entry, find_commands

PURPOSE = "Calibrate a 3D scanner to a robot by the robot's own flange, then weld along a seam that is felt by touch."
GROUPS = {
    "finger": "Calibrate the finger camera and the soft tip.",
    "tool": "Check a tool of your own.",
    "tablet": "Calibrate a wrist camera with a tablet as target.",
    "hand-eye": "Calibrate a camera from pairs of poses.",
    "profiler": "Calibrate a laser profiler and map a seam.",
}
"""The groups of commands with their help text; a group that is not here needs no text."""
DEFAULTS = {"hand-eye": "ax-yb"}
"""The command of a group that is meant where a file follows the group's name."""

PANELS = {
    "Calibrate": (
        *(
            "capture",
            "calibrate",
            "verify",
            "compare",
            "apply",
            "camera",
            "hand-eye",
            "profiler",
            "tablet",
            "plan-poses",
        ),
        *("doctor", "monitor", "fleet"),
    ),
    "Weld": ("demo", "weld", "plan-passes", "part", "new", "finger", "tool"),
    "Robot": ("robots", "check-robot", "check-cell", "emulate-ur", "emulate-cell"),
    "Data": ("import", "export", "schema", "print-board"),
    "Look": ("view", "replay"),
}
"""The commands and groups in the order of the help text."""
ORDER = (
    *(name for names in PANELS.values() for name in names),
    *("tablet serve", "tablet calibrate", "tablet demo", "profiler edge", "profiler sphere"),
    *("profiler planes", "profiler joint", "profiler compensate"),
    *("profiler seam", "profiler bead", "profiler clock", "profiler step", "profiler live"),
)
"""The full names of the commands in the order of the help text; the others follow by name."""


class LazyCommands(MutableMapping[str, Any]):
    """The commands of a group by name: sub-groups as they are, a command imported when it is asked for."""

    def __init__(self, entries: Iterable[Entry], groups: MutableMapping[str, Any]) -> None:
        self.entries = {entry.title.split(" ")[-1]: entry for entry in entries}
        self._made: dict[str, Any] = dict.fromkeys(self.entries) | dict(groups)

    def is_made(self, name: str) -> bool:
        """Return whether the command needs no import, or does not exist."""
        return self._made.get(name) is not None or name not in self.entries

    def __getitem__(self, name: str) -> Any:
        if self._made[name] is None:
            self._made[name] = _typer_command(name, self.entries[name])
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __contains__(self, name: object) -> bool:
        return name in self._made

    def __iter__(self) -> Iterator[str]:
        return iter(self._made)

    def __len__(self) -> int:
        return len(self._made)


def _typer_command(name: str, entry: Entry) -> Any:
    found = entry.head()
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    kind = type("KeyedCommand", (KeyedCommand,), {"keys": found.keys})
    alone.command(name, cls=kind, short_help=entry.short_help)(found.function)
    return typer.main.get_command(alone)


class KeyedCommand(TyperCommand):
    """A command that names the key of --as for an option that became one."""

    keys: ClassVar[tuple[str, ...]] = ()

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuses an earlier option with the words that take its place, as wrong usage."""
        for after, word in enumerate(args, 1):
            name, attached, value = word.partition("=")
            key = name[2:].removeprefix("no-")
            if name.startswith("--") and key in self.keys:
                from weldcal.tools.cli.options import KEYS, YES_NO  # only here: app.py starts without the options

                if not attached:
                    value = "".join(word for word in args[after : after + 1] if not word.startswith("-"))
                if KEYS[key] is YES_NO and value not in ("yes", "no"):
                    value = "no" if name.startswith("--no-") else "yes"
                ctx.fail(f"The option {name} is a key of --as now: write --as {shlex.quote(f'{key}={value}')}.")
        return super().parse_args(ctx, args)


class CommandGroup(TyperGroup):
    """A group that lists its commands without importing them."""

    entries: ClassVar[tuple[Entry, ...]] = ()

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = LazyCommands(self.entries, self.commands)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Imports the command that is called; a failed import is one sentence, with --debug its traceback."""
        default = DEFAULTS.get(self.name or "")
        if default and args and args[0] not in self.commands and Path(args[0]).exists():
            args = [default, *args]
        if args and args[0] in self.commands:
            with console.boundary(json_wanted="--json" in args, debug="--debug" in args):
                self.commands[args[0]]
        elif args and not args[0].startswith("-") and not ctx.resilient_parsing:
            from weldcal.models.documents import nearest  # only here: an import of 80 ms

            near = nearest(args[0], self.commands)
            ctx.fail(f"No such command '{args[0]}'." + (f" Did you mean '{near}'?" if near else ""))
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        """The names, without an import."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command; while a shell completes its name, only its line of help, without an import."""
        commands: LazyCommands = self.commands  # type: ignore[assignment]
        if ctx.resilient_parsing and not commands.is_made(cmd_name):
            entry = commands.entries[cmd_name]
            return SimpleNamespace(hidden=False, get_short_help_str=lambda *_: entry.short_help)
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes the list of commands by panel, each with its whole short help."""
        entries = self.commands.entries  # type: ignore[attr-defined]
        shown = {
            name: entries[name].short_help if name in entries else self.commands[name].help for name in self.commands
        }
        panels = dict(PANELS) if ctx.parent is None else {}
        panels["Commands"] = tuple(n for n in shown if not any(n in names for names in panels.values()))
        for title, names in panels.items():
            if rows := [(name, shown[name]) for name in names if name in shown]:
                with formatter.section(title):
                    formatter.write_dl(rows)


def main() -> None:
    """Run the command line. SIGTERM ends a command as Ctrl-C does: a run is held and leaves its result folder."""
    answer_signals()
    app(prog_name="weldcal")


def version(wanted: bool) -> None:
    """Prints the installed version and ends."""
    if wanted:
        from importlib.metadata import version as installed_version

        typer.echo(f"weldcal {installed_version('weldcal')}")
        raise typer.Exit()


def weldcal(
    _version: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """The program itself, without a command: only --version."""


def build_app(
    packages: Sequence[str] = PACKAGES, purpose: str = PURPOSE, groups: Mapping[str, str] = GROUPS
) -> typer.Typer:
    """Return the Typer application with all groups and commands of packages."""
    place = {title: number for number, title in enumerate(ORDER)}
    entries = sorted(
        find_commands(packages).values(), key=lambda entry: (place.get(entry.title, len(ORDER)), entry.title)
    )
    parts: dict[str, list[Entry]] = {"": [], **{name: [] for name in groups}}
    for entry in entries:
        parts.setdefault(entry.title.rpartition(" ")[0], []).append(entry)

    def group_class(name: str) -> type[CommandGroup]:
        return type("CommandGroup", (CommandGroup,), {"entries": tuple(parts[name])})

    root = typer.Typer(
        name="weldcal",
        cls=group_class(""),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    root.callback(help=purpose)(weldcal)
    for name in filter(None, parts):
        group = typer.Typer(cls=group_class(name), help=groups.get(name, ""), no_args_is_help=True)
        root.add_typer(group, name=name)
    return root


app = build_app()
