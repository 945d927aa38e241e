"""Rigid motions, robust circle and plane fits: the geometry that every calibration rests on."""
