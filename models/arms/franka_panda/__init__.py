"""Numbers of the Franka Emika Panda as data files; read by `weldcal.models.arms.chain.load_chain`."""
