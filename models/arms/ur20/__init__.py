"""Numbers of the UR20 as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
