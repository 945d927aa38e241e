"""Numbers of the UR10e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
