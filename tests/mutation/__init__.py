"""Tests of the tests: judged files are changed in one small way each, and the boundary tables must notice it. Shell.

python -m tests.mutation           coverage, then every mutant; exits 5 if one survives unexplained
python -m tests.mutation --list    what would be changed, without running anything
"""
