"""Mutants of peers: each has one small fault, and the cases of the kit that must catch it.

`*.toml` hold the table: a name, a fault, an operator with its parameters, and `caught_by`. `python -m
tests.conformance.mutants` runs it; `test_mutants.py` runs each mutant against its cases (`make test`) and against all
cases (`make test-long`). Each case needs a mutant that it catches.
"""
