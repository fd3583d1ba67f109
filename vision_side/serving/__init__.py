"""Services around the pipeline: one robot, a fleet, a detector for others, a dry run.

May import: `protocol`, `vision_side`.
Interface: `process.run` serves until a signal; `service.Service` is one robot's service without a process.
"""
