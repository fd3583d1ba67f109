"""The fault bench: real processes, injected faults, evaluated from the log of the simulated motors.

May import: the four sides, `operator_side`, `evaluation`.
Interface: `runner` runs the rows of `cases`; `report` writes them.
"""
