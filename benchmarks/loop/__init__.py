"""`sightline bench loop`: capture to the driver's answer, against a floor and other designs.

May import: as `benchmarks`.
Interface: `race` runs the contestants; `figures` has the settings and bounds.
"""
