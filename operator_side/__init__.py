"""What an operator uses: a client of robots, teleop, calibration, recording, pages, and the command line."""
