"""Camera and drive plug-ins behind the ports of `sightline.robot_side.ports`."""
