"""The safety gate: the only path from a command to the wheels."""
