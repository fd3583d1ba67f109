"""The architecture as a test: who may import whom, which files are pure, how long things may be."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PACKAGES = ("protocol", "robot_side", "vision_side", "sim", "operator_side", "benchmarks")
MAY_IMPORT = {
    "protocol": set(),
    "robot_side": {"protocol"},
    "vision_side": {"protocol"},
    "sim": {"protocol", "robot_side"},
    "operator_side": set(PACKAGES),
    "benchmarks": set(PACKAGES) - {"operator_side"},
}
SHELL_MODULES = {
    "time",
    "threading",
    "asyncio",
    "socket",
    "select",
    "subprocess",
    "logging",
    "random",
    "zenoh",
    "websockets",
}
TRANSPORT_MODULES = {"zenoh", "websockets"}
HEAVY_MODULES = {"numpy", "cv2", "pybullet", "simplejpeg", "matplotlib", "av", "mcap"}
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
IDS = [str(path.relative_to(ROOT)) for path in FILES]


def imported_modules(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module or ""


def on_import(body):
    """The statements that run when a module is imported: not those inside functions."""
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            for part in ("body", "orelse", "finalbody", "handlers"):
                yield from on_import(getattr(node, part, []))


def roots_on_import(path):
    statements = on_import(ast.parse(path.read_text()).body)
    imports = [node for node in statements if isinstance(node, ast.Import | ast.ImportFrom)]
    return {module.split(".")[0] for module in imported_modules(ast.Module(imports, []))}


def roots(path):
    return {module.split(".")[0] for module in imported_modules(ast.parse(path.read_text()))}


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_imports_follow_the_rule(path):
    package = path.relative_to(ROOT).parts[0]
    ours = roots(path) & set(PACKAGES) - {package}
    assert ours <= MAY_IMPORT[package]
    if path.parent.name not in ("transports", "peers"):  # benchmarks/peers builds what others would build
        assert not roots(path) & TRANSPORT_MODULES


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_every_file_says_what_it_is_and_pure_files_are_pure(path):
    tree = ast.parse(path.read_text())
    docstring = ast.get_docstring(tree)
    assert docstring, "no docstring"
    if path.name == "__init__.py":
        return
    head = docstring.split("\n\n")[0]
    assert ("Pure" in head) != ("Shell" in head), "the first paragraph says Pure or Shell"
    if "Pure" in head:
        assert not roots(path) & SHELL_MODULES - {"random"}
        for node in ast.walk(tree):  # `Random(seed)` is a function of its seed; the module's own functions are not
            if isinstance(node, ast.Import):
                assert "random" not in {alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom) and node.module == "random":
                assert {alias.name for alias in node.names} == {"Random"}


@pytest.mark.parametrize(
    "path", [path for path in FILES if path.parts[-2] in ("robot_side", "hardware") or path.name == "bus.py"], ids=str
)
def test_the_robot_needs_no_heavy_package(path):
    # A camera plug-in may import OpenCV when it is opened: only who chose that camera needs it installed.
    found = roots_on_import(path) if path.parent.name == "hardware" else roots(path)
    assert not found & HEAVY_MODULES


@pytest.mark.parametrize("path", FILES, ids=IDS)
def test_files_and_functions_stay_small(path):
    source = path.read_text()
    assert source.count("\n") <= 300
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno + 1 <= 60, node.name


def test_top_level_is_what_was_agreed():
    assert all(
        (ROOT / name).exists() for name in ("pyproject.toml", "robot_side", "vision_side", "protocol", "sim", "tests")
    )
