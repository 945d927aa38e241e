"""Registration of any part to a scan by its surface, and its joint measured along the drawn seam."""
