"""Tests of the tests: each trial changes a file in one small way, and the test tables of that file must fail. Shell.

python -m tests.mutation                   coverage, then every mutant; exits 5 if one survives without a reason
python -m tests.mutation --changed [BASE]  the same for the files that changed since BASE
python -m tests.mutation --list            print the mutants and stop
python -m tests.mutation --planted         plant each bug of planted.toml, which must fail exactly its own test
"""
