"""Runs and pictures on disk: recorded, replayed, filmed."""
