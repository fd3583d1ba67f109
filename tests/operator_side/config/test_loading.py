"""Settings: precedence, origins, and every mistake as one line that names it."""

import re
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from sightline.operator_side.config.errors import is_known, known_keys, table_of
from sightline.operator_side.config.loading import ENV_PREFIX, SERVICES, load, load_service, model_of
from sightline.operator_side.config.toml_text import toml_text
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.hardware.cameras.lens import read_model
from sightline.robot_side.hardware.gpio import GpioDriveConfig
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario

KEY = "safety.max_linear_mps"
ENV = "SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS"
SOURCES = ("file", "environ", "sets", "options")


def one_line(error: pytest.ExceptionInfo[ConfigError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def given_by(sources: dict[str, float], folder: Path) -> dict[str, object]:
    """Arguments of `load` in which each source gives KEY its own value."""
    arguments: dict[str, object] = {"environ": {}}
    for source, value in sources.items():
        if source == "file":
            path = folder / "robot.toml"
            path.write_text(f"[safety]\nmax_linear_mps = {value}\n")
            arguments["file"] = str(path)
        elif source == "environ":
            arguments["environ"] = {ENV: str(value), "PATH": "/bin"}
        elif source == "sets":
            arguments["sets"] = [f"{KEY}={value}"]
        else:
            arguments["options"] = {KEY: value, "robot": None}
    return arguments


@given(st.dictionaries(st.sampled_from(SOURCES), st.sampled_from([0.11, 0.22, 0.33, 0.44])))
def test_the_strongest_source_wins_and_is_named(tmp_path_factory, sources):
    folder = tmp_path_factory.mktemp("settings")
    loaded = load("robot", **given_by(sources, folder))
    strongest = max(sources, key=SOURCES.index, default=None)
    assert loaded.config.safety.max_linear_mps == (sources[strongest] if strongest else 0.5)
    origins = {
        None: "default", "file": str(folder / "robot.toml"), "environ": ENV, "sets": "--set",
        "options": "--max-linear-mps",
    }
    assert loaded.origin(("safety", "max_linear_mps")) == origins[strongest]
    assert loaded.origin(("safety", "silence_ms")) == "default"


def test_one_key_of_a_table_leaves_the_others_at_their_defaults():
    loaded = load("robot", sets=["camera.options.folder=/pictures"], environ={})
    assert loaded.config.camera.kind == "sim"
    assert loaded.config.camera.options == {"folder": "/pictures"}


@pytest.mark.parametrize("service", SERVICES)
def test_every_key_can_be_given_in_the_environment(service):
    keys = list(known_keys(model_of(service)))
    assert keys
    for key in keys:
        assert is_known(model_of(service), key)
        name = ENV_PREFIX + "__".join((service, *key)).upper()
        with pytest.raises(ConfigError) as error:
            load(service, environ={name[:-1] + "QQ": "1"})
        assert "unknown environment variable" in one_line(error)


@pytest.mark.parametrize("name", ["SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPSS", "SIGHTLINE_ROBOT__SAFTY__MAX_LINEAR_MPS"])
def test_misspelled_environment_name_is_rejected_with_the_nearest(name):
    for service in SERVICES:  # for every service: an ignored variable must not seem to work
        with pytest.raises(ConfigError, match=f"did you mean '{ENV}'"):
            load(service, environ={name: "0.3"})


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("safety.max_linear_mps=nan", ["--set safety.max_linear_mps", "nan", "finite"]),
        ("safety.max_linear_mps=-1", ["--set safety.max_linear_mps", "-1", "above 0 to 3"]),
        ("safety.max_linear_mps=fast", ["--set safety.max_linear_mps", "'fast'", "a number"]),
        ("safety.auto_arm=7", ["--set safety.auto_arm", "7", "true or false"]),
        ("safety.max_linear_mp=1", ["unknown key", "'safety.max_linear_mps'"]),
        ("max_linear_mps=1", ["unknown key", "'safety.max_linear_mps'"]),
        ("camera=3", ["--set camera = 3: expected a table"]),
        ("listen=nowhere", ["'nowhere'", "tcp/127.0.0.1:7447"]),
        ("listen=tcp/127.0.0.1:99999", ["99999", "65535"]),
        ("robot=a/b", ["'a/b'", "letters"]),
        ("safety.full_speed_age_ms=400", ["safety: ", "below zero_speed_age_ms"]),
        ("no equals sign", ["KEY=VALUE"]),
    ],
)
def test_invalid_value_is_one_line_with_the_permitted_values(setting, expected):
    with pytest.raises(ConfigError) as error:
        load("robot", sets=[setting], environ={})
    for part in expected:
        assert part in one_line(error)


@pytest.mark.parametrize("service", SERVICES)
def test_value_in_place_of_another_type_names_no_code(service):
    """A table was "a valid dictionary or instance of SafetyConfig", a list "a valid tuple"."""
    for key, field in model_of(service).model_fields.items():
        for value in (3, {"no": {"such": "value"}}):
            with suppress(ValidationError):
                model_of(service).model_validate({key: value})
                continue
            with pytest.raises(ConfigError) as error:
                load(service, options={key: value}, environ={})
            assert not re.search("dictionary|instance|tuple|Config|valid s", one_line(error)), key
            if table_of(field.annotation) and value == 3:
                assert one_line(error).endswith(" = 3: expected a table"), key


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1"])
def test_file_in_another_encoding_states_the_right_one(tmp_path, encoding):
    (path := tmp_path / "robot.toml").write_text('robot = "ä"\n', encoding)
    with pytest.raises(ConfigError) as error:
        load("robot", file=str(path), environ={})
    assert one_line(error).startswith(f"{path}: ") and one_line(error).endswith("; save it as UTF-8")


@pytest.mark.parametrize("key", ["listen", "robot", "state_dir", "safety.silence_ms"])
@pytest.mark.parametrize("value", ["{}", "{a = 1}", "{a = {b = 1}, c = 2}"])
def test_table_in_place_of_a_value_is_an_error_of_its_file(tmp_path, key, value):
    (path := tmp_path / "robot.toml").write_text(f"{key} = {value}")
    with pytest.raises(ConfigError) as error:
        load("robot", file=str(path), environ={})
    assert one_line(error).startswith(f"{path}: {key} = {{")


READERS = {
    "robot": lambda file: load("robot", file=file, environ={}),
    "vision": lambda file: load("vision", file=file, environ={}),
    "sim": lambda file: load("sim", file=file, environ={}),
    "scenario": load_scenario,
    "robot model": load_robot,
    "lens": read_model,
    "duty table": lambda file: GpioDriveConfig(wheel_radius_m=0.03, table_file=file).rows(),
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
@pytest.mark.parametrize(("data", "text"), [
    ('a = "é"'.encode("latin-1"), "not a text file in UTF-8; save it as UTF-8"),
    ("a = 1".encode("utf-16"), "not a text file in UTF-8; save it as UTF-8"),
    (b"#" * 1_000_001, "more than 1000000 bytes; name a TOML file"),
])  # fmt: skip
def test_file_without_toml_text_is_one_line_with_its_name_and_the_fix(tmp_path, read, data, text):
    (path := tmp_path / "my.toml").write_bytes(data)
    with pytest.raises(ConfigError) as error:
        read(str(path))
    assert one_line(error) == f"{path}: {text}"


def test_largest_file_is_read(tmp_path):
    (path := tmp_path / "my.toml").write_bytes(b"#" * 1_000_000)
    assert load("robot", file=str(path), environ={}).config == RobotConfig()


def test_several_errors_are_shown_as_the_first_and_a_count(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text("foo = 1\n[safety]\nmax_linear_mps = -1\nsilence_ms = 'x'\n")
    with pytest.raises(ConfigError) as error:
        load("robot", file=str(path), environ={})
    assert str(path) in one_line(error)
    assert one_line(error).endswith("(and 2 more)")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("= 1", "invalid TOML"), ("[safety]\nmax_linear_mps = -0,30 # slow", "; write -0.30 with a point"),
     ("[target]\nradius_m = 0.1", "is a configuration of `sightline vision`, not of `sightline robot`"),
     ("[safety]\nmax_linear_mps = inf", "= inf: expected a finite number"),
     ("[safety]\nmax_linear_mps = " + "9" * 5000, "invalid TOML: a number has too many digits"),
     ("[safety]\nmax_linear_mps = 0x" + "f" * 5000, "invalid TOML: a number has too many digits"),
     ("listen = " + "[" * 5000, "nested too deeply"),
     ("camera" + ".options" * 5000 + " = 1", "invalid TOML")],
)
def test_a_bad_file_is_named(tmp_path, text, expected):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load("robot", file=str(path), environ={})
    assert one_line(error).startswith(str(path))
    assert expected in one_line(error)


def value_at(key, config):
    for name in key:
        config = getattr(config, name, None)
    return config


@pytest.mark.parametrize("service", SERVICES)
def test_truth_in_a_file_is_not_a_number_nor_the_reverse(tmp_path, service):
    """Keys of every table; typed text has no types, so that 1 is true there."""
    path, kinds = tmp_path / "x.toml", {bool: [], int: [], float: []}
    for key in known_keys(model_of(service)):
        kinds.get(type(value_at(key, model_of(service)())), []).append(key)
    for kind, value, expected in ((bool, "1", "true or false"), (bool, "'true'", "true or false"),
                                  (int, "true", "number"), (float, "false", "number")):
        assert kinds[kind] or service == "sim"
        for key in kinds[kind][:: 1 if kind is bool else 3]:  # the schema of an error takes 10 ms
            path.write_text(f"{'.'.join(key)} = {value}\n")
            with pytest.raises(ConfigError) as error:
                load(service, file=str(path), environ={})
            assert f"{path}: {'.'.join(key)} = {value}: expected" in one_line(error) and expected in one_line(error)
    for key in kinds[bool]:
        name = f"SIGHTLINE_{service}__{'__'.join(key)}".upper()
        for source in ({"sets": [f"{'.'.join(key)}=1"], "environ": {}}, {"environ": {name: "1"}}):
            assert value_at(key, load(service, **source).config) is True


def test_whole_number_in_a_file_stays_a_number_with_a_point(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text("[wheels]\nmax_wheel_rad_s = 8\n")
    assert load("robot", file=str(path), environ={}).config.wheels.max_wheel_rad_s == 8.0


def test_byte_order_mark_of_a_windows_editor_is_not_part_of_the_file(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text("robot = 'r7'\n", "utf-8-sig")
    assert load("robot", file=str(path), environ={}).config.robot == "r7"


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 5000, "0x" + "f" * 5000])
def test_typed_value_that_is_too_much_for_toml_is_one_line(value):
    for sets in ([f"safety.max_linear_mps={value}"], []):
        environ = {} if sets else {"SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS": value}
        with pytest.raises(ConfigError) as error:
            load("robot", environ=environ, sets=sets)
        assert "a number" in one_line(error) and len(one_line(error)) < 300


def test_an_empty_file_name_is_not_the_defaults():
    """A script's variable that is not set must not start another robot."""
    with pytest.raises(ConfigError, match="the name of the configuration file is empty"):
        load("robot", file="", environ={})


def test_text_that_looks_like_a_number_is_text_where_text_belongs():
    loaded = load("robot", sets=["robot=7"], environ={"SIGHTLINE_ROBOT__LISTEN": "tcp/127.0.0.1:1,tcp/127.0.0.1:2"})
    assert loaded.config.robot == "7"
    assert loaded.config.listen == ("tcp/127.0.0.1:1", "tcp/127.0.0.1:2")


def test_implied_values_yield_to_given_ones():
    plain = load_service("robot", environ={})
    assert plain.config.ranging.kind == "sim"
    assert load_service("robot", environ={}, sets=["drive.kind=log"]).config.ranging is None
    assert load_service("robot", environ={}, sets=["range_sensor.kind=none"]).config.ranging is None
    connects = {"options": {"connect": ("tcp/127.0.0.1:1",)}, "environ": {}}
    assert load_service("robot", **connects).config.listen == ()
    assert load_service("robot", sets=["listen=tcp/127.0.0.1:2"], **connects).config.listen == ("tcp/127.0.0.1:2",)
    assert load_service("vision", environ={}, options={"listen": ("tcp/127.0.0.1:1",)}).config.connect == ()


@pytest.mark.parametrize("profile", [None, "sim"])
def test_one_socket_folder_configures_the_whole_simulated_robot(profile):
    options = {f"{device}.options.socket_dir": "/s" for device in ("camera", "drive")}
    config = load_service("robot", profile=profile, options=options, environ={}).config
    assert config.ranging == config.drive == config.camera
    other = load_service("robot", options=options, sets=["range_sensor.kind=other"], environ={}).config
    assert other.ranging.kind == "other"


def test_only_the_simulation_profile_arms_automatically():
    assert load("robot", profile="sim", environ={}).config.safety.auto_arm
    assert not load("robot", environ={}).config.safety.auto_arm
    with pytest.raises(ConfigError, match="did you mean 'sim'"):
        load("robot", profile="simm", environ={})


@pytest.mark.parametrize("service", SERVICES)
def test_output_of_show_is_a_file_with_the_same_values(service, tmp_path):
    config = load(service, environ={}).config
    path = tmp_path / "shown.toml"
    path.write_text(toml_text(config.model_dump(mode="json"), lambda _key: "where it came from"))
    assert load(service, file=str(path), environ={}).config == config


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), min_size=1, max_size=8)
VALUES = st.recursive(
    st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=8) | st.floats(-1e6, 1e6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, min_size=1, max_size=3),
    max_leaves=10,
)


@given(st.dictionaries(NAMES, VALUES, max_size=4))
def test_any_table_survives_as_toml(table):
    assert tomllib.loads(toml_text(table)) == table


@pytest.mark.parametrize("line", ["robot = 'a b'", "listen = ['tcp:7447']", "connect = ['tcp/robot']"])
def test_bad_id_or_endpoint_names_its_file_and_key(tmp_path, line):
    file = tmp_path / "robot.toml"
    file.write_text(line)
    key = line.partition(" ")[0]
    with pytest.raises(ConfigError, match=f"^{file}: {key}: invalid "):
        load("robot", file=str(file), environ={})
    with pytest.raises(ConfigError, match=f"^--{key}: invalid "):
        load("robot", options={key: "a/b"}, environ={})


@pytest.mark.parametrize("text", ['"r2"', "'r2'", "r2"])
def test_robot_id_may_be_quoted(text):
    assert load("robot", sets=[f"robot={text}"], environ={}).config.robot == "r2"
    assert load("robot", environ={"SIGHTLINE_ROBOT__ROBOT": text}).config.robot == "r2"
    with pytest.raises(ConfigError, match="invalid robot id 'a/b'"):
        load("robot", sets=['robot="a/b"'], environ={})


def test_vision_accepts_several_robots_and_a_robot_only_one():
    assert load("vision", sets=("robot=r*",), environ={}).config.robot == "r*"
    with pytest.raises(ConfigError, match="invalid robot id 'r\\*'"):
        load("robot", sets=("robot=r*",), environ={})


def test_simulated_robot_model_may_be_a_file():
    assert load("sim", sets=("robot=my/car.toml",), environ={}).config.robot == "my/car.toml"


def test_missing_key_is_reported_with_the_file_of_its_neighbors(tmp_path):
    file = tmp_path / "vision.toml"
    file.write_text("[camera]\nwidth_px = 320\n")
    with pytest.raises(ConfigError) as error:
        load("vision", file=str(file), environ={})
    assert one_line(error).startswith(f"{file}: camera.height_px: missing")
    with pytest.raises(ConfigError, match=r"^camera\.height_px: missing"):
        load("vision", environ={"SIGHTLINE_VISION__CAMERA__WIDTH_PX": "320"})


@pytest.mark.parametrize("old_key", [
    {"sets": ["detector.only_colour=true"]},
    {"environ": {"SIGHTLINE_VISION__DETECTOR__ONLY_COLOUR": "true"}},
])
def test_renamed_key_is_accepted_from_every_source(old_key):
    assert load("vision", **{"environ": {}, **old_key}).config.detector.only_color is True
