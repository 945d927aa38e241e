"""`python -m weldcal.tools` is `weldcal`: signals are answered before the imports, which take seconds."""

from weldcal.systems.interrupts import answer_signals, ignore_signals


def main() -> None:
    """Entry point of the `weldcal` console script."""
    answer_signals()
    from weldcal.tools.cli.app import main as run

    try:
        run()
    finally:
        ignore_signals()


if __name__ == "__main__":
    main()
