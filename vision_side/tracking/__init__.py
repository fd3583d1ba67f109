"""From detections to twists: locate, track, predict, steer."""
