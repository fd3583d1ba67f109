"""A conformance kit for any peer: numbered cases against protocol/README.md.

May import: `protocol`.
Interface: `runner` runs the cases of `robot.cases` or `vision.cases`; `codec` tests any program over a line protocol;
    `report` writes results.
"""
