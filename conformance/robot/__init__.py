"""Cases for robots, by chapter of the specification.

May import: `protocol`, `conformance`.
Interface: `cases` lists them in the order of the report; `fixture` is the peer that they share.
"""
