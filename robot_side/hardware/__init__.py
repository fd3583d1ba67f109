"""Robot hardware behind the ports of `sightline.robot_side.ports`."""
