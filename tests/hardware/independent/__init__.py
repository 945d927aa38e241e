"""A minimal UR controller, written from Universal Robots' public documents only.

It shares no code with the product or its emulator.
"""
