"""A driver that commits to a chain of proofs: no other peer continues or ends its lease, whatever it has read."""

from random import Random

import pytest

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import STILL, Echo, State, Verb
from sightline.protocol.proof import MAX_LOST, NO_PROOF, Proof, ProofChain
from tests.fixtures.safety import HUMAN, HUMAN_HOLDER, OTHER, VISION, VISION_HOLDER, Rig, refused

FORGED = Proof("ab" * 16)


class Driver:
    """A driver with a chain of its own."""

    def __init__(self, rig, source="vision", session=VISION, seed=1):
        self.rig, self.who = rig, {"source": source, "session": session}
        self.proofs = ProofChain(Random(seed).randbytes)

    def offer(self, linear=0.3, **changes):
        header = self.rig.header(**{"proof": self.proofs.next(), **self.who, **changes})
        return self.rig.offer(linear, header=header, source=header.source)

    def armed(self):
        for _ in range(5):
            self.offer()
            self.rig.step()
        self.rig.request(Verb.ARM, **self.who, proof=self.proofs.next())
        return self


@pytest.fixture(params=[False, True], ids=["plain", "secured"])
def rig(request):
    return Rig(needs_proof=request.param)


def test_driver_that_proves_itself_drives_through_many_chains(rig):
    driver = Driver(rig).armed()
    for _ in range(3_000):
        assert driver.offer().accepted
    rig.step()
    assert rig.gate.state is State.ACTIVE


@pytest.mark.parametrize("proof", [NO_PROOF, FORGED, "first", "last", "next"])
@pytest.mark.parametrize("seq", [None, 2**20])
def test_copied_identity_neither_drives_nor_locks_the_driver_out(rig, proof, seq):
    driver = Driver(rig).armed()
    first = Driver(rig).proofs.next()
    rig.step()
    last = driver.proofs.next()
    assert driver.offer(0.0, proof=last).accepted
    read = {"first": first, "last": last, "next": Proof(FORGED.proof, last.proof)}.get(proof, proof)
    for _ in range(20):
        verdict = rig.offer(0.5, header=rig.header(proof=read, seq=seq))
        assert verdict.reason is RejectReason.NOT_PROVEN
        assert driver.offer(0.0).accepted
        rig.step()
    assert rig.gate.applied == STILL and rig.gate.holder(rig.now_us) == VISION_HOLDER


def test_copied_identity_does_not_keep_the_lease(rig):
    Driver(rig).armed()
    for _ in range(49):
        rig.offer(0.5, header=rig.header(proof=FORGED))
        rig.step()
    assert rig.gate.holder(rig.now_us - 1) == VISION_HOLDER
    rig.step()
    assert rig.gate.holder(rig.now_us) is None and rig.gate.applied == STILL


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.RELEASE, Verb.ACQUIRE])
@pytest.mark.parametrize("proof", [NO_PROOF, FORGED])
def test_copied_identity_of_a_human_requests_nothing(rig, verb, proof):
    driver = Driver(rig, "teleop", HUMAN).armed()
    error = refused(rig, verb, source="teleop", session=HUMAN, proof=proof)
    assert error.reason is RejectReason.NOT_PROVEN
    assert error.detail in ("its proof does not continue that of the teleop that drives",
                            "a robot with keys needs a proof in each command")
    assert driver.offer().accepted and rig.gate.holder(rig.now_us) == HUMAN_HOLDER


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.ACQUIRE, Verb.RELEASE])
def test_request_of_the_driver_is_granted_once(rig, verb):
    driver = Driver(rig, "teleop", HUMAN).armed()
    proof = driver.proofs.next()
    rig.request(verb, source="teleop", session=HUMAN, proof=proof)
    if verb is Verb.RELEASE:
        assert rig.gate.holder(rig.now_us) is None
    else:
        assert refused(rig, verb, source="teleop", session=HUMAN, proof=proof).reason is RejectReason.NOT_PROVEN
        assert driver.offer().accepted


@pytest.mark.parametrize("verb", [Verb.STOP, Verb.DISARM])
def test_any_identity_may_stop(rig, verb):
    Driver(rig).armed()
    rig.request(verb, source="vision", session=VISION, echo=False)
    assert rig.gate.state is (State.STOPPED if verb is Verb.STOP else State.DISARMED)


def test_acquire_commits_the_driver(rig):
    driver = Driver(rig, "teleop", HUMAN)
    assert rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN, proof=driver.proofs.next()) == "acquired"
    assert rig.offer(header=rig.header(source="teleop", session=HUMAN, proof=FORGED), source="teleop").reason is (
        RejectReason.NOT_PROVEN)
    assert driver.offer().reason is RejectReason.DISARMED


@pytest.mark.parametrize(("lost", "reason"), [(0, None), (MAX_LOST - 1, None), (MAX_LOST, RejectReason.NOT_PROVEN)])
def test_lost_commands_cost_nothing_up_to_the_limit(rig, lost, reason):
    driver = Driver(rig).armed()
    for _ in range(lost):
        driver.proofs.next()
    assert driver.offer().reason is reason


def test_driver_takes_its_expired_lease_again_after_any_loss(rig):
    driver = Driver(rig).armed()
    for _ in range(200):
        driver.proofs.next()
    rig.silence(1_020)
    assert driver.offer().accepted and driver.offer().accepted


def test_next_driver_commits_for_itself(rig):
    Driver(rig).armed()
    human = Driver(rig, "teleop", HUMAN, seed=2)
    assert human.offer().accepted and human.offer().accepted
    assert rig.offer(header=rig.header(proof=FORGED)).reason is RejectReason.NOT_HOLDER
    assert rig.gate.holder(rig.now_us) == HUMAN_HOLDER


def test_commands_in_disarmed_commit_too(rig):
    driver = Driver(rig)
    driver.offer()
    assert rig.offer(header=rig.header(proof=FORGED)).reason is RejectReason.NOT_PROVEN
    assert driver.offer().reason is RejectReason.DISARMED


def test_robot_with_keys_needs_a_proof_and_without_keys_needs_none():
    for needs_proof, reason in [(True, RejectReason.NOT_PROVEN), (False, RejectReason.DISARMED)]:
        rig = Rig(needs_proof=needs_proof)
        assert rig.offer().reason is reason
        if needs_proof:
            assert refused(rig, Verb.ACQUIRE, source="teleop", session=OTHER).reason is reason
            assert rig.gate.holder(rig.now_us) is None


def test_age_is_validated_before_the_proof(rig):
    Driver(rig).armed()
    unknown = Echo(channel="frame", session="0000aaaa", seq=9_999, t_us=1)
    assert rig.offer(header=rig.header(unknown, proof=FORGED)).reason is RejectReason.UNKNOWN_FRAME


def test_guest_without_header_needs_no_proof():
    rig = Rig(needs_proof=True, guests=True)
    assert rig.gate.offer("guest", None, STILL, rig.now_us).reason is RejectReason.DISARMED
