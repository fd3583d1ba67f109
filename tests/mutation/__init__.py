"""Tests of the tests: judged files are changed one small way at a time, and the boundary tables must notice each. Shell.

    python -m tests.mutation           coverage, then every mutant; exits 5 when one survives that is not a named equivalent
    python -m tests.mutation --list    what would be changed, without running anything
"""
