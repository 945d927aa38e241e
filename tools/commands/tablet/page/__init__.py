"""The page that turns a tablet into the calibration target, and the small server that hands it out."""
