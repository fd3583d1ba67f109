"""The files of `sightline keys`: whole or unchanged, private, and the STOP secret is a file of its own."""

import datetime
import errno
import json
import shutil
import ssl
from contextlib import suppress

import pytest

from sightline.operator_side.cli import app as cli
from sightline.operator_side.setup import keys, router
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports import open as opening
from sightline.protocol.transports.diagnosis import diagnose_tls, keys_problem
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.security import RoleKeys, date_problem, own_token, read_tokens, validity
from sightline.protocol.transports.stop_port import stop_secret_file
from sightline.protocol.transports.websocket.tls import client_tls_context, server_tls_context
from sightline.protocol.transports.zenoh import link as zenoh_link
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.network import process as robot_process
from sightline.robot_side.pipe import NetworkSetup
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving import detector_service
from sightline.vision_side.serving import process as vision_process
from tests.fixtures.ports import free_port


def test_a_new_folder_has_a_secret_that_only_its_owner_reads(tmp_path):
    files = keys.make(tmp_path / "keys", [])
    secret = tmp_path / "keys/stop.secret"
    assert secret in files and str(secret) == stop_secret_file(str(tmp_path / "keys"))
    assert secret.stat().st_mode & 0o777 == 0o600 and len(secret.read_text().strip()) >= 32


def test_an_older_folder_gets_one_by_the_command_of_the_error(tmp_path):
    keys.make(tmp_path / "keys", [])
    (tmp_path / "keys/stop.secret").unlink()
    with pytest.raises(ConfigError) as error:
        stop_secret_file(str(tmp_path / "keys"))
    assert f"`sightline keys add {tmp_path}/keys stop`" in str(error.value)
    before = sorted(path.name for path in (tmp_path / "keys").iterdir())
    keys.add(tmp_path / "keys", "stop", [])
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == sorted([*before, "stop.secret"])


def test_a_folder_without_keys_gets_no_secret(tmp_path):
    with pytest.raises(ConfigError, match="sightline keys init"):
        keys.add(tmp_path, "stop", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("damage", "problem"), [
    (lambda folder: (folder / "robot.key").write_text("x"), "robot.pem or robot.key is damaged, or"),
    (lambda folder: (folder / "vision.pem").rename(folder / "robot.pem"), "robot.pem or robot.key is damaged, or"),
    (lambda folder: (folder / "ca.pem").write_text(""), "ca.pem is damaged in "),
])
def test_damaged_or_mixed_files_are_named_at_both_ends_of_a_link(tmp_path, damage, problem):
    keys.make(tmp_path, [])
    own = RoleKeys(str(tmp_path), "robot")
    assert keys_problem(own) == ""
    damage(tmp_path)
    assert keys_problem(own).startswith(problem) and diagnose_tls("tls/127.0.0.1:9", own) == keys_problem(own)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with pytest.raises(LinkError, match=f"^cannot listen on {endpoint}: {problem}"):
        open_link("r1", listen=[endpoint], role="robot", secure=str(tmp_path)).__enter__()


PAIR = ("robot.pem or robot.key is damaged, or they do not belong together in {}; "
        "copy the files of robot again from where they were made")
CA = "ca.pem is damaged in {}; copy it again from where it was made"


@pytest.mark.parametrize(("damage", "problem"), [
    (lambda folder: (folder / "robot.key").write_text("x"), PAIR),
    (lambda folder: (folder / "vision.key").rename(folder / "robot.key"), PAIR),
    (lambda folder: (folder / "ca.pem").write_text(""), CA),
    (lambda folder: (folder / "ca.pem").write_bytes(b"\xff" * 999), CA),
    (lambda folder: ((folder / "ca.pem").unlink(), (folder / "ca.pem").mkdir()), CA),
    (lambda folder: (folder / "ca.pem").unlink(),
     "ca.pem is missing in {}; copy it from the folder of `sightline keys init`"),
])
def test_damaged_or_mixed_files_for_websocket_are_named_with_a_fix(tmp_path, damage, problem):
    keys.make(tmp_path, [])
    server_tls_context(str(tmp_path), "robot"), client_tls_context(str(tmp_path))
    damage(tmp_path)
    with pytest.raises(ConfigError) as error:
        server_tls_context(str(tmp_path), "robot"), client_tls_context(str(tmp_path))
    assert str(error.value) == problem.format(tmp_path)


@pytest.mark.parametrize("content", [b"", b"short", b"\xff" * 32, b"a" * 129, b"two words of a token", b"\0" * 32])
def test_file_without_a_token_is_reported_with_a_fix(tmp_path, content):
    (tmp_path / "operator.token").write_bytes(content)
    for read in (lambda: own_token(str(tmp_path), "operator"), lambda: read_tokens(str(tmp_path))):
        with pytest.raises(ConfigError, match=f"^{tmp_path}/operator.token contains no token: expected "):
            read()


def test_token_that_may_not_be_read_is_reported_with_a_fix(tmp_path, monkeypatch):
    file = tmp_path / "operator.token"
    file.touch()

    def rejected(*_args, **_kw):
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr(type(file), "read_text", rejected)
    with pytest.raises(ConfigError) as error:
        own_token(str(tmp_path), "operator")
    assert str(error.value) == f"cannot read {file}: Permission denied; make it readable for this account"


def test_files_for_websocket_that_may_not_be_read_are_named(tmp_path, monkeypatch):
    def rejected(*_args, **_kw):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(ssl.SSLContext, "load_cert_chain", rejected)
    monkeypatch.setattr(ssl, "create_default_context", rejected)
    with pytest.raises(ConfigError, match=r"^this account may not read robot\.pem and robot\.key in keys$"):
        server_tls_context("keys", "robot")
    with pytest.raises(ConfigError, match=r"^this account may not read ca\.pem in keys$"):
        client_tls_context("keys")


@pytest.mark.parametrize("host", ["300.1.1.1", "192.168.1", "robot local", "robot/1"])
def test_an_invalid_host_is_rejected_before_anything_is_written(tmp_path, host):
    with pytest.raises(ConfigError, match=f"invalid host '{host}'"):
        keys.make(tmp_path / "keys", ["robot.local", host])
    assert not (tmp_path / "keys").exists()


def test_key_that_cannot_be_written_is_reported_and_the_old_one_stays(tmp_path, monkeypatch):
    keys.make(tmp_path, [])
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    write_bytes = type(tmp_path).write_bytes

    def on_a_full_disk(path, data):
        write_bytes(path, b"")
        if "robot.pem" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(tmp_path), "write_bytes", on_a_full_disk)
    with pytest.raises(ConfigError, match=f"cannot write keys to {tmp_path}: No space left on device; "):
        keys.add(tmp_path, "robot", [])
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize(("given", "hosts"), [([], ("robot.local", "10.0.0.7")), (["10.0.0.8"], ("10.0.0.8",))])
def test_new_key_is_valid_for_the_addresses_of_the_old_one_unless_others_are_given(tmp_path, given, hosts):
    keys.make(tmp_path, ["robot.local", "10.0.0.7"])
    keys.add(tmp_path, "robot", given)
    made = {one.role: one.hosts for one in keys.look(tmp_path)}
    assert made["robot"] == (*keys.LOOPBACK, *hosts)
    assert made["vision"] == (*keys.LOOPBACK, "robot.local", "10.0.0.7")


def test_new_keys_replace_the_old_ones_and_stay_private(tmp_path):
    keys.make(tmp_path, [])
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    files = keys.add(tmp_path, "robot", []) + keys.add(tmp_path, "stop", [])
    assert {file.name for file in files} == {"robot.key", "robot.pem", "robot.token", "stop.secret"}
    assert {name for name, data in before.items() if (tmp_path / name).read_bytes() != data} == {
        file.name for file in files}
    assert all(file.stat().st_mode & 0o777 == 0o600 for file in files if file.suffix != ".pem")
    assert (tmp_path / "robot.pem").stat().st_mode & 0o777 == (tmp_path / "ca.pem").stat().st_mode & 0o777


def test_damaged_certificate_of_a_role_is_replaced_without_a_new_authority(tmp_path):
    keys.make(tmp_path, [])
    (tmp_path / "robot.pem").write_text("damaged")
    expected = (f"invalid certificate {tmp_path}/robot.pem; replace it with: sightline keys add {tmp_path} robot "
                "--host HOST")
    for read in (keys.look, lambda folder: keys.add(folder, "robot", [])):
        with pytest.raises(ConfigError) as error:
            read(tmp_path)
        assert str(error.value) == expected
    keys.add(tmp_path, "robot", ["10.0.0.7"])
    assert {one.role: one.hosts for one in keys.look(tmp_path)}["robot"] == (*keys.LOOPBACK, "10.0.0.7")


def test_damaged_certificate_of_the_authority_needs_a_new_folder(tmp_path):
    keys.make(tmp_path, [])
    (tmp_path / "ca.pem").write_text("damaged")
    with pytest.raises(ConfigError, match=f"ca.pem; create new ones with: sightline keys init {tmp_path}-new$"):
        keys.look(tmp_path)


def _days_left(folder):
    now = datetime.datetime.now(datetime.UTC)
    return {one.file.stem: (one.ends - now) / datetime.timedelta(days=1) for one in keys.look(folder)}


def test_authority_outlives_its_certificates_so_that_they_can_be_renewed(tmp_path):
    keys.make(tmp_path, [], days=10)
    assert _days_left(tmp_path)["ca"] > 9 * 365
    assert _days_left(tmp_path)["robot"] == pytest.approx(10, abs=0.1)
    keys.add(tmp_path, "robot", [])
    assert _days_left(tmp_path)["robot"] == pytest.approx(keys.DAYS, abs=0.1)


def test_certificate_ends_with_its_authority_and_the_command_prints_that(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(keys, "AUTHORITY_DAYS", 30)
    keys.make(tmp_path, [], days=10)
    assert cli.run(["keys", "add", str(tmp_path), "vision", "--days", "20"]) == 0
    assert capsys.readouterr().err == ""
    assert cli.run(["keys", "add", str(tmp_path), "robot"]) == 0
    printed = capsys.readouterr().err
    assert "robot.pem ends with its authority, on 2" in printed and f"sightline keys init {tmp_path}-new" in printed
    assert _days_left(tmp_path) == {
        "ca": pytest.approx(30, abs=0.1), "robot": pytest.approx(30, abs=0.1), "vision": pytest.approx(20, abs=0.1),
        **dict.fromkeys(("detector", "operator", "router", "viewer"), pytest.approx(10, abs=0.1)),
    }  # fmt: skip
    from cryptography import x509  # the file itself, not only what `look` makes of it

    read = {name: x509.load_pem_x509_certificate((tmp_path / f"{name}.pem").read_bytes()) for name in ("ca", "robot")}
    assert read["robot"].not_valid_after_utc == read["ca"].not_valid_after_utc


def test_expired_authority_signs_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(keys, "AUTHORITY_DAYS", -0.5)
    keys.make(tmp_path, [])
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match=rf"expired on 2.*; create new keys with: sightline keys init {tmp_path}-new"):
        keys.add(tmp_path, "robot", [])
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("left", ["ca.key", "ca.pem", "robot.key", "robot.pem", "robot.token", "stop.secret"])
def test_new_authority_replaces_no_file_of_an_earlier_one(tmp_path, left):
    keys.make(tmp_path / "earlier", [])
    (tmp_path / "keys").mkdir()
    shutil.copy(tmp_path / "earlier" / left, tmp_path / "keys")
    with pytest.raises(ConfigError, match=rf"already has keys \({left}\)"):
        keys.make(tmp_path / "keys", [])
    assert [file.name for file in (tmp_path / "keys").iterdir()] == [left]


def test_full_disk_leaves_no_half_of_a_new_authority(tmp_path, monkeypatch):
    write_bytes = type(tmp_path).write_bytes

    def on_a_full_disk(path, data):
        if "viewer.pem" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        write_bytes(path, data)

    monkeypatch.setattr(type(tmp_path), "write_bytes", on_a_full_disk)
    with pytest.raises(ConfigError, match="No space left on device"):
        keys.make(tmp_path / "keys", [])
    assert list((tmp_path / "keys").iterdir()) == []


def test_key_of_another_authority_signs_nothing(tmp_path):
    keys.make(tmp_path / "other", [])
    keys.make(tmp_path / "keys", [])
    shutil.copy(tmp_path / "other/ca.key", tmp_path / "keys")
    before = (tmp_path / "keys/robot.pem").read_bytes()
    with pytest.raises(ConfigError, match=r"ca\.key and ca\.pem in .*/keys do not belong together"):
        keys.add(tmp_path / "keys", "robot", [])
    assert (tmp_path / "keys/robot.pem").read_bytes() == before


def test_certificate_that_no_peer_accepts_is_shown_with_the_reason(tmp_path, monkeypatch, capsys):
    keys.make(tmp_path / "other", [])
    keys.make(tmp_path / "keys", [])
    shutil.copy(tmp_path / "other/viewer.pem", tmp_path / "keys")
    keys.add(tmp_path / "keys", "vision", [], days=-0.5)
    monkeypatch.setattr(keys, "_BEGUN_EARLIER", datetime.timedelta(days=-30))
    keys.add(tmp_path / "keys", "robot", [], days=60)
    assert cli.run(["keys", "show", str(tmp_path / "keys"), "--json"]) == 0
    shown = {one["role"]: one["problem"] for one in json.loads(capsys.readouterr().out)}
    assert shown.pop("robot").startswith("not valid before 2")
    assert shown.pop("vision").startswith("expired on 2")
    assert shown.pop("viewer") == "of another authority than ca.pem"
    assert set(shown.values()) == {""}
    assert cli.run(["keys", "show", str(tmp_path / "keys")]) == 0
    assert "not valid before 2" in capsys.readouterr().out


@pytest.mark.parametrize("days", [1, 20_000])  # to 2050 in the short form
def test_dates_of_a_certificate_are_read_without_the_package_that_makes_it(tmp_path, monkeypatch, days):
    monkeypatch.setattr(keys, "AUTHORITY_DAYS", 30_000)
    keys.make(tmp_path, ["robot.local"], days)
    robot = next(one for one in keys.look(tmp_path) if one.role == "robot")
    text = robot.file.read_text("ascii")
    assert validity(text) == (robot.begins, robot.ends) and (robot.ends.year > 2050) is (days > 1)
    for end in range(0, len(text), 9):
        with suppress(ValueError, IndexError):  # no other error for a truncated file
            assert validity(text[:end]) == (robot.begins, robot.ends)


@pytest.mark.parametrize(("days", "role", "problem"), [
    (0, "robot", ""), (794, "robot", ""), (796, "robot", "the certificate of this end ends soon (robot.pem, 20"),
    (826, "robot", "the certificate of this end has expired (robot.pem, 20"),
    (826, "teleop", "the certificate of this end has expired (operator.pem, 20"),
    (-2, "robot", "the authority of the keys is not valid before 20"),
    (3640, "robot", "the authority of the keys ends soon (ca.pem, 20"),
    (3651, "robot", "the authority of the keys has expired (ca.pem, 20"),
])  # fmt: skip
def test_dates_of_keys_are_reported_while_they_can_be_renewed(tmp_path, days, role, problem):
    keys.make(tmp_path, [])
    now = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    found = date_problem(str(tmp_path), role, now=now)
    assert found.startswith(problem) and bool(found) is bool(problem)
    assert date_problem("", role, now=now) == ""
    for damaged in ("", "-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n"):
        for name in ("ca.pem", "robot.pem"):
            (tmp_path / name).write_text(damaged)
        assert date_problem(str(tmp_path), "robot", now=now) == "", "the link reports a damaged file"


def _run_robot(config):
    setup = NetworkSetup(config=RobotConfig(**config), session="0000beef", first_seq=1, is_restart=True)
    robot_process._run(setup, None)


def _run_detector(config):
    detector_service.run(VisionConfig(**config), None, detector_service.ServingOptions("hsv"))


@pytest.mark.parametrize(("run", "module", "name", "role"), [
    (_run_robot, robot_process, "open_link", "robot"),
    (lambda config: vision_process.run(VisionConfig(**config)), opening, "open_link", "vision"),
    (_run_detector, zenoh_link, "open_fleet", "detector"),
    (lambda config: router.run(config["listen"], [], config["secure"]), router, "open_session", "router"),
], ids=["robot", "vision", "detector", "router"])  # fmt: skip
def test_service_whose_certificate_has_expired_warns_when_it_starts(
    tmp_path, monkeypatch, caplog, run, module, name, role
):
    keys.make(tmp_path, [])
    config = {"listen": [f"tls/127.0.0.1:{free_port()}"], "secure": str(tmp_path)}

    def opens(*_arguments, **_options):
        raise LinkError("opened")

    monkeypatch.setattr(module, name, opens)
    for days, expected in ((keys.DAYS, []), (-0.5, [f"the certificate of this end has expired ({role}.pem"])):
        keys.add(tmp_path, role, [], days)
        caplog.clear()
        with pytest.raises(LinkError, match="opened"):
            run(config)
        warned = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
        assert [words in line for words, line in zip(expected, warned, strict=True)] == [True] * len(expected)
