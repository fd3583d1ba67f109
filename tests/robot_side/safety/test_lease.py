"""Every number of the lease and the ranks of those who may hold it: at it, before, after."""

from random import Random

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Holder
from sightline.protocol.proof import NO_PROOF, Proof, ProofChain
from sightline.robot_side.safety.lease import HUMANS, RANKS, Lease

ROBOT, OTHER = "0000aaaa", "0000cccc"
VISION, OTHER_VISION = Holder(source="vision", session="0000bbbb"), Holder(source="vision", session="0000cccc")
HUMAN, OTHER_HUMAN = Holder(source="teleop", session="0000dddd"), Holder(source="teleop", session="0000eeee")
GUEST = Holder(source="guest", session="00000000")


# --- lease -------------------------------------------------------------------------------------------------------


def held_by(who, now_us=1_000, life_us=500):
    lease = Lease(life_us, 400)
    lease.take(who, now_us)
    return lease


def test_roles_and_human_roles_are_as_documented():
    assert sorted(RANKS, key=RANKS.__getitem__) == ["guest", "vision", "teleop"]
    assert len(set(RANKS.values())) == 3
    assert set(HUMANS) == {"teleop"}


@pytest.mark.parametrize(("now_us", "held"), [(1_000, True), (1_499, True), (1_500, False), (1_501, False)])
@pytest.mark.parametrize("who", [VISION, HUMAN, GUEST])
def test_a_lease_lives_its_time(who, now_us, held):
    lease = held_by(who)
    assert lease.live_holder(now_us) == (who if held else None)
    assert lease.lost_human(now_us) == (who is HUMAN and not held)
    assert lease.may_take(OTHER_VISION, now_us) == (not held or who is GUEST)


def test_new_lease_has_no_holder():
    lease = Lease(500, 400)
    assert lease == Lease(500, 400, None, 0)
    for now_us in (-1, 0, 1):
        assert lease.live_holder(now_us) is None and not lease.lost_human(now_us) and lease.may_take(GUEST, now_us)


@pytest.mark.parametrize("who", [VISION, HUMAN])
def test_a_dropped_lease_was_not_lost(who):
    lease = held_by(who)
    lease.drop()
    assert lease == Lease(500, 400, None, 0)
    assert lease.live_holder(1_001) is None and not lease.lost_human(9_000)


def test_taking_again_renews():
    lease = held_by(VISION)
    lease.take(VISION, 1_400)
    assert lease.live_holder(1_899) == VISION and lease.live_holder(1_900) is None


@pytest.mark.parametrize(
    ("holder", "who", "may"),
    [
        (VISION, VISION, True), (VISION, VISION.model_copy(), True),
        (VISION, OTHER_VISION, False), (VISION, HUMAN, True), (VISION, GUEST, False),
        (HUMAN, HUMAN, True), (HUMAN, OTHER_HUMAN, False), (HUMAN, VISION, False), (HUMAN, GUEST, False),
        (GUEST, GUEST, True), (GUEST, VISION, True), (GUEST, HUMAN, True),
    ],
)  # fmt: skip
def test_holder_and_higher_rank_may_take_the_lease(holder, who, may):
    assert held_by(holder).may_take(who, 1_200) == may


# --- proof of identity -------------------------------------------------------------------------------------------


def proven(seed=1):
    """A lease that the vision service holds until 1000 us, its chain, and the proof that it committed with."""
    proofs, lease = ProofChain(Random(seed).randbytes), Lease(1_000, 400)
    first = proofs.next()
    lease.take(VISION, 0, first)
    return lease, proofs, first


def test_message_of_the_holder_must_continue_its_proof():
    lease, proofs, first = proven()
    lease.check_proof(VISION, proofs.next(), 999)
    for forged in (first, NO_PROOF, Proof("ab" * 16)):
        with pytest.raises(WireError) as caught:
            lease.check_proof(VISION, forged, 999)
        assert caught.value.reason is RejectReason.NOT_PROVEN
        assert caught.value.detail == "its proof does not continue that of the vision that drives"


def test_no_proof_is_checked_of_another_driver_after_the_lease_or_without_commitment():
    lease, _, _ = proven()
    lease.check_proof(HUMAN, NO_PROOF, 999)
    lease.check_proof(VISION, NO_PROOF, 1_000)
    lease.drop()
    assert lease.proof == NO_PROOF
    lease.take(VISION, 0)
    lease.check_proof(VISION, NO_PROOF, 1)


def test_request_uses_up_the_proof_of_the_holder_alone():
    lease, proofs, first = proven()
    lease.advance(HUMAN, NO_PROOF, 999)
    lease.advance(VISION, NO_PROOF, 1_000)
    assert lease.proof == first
    second = proofs.next()
    lease.advance(VISION, second, 999)
    assert lease.proof == second and lease.expires_us == 1_000
