"""What runs on the strong machine: a frame in, a command out."""
