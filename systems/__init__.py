"""Thin Drake LeafSystems over calibration and welding, the station and the cell Diagram."""
