"""The mathematics of where things are: flange fit, rigid solvers, verification."""
