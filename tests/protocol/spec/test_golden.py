"""Golden vectors and the specification: the files on disk match the behavior and the output of the code."""

import json
import re
import shutil
from collections import Counter
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from sightline.protocol.channels import CHANNELS
from sightline.protocol.errors import RejectReason
from sightline.protocol.spec import generate as schema
from sightline.protocol.spec import golden
from sightline.protocol.spec.framing_cases import FRAMING_CASES, READERS, framing_outcome
from sightline.protocol.spec.message_cases import CASES, MessageCase
from sightline.protocol.text import MAX_TWIST_BYTES

pytestmark = pytest.mark.computes

VECTORS = Path(schema.__file__).parent.parent / "vectors"
README = (Path(schema.__file__).parent.parent / "README.md").read_text("utf-8")


@pytest.mark.parametrize("path", sorted(VECTORS.rglob("*.json")), ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_vector_gives_its_stated_result(path):
    """From the file alone, as a peer in another language would run it."""
    vector = json.loads(path.read_text("utf-8"))
    expected = {name: vector.pop(name) for name in ("accept", "refuse") if name in vector}
    if "key" in vector:
        header, payload = (bytes.fromhex(vector[part]) for part in ("header_hex", "payload_hex"))
        got = golden.outcome(vector["key"], header, payload)
    else:
        del vector["purpose"]
        got = framing_outcome(path.parent.name, vector)
    assert json.loads(json.dumps(got)) == expected


def test_generated_files_are_up_to_date():
    assert schema.differing() == []


def test_every_channel_has_vectors_that_are_accepted_and_rejected():
    outcomes = Counter((case.channel, case.refuse is None) for case in CASES)
    assert set(outcomes) == {(channel, accepted) for channel in CHANNELS for accepted in (True, False)}
    assert len(CASES) == len({(case.channel, case.name) for case in CASES})


def test_every_transport_and_protocol_has_vectors_that_are_accepted_and_rejected():
    outcomes = {(case.folder, case.refuse is None) for case in FRAMING_CASES}
    assert outcomes == {(folder, accepted) for folder in READERS for accepted in (True, False)}
    assert not set(READERS) & set(CHANNELS)
    assert len(golden.files()) == len(CASES) + len(FRAMING_CASES) >= 200


def test_case_that_contradicts_the_decoders_raises():
    good = CASES[0]
    with pytest.raises(ValueError, match="stated MALFORMED"):
        golden.vector(MessageCase(good.channel, good.name, "", good.key, good.header, good.payload, "MALFORMED"))


def test_verify_finds_what_was_changed_and_write_restores_it(tmp_path, monkeypatch, capsys):
    package = tmp_path / "protocol"
    shutil.copytree(VECTORS, package / "vectors")
    for name in ("README.md", "schema.json", "asyncapi.json"):
        shutil.copy(VECTORS.parent / name, package)
    monkeypatch.setattr(schema, "HERE", package)
    assert schema.main(["--verify"]) == 0
    (package / "vectors/twist/usual.json").write_text("{}")
    (package / "vectors/twist/left_over.json").write_text("{}")
    (package / "README.md").write_text(README.replace("| 10 Hz |", "| 11 Hz |"), "utf-8")
    assert schema.main(["--verify"]) == 5
    named = capsys.readouterr().err
    assert all(part in named for part in ("README.md", "usual.json", "left_over.json"))
    assert schema.main(["--write"]) == 0
    assert schema.main(["--verify"]) == 0


def test_the_specification_holds_every_generated_table_once():
    assert re.findall(r"<!-- generated: (\w+) -->", README) == list(schema.GENERATED)
    for name, text in schema.GENERATED.items():
        assert f"<!-- generated: {name} -->\n{text()}<!-- /generated -->" in README


def test_the_specification_names_every_rejection_and_bound():
    assert all(f"`{reason}`" in README for reason in RejectReason)
    assert f"{MAX_TWIST_BYTES} bytes" in README


def test_every_field_has_a_meaning_and_its_unit():
    models = schema.json_schema()["$defs"].items()
    fields = [(name, *field) for name, model in models for field in model.get("properties", {}).items()]
    assert len(fields) > 80
    missing = [f"{name}.{field}" for name, field, definition in fields if not definition.get("description")]
    assert missing == [], "add Field(description=...) in protocol/messages.py"
    units = [schema.unit_of(field) for field in ("t_us", "angular_rad_s", "pitch_rad", "x_m")]
    assert units == ["µs", "rad/s", "rad", "m"]
    assert schema.unit_of("seq") == schema.unit_of("session") == ""


def test_schema_and_field_table_bound_the_names_of_mission_options():
    """The vector `mission/option_name_upper` rejects another name."""
    options = schema.json_schema()["$defs"]["MissionRequest"]["properties"]["options"]
    (pattern,) = options["patternProperties"]
    assert options["additionalProperties"] is False and not re.match(pattern, "A")
    assert f"names `{pattern}`" in schema.field_tables()
    clause = README.partition("**18.1")[2].partition("**18.2")[0]
    assert f"`{pattern}`" in clause


def test_every_clause_has_its_number_once():
    headings = re.findall(r"^## (\d+)\. ", README, re.MULTILINE)
    clauses = re.findall(r"\*\*(\d+\.\d+)\b", README)
    assert headings == [str(number) for number in range(1, len(headings) + 1)]
    assert len(clauses) == len(set(clauses)) > 60
    assert {clause.partition(".")[0] for clause in clauses} <= set(headings)


def test_the_json_schema_accepts_what_the_models_accept():
    definitions = schema.json_schema()["$defs"]
    for channel in CHANNELS.values():
        for model in filter(None, (channel.header, channel.payload)):
            assert definitions[model.__name__]["type"] == "object"
            assert set(definitions[model.__name__]["properties"]) == set(TypeAdapter(model).json_schema()["properties"])
