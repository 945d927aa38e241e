"""Measures a welding tool on the flange: nozzle, ball and ring in scans, the wire's end by touch."""
