"""Numbers of the UR5 as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
