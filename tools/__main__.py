"""`python -m weldcal.tools` is `weldcal`."""

from weldcal.tools.cli.app import main

main()
