"""The physical world of a cell as a process: arm, workpiece and contact behind the wires of real devices."""
