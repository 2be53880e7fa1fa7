"""Arms: their kinematics, and whether one can carry the hand along a primitive."""
