"""`sightline bench network`: robot and vision service in two network namespaces with a shaped wire between.

May import: as `benchmarks`.
Interface: `run` runs the rows of `cases` and `scenes`.
"""
