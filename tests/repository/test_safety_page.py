"""docs/safety.md draws its states from the table in the code. `python -m tests.repository.test_safety_page` writes."""

import re
from pathlib import Path

from sightline.protocol.messages import State
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.states import TRANSITIONS, Event

PAGE = Path(__file__).parent.parent.parent / "docs" / "safety.md"
MARKS = re.compile(r"(<!-- generated from robot_side/safety/states.py[^\n]*-->\n).*?(<!-- /generated -->)", re.DOTALL)


def table() -> str:
    """One row per state, one column per event."""
    head = "| | " + " | ".join(event.value for event in Event) + " |"
    rows = [
        f"| **{state}** | " + " | ".join(str(TRANSITIONS.get((state, event), "")) for event in Event) + " |"
        for state in State
    ]
    return "\n".join([head, "|---" * (len(Event) + 1) + "|", *rows]) + "\n"


def page_with_table(text: str) -> str:
    """The page with the table of now."""
    return MARKS.sub(lambda marks: marks[1] + table() + marks[2], text)


def test_the_page_shows_the_table_of_the_code():
    assert page_with_table(PAGE.read_text()) == PAGE.read_text()


def test_the_page_states_the_default_numbers():
    text, config = PAGE.read_text(), SafetyConfig()
    for number in (config.full_speed_age_ms, config.zero_speed_age_ms, config.silence_ms):
        assert f"{number} ms" in text


if __name__ == "__main__":
    PAGE.write_text(page_with_table(PAGE.read_text()))
