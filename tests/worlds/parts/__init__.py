"""Parts as STEP files, cells that weld them, and ray-cast scans of parts and plates."""
