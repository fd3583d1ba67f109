"""What a label may be: one printable line, so that it can be shown, logged and sent as it is. Pure."""

from typing import Annotated, Final

from pydantic import Field

LONGEST_LABEL: Final = 64
"""As on the wire (`DetectedBox.label`), in characters."""
Label = Annotated[str, Field(min_length=1, max_length=LONGEST_LABEL)]
"""One that is configured."""


COLOR_LABEL: Final = "target"
"""What the colour detectors call what they find, whatever it is. It always counts: one of them may be the fallback."""
_NO_TARGETS: Final = ("legs", "light")
"""What other missions are for; a model that knows balls may know these too."""


def is_followable(label: str, wanted: str) -> bool:
    """Whether what is called `label` is followed: what is `wanted`, if anything is, and what has the target's colour;
    else all but lights and legs."""
    return label in (wanted, COLOR_LABEL) if wanted else not label.startswith(_NO_TARGETS)


def is_label(text: str) -> bool:
    """Whether it can be said as it is."""
    return 0 < len(text) <= LONGEST_LABEL and text.isprintable()


def clean_label(text: str) -> str:
    """`text` as the wire allows it: one printable line, bounded; never empty."""
    return "".join(letter for letter in text if letter.isprintable())[:LONGEST_LABEL] or "thing"
