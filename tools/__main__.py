"""`python -m weldcal.tools` is `weldcal`."""

from __future__ import annotations

from weldcal.tools.cli.app import main

main()
