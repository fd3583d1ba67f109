"""The changes that the mutation gate makes to a line; each has one name and compiles."""

import subprocess
import sys
from pathlib import Path

import pytest

import tests.mutation.__main__ as gate
from tests.mutation.forks import _changed
from tests.mutation.mutants import mutants
from tests.mutation.trial import Outcome


def changes(source):
    return {(mutant.before, mutant.after) for mutant in mutants("example.py", source)}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a < b", {("a < b", "a <= b"), ("a < b", "a >= b")}),
        ("a == b", {("a == b", "a != b")}),
        ("a and b", {("a and b", "a or b"), ("a and b", "a"), ("a and b", "b")}),
        ("not a", {("not a", "a")}),
        ("-a", {("-a", "a")}),
        ("a + b", {("a + b", "a - b")}),
        ("a * b", {("a * b", "a / b")}),
        ("a += b", {("a += b", "a -= b"), ("a += b", "a = b")}),
        ("f(7)", {("7", "6"), ("7", "8")}),
        ("f(2.0)", {("2.0", "1.98"), ("2.0", "2.02")}),
        ("f(0.0)", {("0.0", "-0.01"), ("0.0", "0.01")}),
        ("f(True)", {("True", "False")}),
        ("f('frame')", {("'frame'", "'framex'")}),
        ("f('a sentence for people')", set()),
        ("f(b'a?')", {("b'a?'", "b'a'"), ("b'a?'", "b'?'")}),
        ("f(b'3')", {("b'3'", "b''"), ("b'3'", "b'2'"), ("b'3'", "b'4'")}),
        ("min(a, b)", {("min(a, b)", "max(a, b)")}),
        ("math.sin(a)", {("math.sin(a)", "math.cos(a)")}),
        ("abs(a)", {("abs(a)", "a")}),
        ("Field(gt=a)", {("Field(gt=a)", "Field(ge=a)")}),
        ("while a:\n    b()", {("while a:\n    b()", "while not a:\n    b()")}),
        ("if TYPE_CHECKING:\n    import a", set()),
        ("a if b else c", {("a if b else c", "a"), ("a if b else c", "c")}),
        ("Verb.RELEASE", {("Verb.RELEASE", "Verb.ARM")}),
        ("[a for a in b if a]", {("for a in b if a", "for a in b")}),
    ],
)
def test_node_has_the_changes_of_its_kind(source, expected):
    stripped = {(before.strip(), after.strip()) for before, after in changes(source)}
    assert stripped == expected


def test_statements_inside_functions_only_are_removed_and_returns_emptied():
    got = changes('"""Text."""\na = b\ndef f():\n    """Text."""\n    a = b\n    raise a\n    return b')
    assert got == {("a = b", "pass"), ("raise a", "pass"), ("return b", "return None"), ("return b", "pass")}


def test_equal_changes_in_one_place_are_numbered():
    names = [mutant.name for mutant in mutants("example.py", "def f(a):\n    return a(1, 1)")]
    assert len(names) == len(set(names)) and {name[-1] for name in names if name[2] == "1"} == {1, 2}


def test_where_is_the_qualified_name():
    (mutant,) = mutants("example.py", "class A:\n    def f(self):\n        assert not a\n")
    assert (mutant.where, mutant.line, mutant.file) == ("A.f", 3, "example.py")


def test_gate_imports_no_file_with_mutants():
    """If it did, every mutant of that file would count as killed and none would run."""
    code = """
import sys
from pathlib import Path
import tests.mutation.__main__ as gate
from tests.mutation.trial import module_name
print([file for file in gate.TABLES if module_name(file) in sys.modules])
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def test_mutant_of_an_imported_module_is_rejected():
    code = """
import sightline.protocol.jpeg
from pathlib import Path
import tests.mutation.__main__ as gate
from tests.mutation.forks import _changed
from tests.mutation.mutants import mutants
from tests.mutation.forks import try_mutants
found = list(mutants("protocol/jpeg.py", Path("protocol/jpeg.py").read_text()))
try_mutants(found, (), ["tests/protocol/test_text_and_jpeg_boundaries.py"], 2)
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 1 and "imported before its mutants" in ran.stderr


def test_in_place_only_the_code_of_one_function_is_exchanged():
    source = "A = 1\nclass B:\n    c = 2\n    def d(self, e=3):\n        return lambda: -f(4)\ndef g():\n    return 5\n"
    original = compile(source, "example.py", "exec")
    places = {mutant.before: _changed(original, mutant.code) for mutant in mutants("example.py", source)}
    names = {before: change and change[0].co_name for before, change in places.items()}
    assert names.pop("return lambda: -f(4)") == "d"
    assert names == {"1": None, "2": None, "3": None, "-f(4)": "d", "4": "d", "return 5": "g", "5": "g"}


def test_mutants_end_as_in_a_process_of_their_own_where_the_tests_are_collected_already():
    """The expected equivalents are tried there alone."""
    code = """
from pathlib import Path
from tests.mutation.__main__ import TABLES
from tests.mutation.forks import try_mutants
from tests.mutation.mutants import mutants
from tests.mutation.trial import Outcome
file = "vision_side/serving/assignment.py"
found, tables = list(mutants(file, Path(file).read_text()))[::9], TABLES[file]
ends = try_mutants(found, (), tables, 2)
assert ends == try_mutants(found, {one.name for one in found}, tables, 2)
assert list(ends) == found and Outcome.KILLED in ends.values(), ends
of_one = [*tables, "-k", "test_without_robots"]
assert list(try_mutants(found, (), of_one, 2).values()).count(Outcome.SURVIVED) > 3
try_mutants(found, (), ["tests/no_such_test.py"], 2)
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "fail, or need more than 5 s of CPU: tests/no_such_test.py\n" in ran.stderr, ran.stderr


@pytest.mark.parametrize(("test", "is_tried"), [("pass", True), ("assert False", False), ("while True: pass", False)])
def test_tests_that_fail_or_take_long_try_no_mutant(tmp_path, test, is_tried):
    """Before, each mutant then counted as killed by the time limit."""
    head = "from sightline.vision_side.serving import assignment\ndef test_it():\n    "
    (tmp_path / "test_it.py").write_text(head + test)
    code = """
import sys
from pathlib import Path
from tests.mutation import forks
from tests.mutation.mutants import mutants
forks.CPU_SECONDS = 4
file = "vision_side/serving/assignment.py"
found = list(mutants(file, Path(file).read_text()))[:1]
print(*(end.value for end in forks.try_mutants(found, (), [sys.argv[1]], 1).values()))
"""
    command = [sys.executable, "-c", code, tmp_path / "test_it.py"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.stdout == "survived\n") is is_tried
    assert ("RuntimeError: the tests did not start, fail, or need more than 1 s of CPU" in ran.stderr) is not is_tried


def test_part_of_a_file_has_the_mutants_of_its_names_and_constants_only(tmp_path, monkeypatch):
    file = tmp_path / "example.py"
    file.write_text("_RAMP_US = 1\nOTHER = 2\ndef f():\n    return 3\nclass A:\n    def g(self):\n        return 4\n")
    before = {mutant.before for mutant in gate._mutants(str(file))}
    assert {"1", "2", "3", "4"} < before
    monkeypatch.setattr(gate, "PARTS", {str(file): ("_RAMP_", "A")})
    assert {mutant.before for mutant in gate._mutants(str(file))} == {"1", "4", "return 4"}


@pytest.mark.parametrize(("outcome", "is_named", "exit_code"), [
    (Outcome.KILLED, False, 0), (Outcome.SURVIVED, False, 5), (Outcome.TIMEOUT, False, 0),
    (Outcome.KILLED, True, 5), (Outcome.SURVIVED, True, 0), (Outcome.TIMEOUT, True, 0),
])
def test_named_equivalents_are_those_that_no_table_kills(outcome, is_named, exit_code):
    (mutant,) = mutants("example.py", "assert not a\n")
    assert gate._result({mutant: outcome}, {mutant.name} if is_named else set()) == exit_code


def test_equivalent_of_no_mutant_is_outdated():
    assert gate._result({}, {("example.py", "", "not a", "a", 1)}) == 5


def test_files_of_parts_are_under_the_gate():
    assert set(gate.PARTS) <= set(gate.TABLES)


def test_pure_logic_of_wheels_and_frames_is_under_the_gate():
    folders = ("robot_side/safety", "robot_side/network", "vision_side/tracking")
    pure = {str(path) for folder in folders for path in Path(folder).glob("[!_]*.py")}
    pure -= {"robot_side/network/process.py"}  # a shell
    pure |= {"robot_side/driver/core.py", "robot_side/kinematics.py", "operator_side/client/requests.py"}
    assert len(pure) > 15 and pure <= set(gate.TABLES)
