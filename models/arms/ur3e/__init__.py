"""Numbers of the UR3e as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
