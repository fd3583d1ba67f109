"""Tools of the operator: a client of robots, teleop, calibration, recording, pages, and the command line.

May import: `protocol`, `robot_side`, `vision_side`, `sim`; `cli/` may import everything.
Interface: `client` for programs; `sightline COMMAND` on the command line.
"""
