"""The architecture as tests: what may import what, what is pure, how large things may be, and that no text is stale."""

import ast
import gc
import re
from collections import defaultdict
from functools import cache
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PACKAGES = (
    "protocol", "robot_side", "vision_side", "sim", "conformance", "operator_side", "evaluation", "training",
    "benchmarks",
)
SIDES = {"protocol", "robot_side", "vision_side", "sim"}
MAY_IMPORT = {
    "protocol": set(),
    "robot_side": {"protocol"},
    "vision_side": {"protocol"},
    "conformance": {"protocol"},
    "sim": {"protocol", "robot_side"},
    "operator_side": SIDES,
    "evaluation": SIDES | {"operator_side"},
    "training": {"protocol", "sim", "vision_side", "evaluation"},
    "benchmarks": SIDES | {"evaluation", "operator_side.client"},
    "operator_side.cli": set(PACKAGES),
}
TRANSPORT_FOLDERS = {  # and the peers of the benchmark, which build what other projects would build
    "zenoh": ("protocol/transports/zenoh", "benchmarks/peers"),
    "websockets": ("protocol/transports/websocket", "benchmarks/peers"),
}
SHELL_MODULES = {
    "asyncio", "logging", "select", "signal", "socket", "subprocess", "threading", "time", "websockets", "zenoh",
}
HEAVY_MODULES = {"av", "cv2", "matplotlib", "mcap", "numpy", "pybullet", "simplejpeg"}
PURE = (
    "robot_side/kinematics.py",
    "robot_side/safety/*.py",
    "robot_side/driver/core.py", "robot_side/guardian/core.py",
    "robot_side/network/core.py",
    "robot_side/network/stream.py",
    "robot_side/network/congestion_window.py",
    "robot_side/network/bitrate_control.py",
    "vision_side/pipeline.py",
    "vision_side/serving/assignment.py",
    "vision_side/serving/detector_queue.py",
    "vision_side/serving/detector_sharing.py",
    "vision_side/serving/sharing.py",
    "vision_side/tracking/*.py",
    "vision_side/missions/*.py",
    "vision_side/detect/port.py",
    "vision_side/detect/color/*.py",
    "operator_side/recording/foxglove.py",
    "protocol/*.py",
    "protocol/spec/*.py",
    "protocol/transports/websocket/framing.py",
    "protocol/transports/websocket/legacy.py",
)
NOT_PURE = {  # in spite of PURE: clocks, files, plug-ins
    "protocol/clock.py", "protocol/log.py", "protocol/config.py", "protocol/spec/generate.py",
    "vision_side/missions/registry.py", "vision_side/detect/color/detectors.py",
}
MAX_ENTRIES = 12
MAX_FILE_LINES = 700  # without docstrings
MAX_FUNCTION_LINES = 60
SMALL_FILE_LINES = 120
SMALL_FILES = {  # with one importer, in their own folder: the reason why each is a file of its own
    "benchmarks/network/stop_client.py": "a process of its own: python -m",
    "benchmarks/network/watch.py": "a process of its own: python -m",
    "benchmarks/peers/classic_detector.py": "what a rival would write, kept apart from what all are given",
    "evaluation/demo/relay.py": "a process of its own: python -m",
    "robot_side/hardware/gpio_low.py": "all that the guardian imports of the drive gpio; also a process of its own",
    "robot_side/guardian/stop_receiver.py": "a process of its own",
    "robot_side/hardware/log_zero.py": "all that the guardian imports of the drive log",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("sightline", *(parts[:-1] if parts[-1] == "__init__" else parts)))


LEAVES = (ast.Name, ast.Constant, ast.expr_context, ast.operator, ast.cmpop, ast.unaryop, ast.boolop)
DEFINITIONS = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, *DEFINITIONS)
WANTED = (*DOCUMENTED, ast.Import, ast.ImportFrom, ast.Name, ast.Attribute, ast.Call)
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MODULES = {module_name(path): path for path in FILES}


def none_of(wrong) -> None:
    lines = sorted(wrong)
    assert not lines, "\n" + "\n".join(lines)


def shown(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def source(path: Path) -> str:
    return path.read_text()


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(source(path))


@cache
def by_kind(path: Path) -> dict[type, list]:
    """Return what the tests look at. `ast.walk` takes three times as long, most of it for names and constants."""
    gc.disable()  # which would look through all earlier trees again and again
    found, waiting = {kind: [] for kind in WANTED}, [tree(path)]
    while waiting:
        node = waiting.pop()
        if type(node) in found:
            found[type(node)].append(node)
        for part in () if isinstance(node, LEAVES) else node.__dict__.values():
            if isinstance(part, list):
                waiting += [one for one in part if isinstance(one, ast.AST)]
            elif isinstance(part, ast.AST):
                waiting.append(part)
    gc.enable()
    return found


def nodes(path: Path, *kinds: type):
    return chain.from_iterable(by_kind(path)[kind] for kind in kinds)


def imported(statements) -> set[str]:
    """Whole names of what `statements` import: a module, or a name of one."""
    found = set()
    for node in statements:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@cache
def imports(path: Path) -> set[str]:
    return imported(nodes(path, ast.Import, ast.ImportFrom))


@cache
def our_modules(path: Path) -> set[str]:
    """Modules of ours that a file imports, at any depth, functions included."""
    names = (name if name in MODULES else name.rpartition(".")[0] for name in imports(path))
    return {name for name in names if name in MODULES} - {module_name(path)}


def on_import(body):
    """The statements that run when a module is imported: not those inside functions."""
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            for part in ("body", "orelse", "finalbody", "handlers"):
                yield from on_import(getattr(node, part, []))


def is_pure(path: Path) -> bool:
    return shown(path) not in NOT_PURE and any(path.relative_to(ROOT).match(pattern) for pattern in PURE)


def test_packages_import_what_the_table_permits():
    wrong = []
    for path in FILES:
        own = path.relative_to(ROOT).parts[0]
        part = "operator_side.cli" if path.is_relative_to(ROOT / "operator_side/cli") else own
        for name in our_modules(path):
            other = name.removeprefix("sightline.")
            folders = {".".join(other.split(".")[:depth]) for depth in (1, 2)}
            if not folders & (MAY_IMPORT[part] | {own}) or ("operator_side.cli" in folders and "." not in part):
                wrong.append(f"{shown(path)} imports {name}")
    none_of(wrong)


def test_transport_libraries_are_imported_in_their_folder_only():
    wrong = [
        f"{shown(path)} imports {library}"
        for path in FILES for library, folders in TRANSPORT_FOLDERS.items()
        if library in {name.split(".")[0] for name in imports(path)} and not shown(path).startswith(folders)
    ]
    none_of(wrong)


def test_no_import_cycle():
    waiting = {name: our_modules(path) for name, path in MODULES.items()}
    while free := [name for name, needed in waiting.items() if not needed & waiting.keys()]:
        for name in free:
            del waiting[name]
    none_of(f"{name} is in a cycle, or imports one" for name in waiting)


@cache
def own_names(path: Path) -> set[str]:
    """Every name that a file defines, as a function, class, variable or attribute of `self`."""
    defined = {node.name for node in nodes(path, *DEFINITIONS)} | {node.id for node in nodes(path, ast.Name)}
    return defined | {node.attr for node in nodes(path, ast.Attribute)
                      if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")}


def test_no_private_name_crosses_a_file():
    library = {"_asdict", "_replace", "_exit", "_current_frames"}  # public in spite of their names: namedtuple, os, sys
    wrong = []
    for path in FILES:
        wrong += [f"{shown(path)} imports {name}" for name in imports(path)
                  if name.startswith("sightline.") and re.match(r"_[a-z]", name.rpartition(".")[2])]
        known = own_names(path) | library
        wrong += [f"{shown(path)}:{node.lineno} {ast.unparse(node)}" for node in nodes(path, ast.Attribute)
                  if re.match(r"_[a-z]", node.attr) and node.attr not in known]
    none_of(wrong)


def test_every_file_states_its_kind_and_pure_files_are_pure():
    wrong = []
    for path in FILES:
        head = (ast.get_docstring(tree(path)) or "").split("\n\n")[0]
        if not head or (path.name != "__init__.py" and ("Pure" in head) == ("Shell" in head)):
            wrong.append(f"{shown(path)}: the first paragraph must contain Pure or Shell")
        if is_pure(path) and path.name != "__init__.py" and "Pure" not in head:
            wrong.append(f"{shown(path)}: is listed as pure, but its first paragraph lacks Pure")
        if "Pure" in head:
            names = imports(path)
            wrong += [f"{shown(path)}: is pure, but imports {name}" for name in names
                      if name.split(".")[0] in SHELL_MODULES or (name.startswith("random") and name != "random.Random")]
    none_of(wrong)


def test_the_robot_needs_no_heavy_package():
    """A camera plug-in may import OpenCV when it is opened, since its owner chose it; nothing else on the robot may."""
    wrong = []
    for path in (path for path in FILES if path.is_relative_to(ROOT / "robot_side") or shown(path) == "sim/bus.py"):
        in_hardware = path.is_relative_to(ROOT / "robot_side/hardware")
        statements = on_import(tree(path).body) if in_hardware else nodes(path, ast.Import, ast.ImportFrom)
        heavy = [name for name in imported(statements) if name.split(".")[0] in HEAVY_MODULES]
        wrong += [f"{shown(path)} imports {name}" for name in heavy]
    none_of(wrong)


def lines_of_docstrings(path: Path) -> int:
    return sum(node.body[0].end_lineno - node.body[0].lineno + 1
               for node in nodes(path, *DOCUMENTED) if ast.get_docstring(node))


def test_files_and_functions_stay_small():
    """Complexity is bounded by ruff's C901."""
    wrong = [shown(path) for path in FILES
             if source(path).count("\n") - lines_of_docstrings(path) > MAX_FILE_LINES]
    for path in FILES:
        wrong += [f"{shown(path)}: {node.name}" for node in nodes(path, ast.FunctionDef, ast.AsyncFunctionDef)
                  if node.end_lineno - node.lineno + 1 > MAX_FUNCTION_LINES]
    none_of(wrong)


def folders() -> dict[Path, set[str]]:
    """Return the entries of each folder: modules, and folders with modules."""
    entries = defaultdict(set)
    for path in FILES:
        entry = path if path.name != "__init__.py" else path.parent
        entries[entry.parent].add(entry.name)
    del entries[ROOT]
    return entries


def test_folders_are_neither_crowded_nor_empty():
    none_of(f"{shown(folder)} has {len(found)} entries" for folder, found in folders().items()
            if not 3 <= len(found) <= MAX_ENTRIES)


def test_every_folder_states_its_purpose_and_its_imports():
    texts_of = {shown(folder): ast.get_docstring(tree(folder / "__init__.py")) or "" for folder in folders()}
    none_of(folder for folder, text in texts_of.items() if "May import: " not in text or "Interface: " not in text)


def test_a_small_file_with_one_importer_in_its_folder_has_a_reason():
    importers = defaultdict(set)
    for path in FILES:
        for name in our_modules(path):
            importers[MODULES[name]].add(path)
    small = {
        shown(path) for path, by in importers.items()
        if path.name != "__init__.py" and source(path).count("\n") < SMALL_FILE_LINES
        and len(by) == 1 and next(iter(by)).parent == path.parent
    }
    assert small == SMALL_FILES.keys()
    assert len(SMALL_FILES) <= 10


def test_no_two_public_classes_share_a_name():
    places = defaultdict(list)
    for path in FILES:
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(shown(path))
    none_of(f"{name}: {', '.join(paths)}" for name, paths in places.items() if len(paths) > 1)


def test_every_thread_has_a_name():
    wrong = [f"{shown(path)}:{node.lineno}" for path in FILES for node in nodes(path, ast.Call)
             if getattr(node.func, "attr", getattr(node.func, "id", "")) == "Thread"
             and "name" not in {keyword.arg for keyword in node.keywords}]
    none_of(wrong)


def test_no_test_that_runs_at_low_priority_knows_a_clock():
    mark = "pytestmark = pytest.mark.computes\n"
    marked = [path for path in (ROOT / "tests").rglob("test_*.py") if mark in source(path)]
    clocks = SHELL_MODULES - {"logging", "subprocess"}
    assert len(marked) > 20
    none_of(f"{path.relative_to(ROOT)} imports {name}" for path in marked
            for name in {alias.name for node in nodes(path, ast.Import) for alias in node.names}
            | {node.module for node in nodes(path, ast.ImportFrom)}
            if name and (name.partition(".")[0] in clocks or name == "tests.fixtures.robot_process"))


# --- nothing stale -------------------------------------------------------------------------------------------------

PAGES = sorted(chain((ROOT / "docs").rglob("*.md"), ROOT.glob("*.md"), (ROOT / "examples").rglob("*.md"),
                     (ROOT / "protocol").rglob("*.md")))
_CODE = re.compile(r"`([^`\n]+)`")
_PATH = re.compile(rf"(?<![\w./-])(?:{'|'.join(PACKAGES)}|tests|docs|examples)(?:/[\w.-]+)+(?![\w<*])")
_DOTTED = re.compile(rf"sightline\.(?:{'|'.join(PACKAGES)})(?:\.\w+)*")
_CAMEL_CASE = re.compile(r"\b[A-Z][a-z0-9]+(?:[A-Z][a-z0-9]*)+\b(?!\.\w+\()")
FOREIGN_CLASSES = {
    "MyClass", "NaN", "VideoCapture", "CameraCalibration", "CompressedImage", "FrameTransform", "LaserScan",
}


def texts():
    """Every page, docstring and comment: where it stands, and its text without what a code block shows."""
    for path in PAGES:
        yield shown(path), re.sub(r"^```.*?^```", "", source(path), flags=re.S | re.M)
    for path in FILES:
        for node in nodes(path, *DOCUMENTED):
            if text := ast.get_docstring(node):
                yield shown(path), text
        yield shown(path), "\n".join(re.findall(r"(?<!['\"])# .*", source(path)))


def exists(dotted: str) -> bool:
    """Return whether a dotted name below `sightline` is a module, or names something in a module."""
    head, _, last = dotted.rpartition(".")
    return dotted in MODULES or (head in MODULES and last in own_names(MODULES[head]))


def test_no_text_names_a_file_or_module_that_is_gone():
    wrong = []
    for where, text in texts():
        for code in _CODE.findall(text):
            wrong += [f"{where}: {path}" for path in _PATH.findall(code) if not (ROOT / path.rstrip("./")).exists()]
            wrong += [f"{where}: {name}" for name in _DOTTED.findall(code) if not exists(name)]
    none_of(wrong)


def test_no_text_names_a_class_that_is_gone():
    def names_of(path):
        return own_names(path) | {name.rpartition(".")[2] for name in imports(path)}

    known = FOREIGN_CLASSES.union(*map(names_of, FILES))
    named = {(name, where) for where, text in texts() for code in _CODE.findall(text)
             for name in _CAMEL_CASE.findall(code) if name not in known}
    for path in chain((ROOT / "examples").rglob("*.py"), (ROOT / "tests").rglob("*.py")):
        if any(name in source(path) for name, _ in named):  # few of them are parsed
            known |= names_of(path)
    none_of(f"{where}: {name}" for name, where in named if name not in known)


def test_top_level_has_the_agreed_entries():
    agreed = ("pyproject.toml", "robot_side", "vision_side", "protocol", "sim", "tests", "compose.yaml")
    assert all((ROOT / name).exists() for name in agreed)
