"""The torch on a UR controller: its output, the gas valve, and the inputs of the power source."""
