"""Modules of training."""
