"""Modules of operator_side.recording."""
