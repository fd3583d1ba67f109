"""Control laws of older systems, only for comparison."""
