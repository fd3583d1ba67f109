"""The lease of a driver with a token: its end, the fence behind it, and the succession of a silent driver."""

from hashlib import sha256
from random import Random

import pytest

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import STILL, Holder, State, Verb
from sightline.protocol.proof import NO_PROOF, ProofChain, tokens_of
from tests.fixtures.safety import HUMAN, MS, VISION, VISION_HOLDER, Rig

NEXT = "0123abcd"


class Driver:
    """A session of a vision service with a chain of proofs and a token."""

    def __init__(self, rig, session=VISION, seed=1, source="vision"):
        self.rig, self.session, self.source = rig, session, source
        self.chain = ProofChain(Random(seed).randbytes)
        self.token = self.chain.token

    @property
    def holder(self):
        return Holder(source=self.source, session=self.session)

    def drive(self, ms=20.0, linear=0.4):
        """Send a command each 20 ms."""
        for _ in range(round(ms / 20)):
            header = self.rig.header(source=self.source, session=self.session, proof=self.chain.next())
            result = self.rig.offer(linear, header=header, source=self.source)
            self.rig.step()
        return result

    def declare(self):
        self.rig.gate.add_token(self.token)

    def withdraw(self):
        return self.rig.gate.end_token(self.token, self.rig.now_us)


def driven(**config):
    """A rig that a driver with a token drives, and this driver."""
    rig = Rig(auto_arm=True, **config)
    driver = Driver(rig)
    driver.declare()
    driver.drive(200)
    assert rig.gate.state is State.ACTIVE
    return rig, driver


def test_the_lease_ends_with_the_token_of_the_holder_and_not_with_one_that_comes_later():
    rig, driver = driven()
    assert driver.withdraw() and rig.gate.holder(rig.now_us) is None
    rig = Rig(auto_arm=True)
    driver = Driver(rig)
    driver.drive(200)
    driver.declare()
    assert not driver.withdraw(), "who read its commands could declare it"
    assert rig.gate.holder(rig.now_us) == driver.holder


def test_a_session_keeps_its_token_after_a_silence_however_many_commands_it_sent():
    rig, driver = driven()
    driver.drive(3_000)
    rig.silence(2_000)
    assert rig.gate.holder(rig.now_us) is None
    driver.drive()
    assert rig.gate.holder(rig.now_us) == driver.holder
    assert driver.withdraw()


def test_a_token_that_follows_from_another_one_is_not_of_its_driver():
    """Others read the token of a driver. What they compute from it must not end the lease."""
    rig = Rig(auto_arm=True)
    driver = Driver(rig)
    driver.declare()
    element = bytes.fromhex(driver.token)
    forged = [sha256(element).digest()[:16].hex(), next(tokens_of(driver.token))]
    for token in forged:
        rig.gate.add_token(token)
    driver.drive(200)
    assert not any(rig.gate.end_token(token, rig.now_us) for token in forged)
    assert driver.withdraw()


def test_a_driver_whose_token_overtook_its_first_command_reads_why_it_is_rejected():
    rig = Rig(auto_arm=True)
    driver = Driver(rig)
    driver.declare()
    driver.withdraw()
    result = driver.drive()
    assert (result.reason, result.detail) == (RejectReason.NOT_HOLDER, "the token of this vision just ended")
    assert rig.gate.holder(rig.now_us) is None


def test_the_last_command_drives_on_after_the_token_until_it_is_too_old():
    rig, driver = driven()
    driver.drive(600)
    applied = rig.gate.applied
    driver.withdraw()
    assert rig.step().twist == applied != STILL
    assert rig.silence(240).gate.state is not State.HOLD
    assert rig.silence(40).gate.state is State.HOLD


def test_a_session_whose_token_ended_never_drives_again():
    rig, driver = driven()
    driver.withdraw()
    result = driver.drive()
    assert (result.reason, rig.gate.holder(rig.now_us)) == (RejectReason.NOT_HOLDER, None)
    assert "new session" in result.detail
    rig.silence(5_000)
    driver.declare()
    assert driver.drive().reason is RejectReason.NOT_HOLDER
    with pytest.raises(Exception, match="new session"):
        rig.request(Verb.ACQUIRE, source="vision", session=VISION, proof=driver.chain.next())
    assert Driver(rig, NEXT, seed=2).drive().reason in (None, RejectReason.DISARMED), "a new one may"


def test_a_successor_drives_at_its_first_command_and_the_robot_does_not_stop():
    rig, driver = driven()
    driver.withdraw()
    rig.silence(60)
    assert Driver(rig, NEXT, seed=2).drive().accepted
    assert all(twist.linear_mps > 0 for _, twist in rig.applied[-5:])


@pytest.mark.parametrize("claims", ["unknown", "of another session", "empty", "of no driver"])
def test_no_other_token_ends_the_lease(claims):
    rig, driver = driven()
    other = Driver(rig, NEXT, seed=2)
    if claims == "of another session":
        other.declare()
        other.drive()
    token = {"empty": "", "of no driver": "0" * 32}.get(claims, other.token)
    assert not rig.gate.end_token(token, rig.now_us)
    assert rig.gate.holder(rig.now_us) == driver.holder
    assert driver.drive().accepted


def test_a_driver_without_proof_has_no_token():
    rig = Rig(auto_arm=True)
    driver = Driver(rig)
    driver.declare()
    rig.drive(200)
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER
    assert not driver.withdraw()
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER


def test_the_end_of_a_token_neither_stops_a_human_nor_changes_the_loss_of_one():
    rig, driver = driven()
    human = Driver(rig, HUMAN, seed=3, source="teleop")
    human.declare()
    human.drive(100)
    assert not human.withdraw() and not driver.withdraw()
    assert rig.gate.holder(rig.now_us) == human.holder
    rig.silence(1_020)
    assert rig.gate.state is State.DISARMED and "lost" in rig.gate.reason


@pytest.mark.parametrize(("silent_ms", "succeeds"), [(20, False), (380, False), (420, True), (900, True)])
def test_a_silent_driver_is_succeeded_after_400_ms_and_never_drives_again(silent_ms, succeeds):
    rig, driver = driven()
    other = Driver(rig, NEXT, seed=2)
    other.declare()
    rig.silence(silent_ms - 20)
    assert other.drive().accepted is succeeds
    assert rig.gate.holder(rig.now_us) == (other.holder if succeeds else driver.holder)
    if succeeds:
        assert "new session" in driver.drive().detail
        rig.silence(3_000)
        assert driver.drive().reason is RejectReason.NOT_HOLDER


@pytest.mark.parametrize("lacks", ["token of the holder", "token of the other", "proof of the other", "both"])
def test_only_a_driver_with_a_token_succeeds_one_with_a_token(lacks):
    rig = Rig(auto_arm=True)
    driver, other = Driver(rig), Driver(rig, NEXT, seed=2)
    if lacks not in ("token of the holder", "both"):
        driver.declare()
    if lacks not in ("token of the other", "both"):
        other.declare()
    driver.drive(200)
    rig.silence(700)
    header = rig.header(session=NEXT, proof=NO_PROOF if lacks == "proof of the other" else other.chain.next())
    assert rig.offer(header=header).reason is RejectReason.NOT_HOLDER
    assert driver.drive().accepted


@pytest.mark.parametrize(("config", "ms"), [({"silence_ms": 350}, 400), ({"zero_speed_age_ms": 300}, 300)])
def test_the_succession_waits_until_no_command_of_the_holder_can_be_in_force(config, ms):
    for silent_ms, succeeds in ((ms - 20, False), (ms + 20, True)):
        rig, _ = driven(**config)
        other = Driver(rig, NEXT, seed=2)
        other.declare()
        rig.silence(silent_ms - 20)
        assert other.drive().accepted is succeeds


def test_tokens_are_bounded_and_a_flood_of_them_does_not_displace_that_of_the_holder():
    rig, driver = driven()
    chance = Random(5)
    for _ in range(500):
        rig.gate.add_token(chance.randbytes(16).hex())
    assert driver.withdraw()


@pytest.mark.parametrize("seed", range(20))
def test_at_any_order_of_events_one_session_drives_and_no_ended_one_again(seed):
    """Random drivers come, drive, fall silent and go: after its token a session never moves the wheels."""
    chance, rig = Random(seed), Rig(auto_arm=True)
    drivers, ended = [], set()
    for number in range(150):
        event = chance.choice(("new", "drive", "drive", "drive", "silence", "end"))
        if event == "new" or not drivers:
            drivers.append(Driver(rig, f"{number:08x}", seed=seed * 1_000 + number))
            drivers[-1].declare()
        elif event == "drive":
            one = chance.choice(drivers)
            result = one.drive(chance.choice((20, 60)))
            if result.accepted:
                assert rig.gate.holder(rig.now_us) == one.holder and one.session not in ended
        elif event == "silence":
            rig.silence(chance.choice((20, 200, 500, 1_200)))
        else:
            holder = rig.gate.holder(rig.now_us)
            one = next((one for one in drivers if one.holder == holder), drivers[0])
            if one.withdraw():
                ended.add(one.session)
                assert rig.gate.holder(rig.now_us - 1 * MS) is None
    assert ended, "the test must end tokens of holders"


@pytest.mark.parametrize(("silent_us", "succeeds"), [(400_000, False), (400_001, True)])
def test_the_succession_begins_to_the_microsecond(silent_us, succeeds):
    rig = Rig(auto_arm=True)
    driver, other = Driver(rig), Driver(rig, NEXT, seed=2)
    driver.declare()
    other.declare()
    rig.offer(header=rig.header(session=VISION, proof=driver.chain.next()))
    rig.now_us += silent_us
    rig.offer(header=rig.header(session=NEXT, proof=other.chain.next()))
    assert rig.gate.holder(rig.now_us) == (other.holder if succeeds else driver.holder)
