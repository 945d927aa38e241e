"""Numbers of the UR30 as data files; read by `weldcal.models.arms.kinematics.load_arm`."""
