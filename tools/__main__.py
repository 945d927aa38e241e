"""`python -m weldcal.tools` is `weldcal`: signals are answered before the imports, which take seconds."""

import gc
import os

from weldcal.systems.interrupts import answer_signals, ignore_signals


def main() -> None:
    """Entry point of the `weldcal` console script."""
    answer_signals()
    gc.set_threshold(5_000)  # most objects stay: a search for garbage at each 700 takes a twentieth of the time
    # The matrices are small: more threads of the linear algebra only wait for each other. Read when NumPy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from weldcal.tools.cli.app import main as run

    try:
        run()
    finally:
        ignore_signals()


if __name__ == "__main__":
    main()
