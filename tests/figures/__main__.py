"""List the figures, or run one: `./tools/run figures NAME` prints what README and docs cite, and the papers' tables."""

from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Annotated, Any

import typer

import tests.figures
from tests.figures.harness import FIGURES, Body, Run
from tests.figures.mutate import mutate
from tests.figures.speed import speed
from weldcal.models.errors import WeldcalError

app = typer.Typer(help=__doc__, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


def command(body: Body) -> Any:
    """Return the command of a figure."""

    def run(
        full: Annotated[bool, typer.Option("--full", help="As the documents cite it: minutes to hours.")] = False,
        seed: Annotated[int, typer.Option("--seed", help="Of everything random.")] = 0,
        data: Annotated[Path | None, typer.Option("--data", help="Folder of measured data.")] = None,
        out: Annotated[Path, typer.Option("--out", help="For pictures and tables.")] = Path("weldcal-out/figures"),
    ) -> None:
        if data is not None and not data.is_dir():
            raise typer.BadParameter(f"There is no folder '{data}'.", param_hint="'--data'")
        try:
            body(Run(full=full, seed=seed, data=data, out=out))
        except WeldcalError as error:
            typer.echo(str(error), err=True)
            raise typer.Exit(1) from error

    return run


for module in walk_packages(tests.figures.__path__, "tests.figures."):
    if not module.name.rpartition(".")[2].startswith(("test_", "__")):
        import_module(module.name)
for name in sorted(FIGURES):
    app.command(name, short_help=FIGURES[name][0], help=FIGURES[name][0])(command(FIGURES[name][1]))
app.command("mutate", short_help="whether the tests notice a changed formula")(mutate)
app.command("speed", short_help="processor time of what people wait for, against a commit")(speed)

if __name__ == "__main__":
    app(prog_name="./tools/run figures")
