"""Missions: what to do with what is seen."""
