"""Drake LeafSystems around calibration and welding, the station and the cell Diagram."""
