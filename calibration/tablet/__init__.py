"""A tablet as the calibration target: a camera sees its dots, the robot's pen touches them."""
