"""Makes one command of several studies of a subject: `--what WORD` chooses, and every old name stays as a hidden command."""

import copy
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo

from weldcal.tools.cli.options import Body, Call, Command, Outcome, command, option


class Part(NamedTuple):
    """One study of a subject.

    Attributes:
        word: the value of --what.
        body: its function, as `command` takes it.
        old: the full name of the hidden command, such as "benchmark flange-frames"; "" for none.
        options: groups of common options that it needs, such as FARM.
    """

    word: str
    body: Body
    old: str = ""
    options: tuple[str, ...] = ()


class _Parameter(NamedTuple):
    name: str
    kind: Any
    info: OptionInfo | ArgumentInfo
    default: object

    @property
    def flag(self) -> str:
        """The option's name on the command line; "" for an argument."""
        return "" if isinstance(self.info, ArgumentInfo) else str((self.info.param_decls or [""])[0])


def subject(title: str, about: str, parts: Sequence[Part]) -> tuple[Command, ...]:
    """The command of the subject, whose first part runs without --what, and the hidden commands of the old names.

    Args:
        title: full name, such as "benchmark flange".
        about: its help text.
        parts: its studies. An option of several parts has one type and the default of each.
    """
    own = {part.word: _parameters(part.body) for part in parts}
    bodies = {part.word: part.body for part in parts}
    flags = list(dict.fromkeys(p.flag for found in own.values() for p in found))
    names = {flag: flag.split("/")[0].strip("-").replace("-", "_") or "data" for flag in flags}

    def body(call: Call, what: str, **given: object) -> Outcome | Mapping[str, object] | None:
        if what not in bodies:
            raise typer.BadParameter(f"'{what}' is not one of {', '.join(bodies)}.", param_hint="'--what'")
        return bodies[what](call, **_chosen(what, own[what], {flag: given[names[flag]] for flag in flags}))

    first = parts[0].word
    what = Annotated[str, option("--what", "WORD", f"What is measured: {', '.join(bodies)}.")]
    keyword = inspect.Parameter.KEYWORD_ONLY
    signature = [
        inspect.Parameter("call", inspect.Parameter.POSITIONAL_OR_KEYWORD),
        *(_merged(names[f], {w: p for w, found in own.items() for p in found if p.flag == f}) for f in flags),
        inspect.Parameter("what", keyword, default=first, annotation=what),
    ]
    body.__doc__ = about
    body.__signature__ = inspect.Signature(sorted(signature, key=lambda p: p.kind))  # type: ignore[attr-defined]
    common = tuple(dict.fromkeys(name for part in parts for name in part.options))
    hidden = (replace(command(p.old, options=p.options)(p.body), hidden=True) for p in parts if p.old)
    return command(title, options=common)(body), *hidden


def _parameters(body: Body) -> list[_Parameter]:
    found = []
    for p in list(inspect.signature(body, eval_str=True).parameters.values())[1:]:
        assert get_origin(p.annotation) is Annotated, f"{p.name} has no option"
        kind, info = get_args(p.annotation)[:2]
        found.append(_Parameter(p.name, kind, info, p.default))
    return found


def _merged(name: str, users: Mapping[str, _Parameter]) -> inspect.Parameter:
    """One parameter of the subject for that of one or more of its studies; None where it is not given."""
    info = copy.copy(next(iter(users.values())).info)
    helps = list(dict.fromkeys(str(p.info.help) for p in users.values()))
    info.help = f"({', '.join(users)}) {' / '.join(helps)}"
    info.min = info.max = None
    if isinstance(info, ArgumentInfo):
        info.metavar, info.show_default = "[DATA]", False
        kind: Any = str
    else:
        kinds = {p.kind for p in users.values()}
        assert len(kinds) == 1, f"--{name} has several types: {kinds}"
        kind = kinds.pop()
        info.show_default = _default(users) or False
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, info]
    )


def _default(users: Mapping[str, _Parameter]) -> str:
    """The defaults as the help shows them: the one that all share, or that of each study."""
    texts = {word: _text(p) for word, p in users.items()}
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return ", ".join(f"{word}: {text}" for word, text in texts.items() if text)


def _text(p: _Parameter) -> str:
    if isinstance(p.info.show_default, str):
        return p.info.show_default
    if isinstance(p.default, bool):
        on, _, off = p.flag.partition("/")
        return (on if p.default else off).lstrip("-")
    return "" if p.default in (None, inspect.Parameter.empty, "") else str(p.default)


def _chosen(what: str, own: Sequence[_Parameter], given: Mapping[str, object]) -> dict[str, Any]:
    """The given values by the names of the chosen study's parameters.

    Raises:
        typer.BadParameter: an option of another study, a value out of bounds, or no argument where one is needed.
    """
    flags = {p.flag for p in own}
    for flag, value in given.items():
        if value is not None and flag not in flags:
            raise typer.BadParameter(f"--what {what} takes no {flag.split('/')[0] or 'argument'}.")
    out: dict[str, Any] = {}
    for p in own:
        value = given[p.flag]
        if value is None:
            if p.default is inspect.Parameter.empty:
                raise typer.BadParameter(f"--what {what} needs {p.info.metavar or p.name.upper()}. {p.info.help}")
            continue
        low, high = p.info.min, p.info.max
        if isinstance(value, int | float) and not (low is None or value >= low) & (high is None or value <= high):
            limits = " to ".join(f"{v:g}" if v is not None else "any" for v in (low, high))
            raise typer.BadParameter(f"{value} is not in the range {limits}.", param_hint=f"'{p.flag}'")
        out[p.name] = (
            Path(str(value)) if isinstance(p.info, ArgumentInfo) and Path in (p.kind, *get_args(p.kind)) else value
        )
    return out
