"""Fixtures of the tests of links."""

import pytest


@pytest.fixture
def keys(tmp_path, request):
    """A folder with the test module's `TOKENS`, one file for each role."""
    for role, token in request.module.TOKENS.items():
        (tmp_path / f"{role}.token").write_text(token + "\n")
    return str(tmp_path)
