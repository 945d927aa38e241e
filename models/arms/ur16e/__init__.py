"""Numbers of the UR16e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
