"""Numbers of the UR10 as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
