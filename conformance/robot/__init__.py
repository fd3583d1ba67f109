"""Cases for robots, by chapter of the specification."""
