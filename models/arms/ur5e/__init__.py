"""Numbers of the UR5e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
