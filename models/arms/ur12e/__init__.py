"""Numbers of the UR12e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
