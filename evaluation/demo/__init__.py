"""One run in real time: simulation, robot and vision service as processes, then scored and filmed.

May import: the four sides, `operator_side`, `evaluation`.
Interface: `run` runs it, `report` scores and films it.
"""
