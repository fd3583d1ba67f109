"""What people touch: the command line, the demo, lockstep, the score. The composition root."""
