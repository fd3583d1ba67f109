"""Services around the pipeline: one robot, a fleet, a detector for others, a dry run."""
