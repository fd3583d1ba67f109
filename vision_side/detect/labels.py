"""What a label may be: one printable line, so that it can be shown, logged and sent as it is. Pure."""

from typing import Annotated, Final

from pydantic import Field

LONGEST_LABEL: Final = 64
"""As on the wire (`DetectedBox.label`), in characters."""
Label = Annotated[str, Field(min_length=1, max_length=LONGEST_LABEL)]
"""One that is configured."""


def is_label(text: str) -> bool:
    """Whether it can be said as it is."""
    return 0 < len(text) <= LONGEST_LABEL and text.isprintable()


def clean_label(text: str) -> str:
    """`text` as the wire allows it: one printable line, bounded; never empty."""
    return "".join(letter for letter in text if letter.isprintable())[:LONGEST_LABEL] or "thing"
