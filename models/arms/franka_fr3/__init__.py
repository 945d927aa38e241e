"""Numbers of the Franka Research 3 as data files; read by `weldcal.models.arms.chain.load_chain`."""
