"""Device drivers, one folder per backend; only they distinguish real from simulated devices."""
