"""Numbers of the AUBO i5 as data files; read by `weldcal.models.arms.chain.load_chain`."""
