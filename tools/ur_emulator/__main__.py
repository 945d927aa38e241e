"""`python -m weldcal.tools.ur_emulator`: the emulator without the rest of the command line."""

from weldcal.tools.ur_emulator.main import main

main()
