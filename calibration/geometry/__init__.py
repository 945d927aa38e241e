"""SE(3), rigid registration, and robust circle and plane fits."""
