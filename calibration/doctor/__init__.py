"""Why a calibration is wrong: each possible cause is a model of the residuals, and one criterion compares them."""
