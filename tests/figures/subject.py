"""Make one command of several studies of a subject: `--what WORD` chooses; each old command stays, hidden."""

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo

from weldcal.tools.cli.options import Body, Call, CliCommand, Outcome, option


class _Parameter(NamedTuple):
    name: str
    kind: Any
    info: Any  # OptionInfo or ArgumentInfo
    default: Any

    @property
    def flag(self) -> str:
        """The option's name on the command line; "" for an argument."""
        return "" if isinstance(self.info, ArgumentInfo) else str((self.info.param_decls or (self.info.default,))[0])


def one_of(first: str, **studies: CliCommand) -> Callable[[Body], Body]:
    """Give a body the options of all its studies, and --what, which chooses one of them:

        @command("benchmark doctor", short_help="Measure the doctor.", options=FARM)
        @one_of("causes", causes=causes, false_alarms=false_alarms)
        def doctor(call: Call) -> None:
            \"\"\"Measure which causes the doctor names.\"\"\"

    Each study is a command of the same module, hidden under its old name. An option of several studies has one type,
    and the default and the bounds of the chosen study.

    Args:
        first: the word of the study that runs without --what.
        studies: the commands by their words; "_" in a word becomes "-".
    """
    bodies = {word.replace("_", "-"): study.body for word, study in studies.items()}
    own = {word: _parameters(body) for word, body in bodies.items()}
    flags = list(dict.fromkeys(p.flag for found in own.values() for p in found))
    names = {flag: flag.split("/")[0].strip("-").replace("-", "_") or "data" for flag in flags}

    def decorate(described: Body) -> Body:
        def body(call: Call, what: str = first, **given: object) -> Outcome | Mapping[str, object] | None:
            if what not in bodies:
                raise typer.BadParameter(f"'{what}' is not one of {', '.join(bodies)}.", param_hint="'--what'")
            return bodies[what](call, **_chosen(what, own[what], {f: given.get(names[f]) for f in flags}))

        keyword = inspect.Parameter.KEYWORD_ONLY
        help = f"What is measured: {', '.join(bodies)}."
        body.__doc__ = described.__doc__
        body.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [
                inspect.Parameter("call", inspect.Parameter.POSITIONAL_OR_KEYWORD),
                *(_merged(names[f], {w: p for w, ps in own.items() for p in ps if p.flag == f}) for f in flags),
                inspect.Parameter(
                    "what", keyword, default=first, annotation=Annotated[str, option("--what", "WORD", help)]
                ),
            ]
        )
        return body

    return decorate


def _parameters(body: Body) -> list[_Parameter]:
    found = []
    for p in list(inspect.signature(body, eval_str=True).parameters.values())[1:]:
        assert get_origin(p.annotation) is Annotated, f"{p.name} has no option"
        kind, info = get_args(p.annotation)[:2]
        found.append(_Parameter(p.name, kind, info, p.default))
    return found


def _merged(name: str, users: Mapping[str, _Parameter]) -> inspect.Parameter:
    """One parameter of the subject for that of one or more of its studies; None where it is not given."""
    info: OptionInfo | ArgumentInfo = copy.copy(next(iter(users.values())).info)
    helps = " / ".join(dict.fromkeys(str(p.info.help) for p in users.values()))
    info.help = f"({', '.join(users)}) {helps}"
    info.min = info.max = None
    kind: Any = str
    if isinstance(info, ArgumentInfo):
        info.metavar, info.show_default = "DATA", False
    else:
        kinds = {p.kind for p in users.values()}
        assert len(kinds) == 1, f"--{name} has several types: {kinds}"
        kind, info.show_default = kinds.pop(), _default(users) or False
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, info]
    )


def _default(users: Mapping[str, _Parameter]) -> str:
    """Return the defaults as the help shows them: the one that all share, or that of each study."""
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


def _chosen(what: str, own: Sequence[_Parameter], given: Mapping[str, Any]) -> dict[str, Any]:
    """The given values by the names of the chosen study's parameters.

    Raises:
        typer.BadParameter: an option of another study, a value out of bounds, or no argument where one is needed.
    """
    out: dict[str, Any] = {}
    for flag, value in given.items():
        if value is not None and flag not in {p.flag for p in own}:
            raise typer.BadParameter(f"--what {what} takes no {flag.split('/')[0] or 'argument'}.")
    for p in own:
        value = given[p.flag]
        if value is None:
            if p.default is inspect.Parameter.empty:
                raise typer.BadParameter(f"--what {what} needs {p.info.metavar or p.name.upper()}. {p.info.help}")
            out[p.name] = p.default
            continue
        low, high = p.info.min, p.info.max
        if (low is not None and value < low) or (high is not None and value > high):
            raise typer.BadParameter(f"{value} is not in the range {_limits(low, high)}.", param_hint=f"'{p.flag}'")
        of_path = p.kind is Path or Path in get_args(p.kind)
        out[p.name] = Path(value) if isinstance(p.info, ArgumentInfo) and of_path else value
    return out


def _limits(low: float | None, high: float | None) -> str:
    return " and ".join(f"{text} {v:g}" for text, v in (("at least", low), ("at most", high)) if v is not None)
