"""`python -m weldcal.tools` is `weldcal`: signals are answered before the imports, which take seconds."""

import os

from weldcal.systems.interrupts import answer_signals, ignore_signals


def main() -> None:
    """Entry point of the `weldcal` console script."""
    answer_signals()
    # A signal in Python's logging below Drake's would be lost: C++ takes the exception (Drake, use_native_cpp_logging).
    os.environ.setdefault("DRAKE_PYTHON_LOGGING", "0")
    from weldcal.tools.cli.app import main as run

    try:
        run()
    finally:
        ignore_signals()


if __name__ == "__main__":
    main()
