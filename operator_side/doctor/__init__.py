"""`sightline doctor`: what is wrong on this machine, and between it and a robot, each with the line that mends it."""
