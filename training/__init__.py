"""Trains the detector that ships: scenes, network, loop, export, model card."""
