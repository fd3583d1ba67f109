"""Camera and drive plug-ins behind the ports of `robot_side.ports`."""
