"""`python -m weldcal.tools` is `weldcal`: signals are answered before the imports, which take seconds."""

from weldcal.systems.interrupts import answer_signals


def main() -> None:
    """Entry point of the `weldcal` console script."""
    answer_signals()
    from weldcal.tools.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
