"""Robot hardware behind the ports of `robot_side.ports`."""
