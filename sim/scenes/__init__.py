"""Labelled scenes to train and evaluate detectors on."""
