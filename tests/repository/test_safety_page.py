"""The page of safety limits takes its tables from the code. `python -m tests.repository.test_safety_page` writes it."""

import json
import re
from pathlib import Path

from sightline.protocol.messages import State
from sightline.protocol.spec.generate import unit_of
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.safety.states import TRANSITIONS, Event

DOCS = Path(__file__).parent.parent.parent / "docs"
PAGE = DOCS / "reference" / "safety-limits.md"
MARKS = re.compile(r"(<!-- generated: (\w+)[^\n]*-->\n).*?(<!-- /generated -->)", re.DOTALL)
BOUNDS = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to"}


def states() -> str:
    """One row per state, one column per event."""
    head = "| | " + " | ".join(event.value for event in Event) + " |"
    rows = [
        f"| **{state}** | " + " | ".join(str(TRANSITIONS.get((state, event), "")) for event in Event) + " |"
        for state in State
    ]
    return "\n".join([head, "|---" * (len(Event) + 1) + "|", *rows]) + "\n"


def limits() -> str:
    """One row per number that limits the robot, with its default, bounds, unit and reason."""
    rows = ["| key | default | allowed | unit | meaning |", "|---" * 5 + "|"]
    for table in ("safety", "guard"):
        model = RobotConfig.model_fields[table].default
        for field, schema in type(model).model_json_schema()["properties"].items():
            allowed = " ".join(f"{word} {schema[bound]:g}" for bound, word in BOUNDS.items() if bound in schema)
            default = json.dumps(schema["default"])
            meaning = schema.get("description", "")
            assert meaning, f"{table}.{field} has no description in its Field"
            rows.append(f"| `{table}.{field}` | {default} | {allowed} | {unit_of(field)} | {meaning} |")
    return "\n".join(rows) + "\n"


def page_with_tables(text: str) -> str:
    """The page with the tables of now."""
    tables = {"states": states, "limits": limits}
    return MARKS.sub(lambda marks: marks[1] + tables[marks[2]]() + marks[3], text)


def test_the_page_shows_the_tables_of_the_code():
    text = PAGE.read_text()
    assert [marks[2] for marks in MARKS.finditer(text)] == ["limits", "states"]
    assert page_with_tables(text) == text


def test_the_safety_page_states_the_default_numbers():
    text, config = (DOCS / "explanation" / "safety.md").read_text(), RobotConfig().safety
    for number in (config.full_speed_age_ms, config.zero_speed_age_ms, config.silence_ms):
        assert f"{number} ms" in text


if __name__ == "__main__":
    PAGE.write_text(page_with_tables(PAGE.read_text()))
