"""Numbers of the UR7e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
