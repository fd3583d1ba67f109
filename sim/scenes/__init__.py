"""Labeled scenes to train and evaluate detectors on.

May import: `protocol`, `sim`.
Interface: `model` draws a scene from a seed, `render` makes its image and boxes.
"""
