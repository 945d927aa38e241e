"""`python -m weldcal.tools.emulators.ur`: the emulator without the rest of the command line."""

from weldcal.tools.emulators.ur.main import main

main()
