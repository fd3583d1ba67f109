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


# --- tokens ------------------------------------------------------------------------------------------------------


class Vision:
    """A session of a vision service with a chain of proofs."""

    def __init__(self, seed):
        self.who = Holder(source="vision", session=f"{seed:08x}")
        self._chain = ProofChain(Random(seed).randbytes)
        self.token, self.proof = self._chain.token, self._chain.next()

    def later(self, commands):
        """The proof that many commands after the first one."""
        for _ in range(commands):
            proof = self._chain.next()
        return proof


def held(token_first=True):
    """A lease of 1000 us that a driver with a token took at 0, with a succession after 400 us, and the driver."""
    lease, first = Lease(1_000, 400), Vision(1)
    if token_first:
        lease.add_token(first.token)
    lease.take(first.who, 0, first.proof)
    return lease, first


def test_token_is_of_the_driver_that_takes_the_lease_while_it_is_there():
    lease, first = held()
    assert lease.token == first.token
    lease.add_token(Vision(2).token)
    assert lease.token == first.token
    lease, first = held(token_first=False)
    lease.add_token(first.token)
    lease.take(first.who, 10, first.later(1))
    assert lease.token == "", "it came later"
    lease.take(first.who, 5_000, first.later(2))
    assert lease.token == first.token, "it is there when the session takes the lease again"


@pytest.mark.parametrize(("at_us", "ends"), [(0, True), (999, True), (1_000, False), (9_000, False)])
def test_lease_ends_with_its_token_while_it_lasts_and_its_session_never_drives_again(at_us, ends):
    lease, first = held()
    second = Vision(2)
    lease.add_token(second.token)
    assert lease.end_token(first.token, at_us) is ends
    assert lease.is_fenced(first.who) and lease.holder is None and lease.token == ""
    assert lease.may_take(first.who, at_us + 1, first.later(1)) is False, "a late command keeps no other one waiting"
    assert lease.may_take(second.who, at_us + 1, second.proof)


def test_empty_token_ends_no_lease():
    lease, first = held(token_first=False)
    assert lease.end_token("", 0) is False
    assert lease.live_holder(0) == first.who


def test_token_that_ended_is_of_no_later_driver():
    lease, first = held()
    second = Vision(2)
    lease.add_token(second.token)
    lease.end_token(second.token, 0)
    lease.end_token(first.token, 0)
    lease.take(second.who, 10, second.proof)
    assert lease.token == ""


@pytest.mark.parametrize(("after_us", "may"), [(0, False), (999, False), (1_000, True)])
@pytest.mark.parametrize("commands", [0, 63, 64])
def test_driver_that_has_just_left_takes_no_lease_with_one_of_its_first_commands(after_us, may, commands):
    lease, second = Lease(1_000, 400), Vision(2)
    proof = second.later(commands) if commands else second.proof
    lease.add_token(second.token)
    assert lease.may_take(second.who, 5_000, proof)
    lease.end_token(second.token, 5_000)
    assert lease.may_take(second.who, 5_000 + after_us, proof) is (may or commands == 64)
    assert lease.may_take(Vision(3).who, 5_000 + after_us, Vision(3).proof)
    assert lease.may_take(Holder(source="teleop", session="0000000f"), 5_000 + after_us, proof)
    lease.end_token(second.token, 5_900)
    lease.add_token(second.token)
    assert lease.may_take(second.who, 5_000 + after_us, proof), "its token is back"


def test_driver_that_has_just_left_takes_no_lease_of_a_lower_rank_and_keeps_its_own():
    lease, second = held_by(GUEST, 0, 1_000), Vision(2)
    lease.add_token(second.token)
    lease.end_token(second.token, 10)
    assert not lease.may_take(second.who, 20, second.proof)
    lease.take(second.who, 30, second.proof)
    assert lease.may_take(second.who, 40, second.proof)


def test_ended_tokens_are_bounded_and_the_newest_count():
    lease, drivers = Lease(1_000, 400), [Vision(number) for number in range(1, 70)]
    for driver in drivers:
        lease.add_token(driver.token)
        lease.end_token(driver.token, 0)
    assert len(lease._ended) == 64
    assert lease.may_take(drivers[4].who, 1, drivers[4].proof)
    assert not lease.may_take(drivers[5].who, 1, drivers[5].proof)
    assert lease.may_take(drivers[-1].who, 1_000, drivers[-1].proof)


def test_each_ended_token_counts_for_its_own_time():
    lease, early, late = Lease(1_000, 400), Vision(2), Vision(3)
    for driver, at_us in ((early, 0), (late, 900)):
        lease.add_token(driver.token)
        lease.end_token(driver.token, at_us)
    assert lease.may_take(early.who, 1_000, early.proof) and not lease.may_take(late.who, 1_000, late.proof)


def test_token_that_was_never_there_keeps_no_driver_out():
    lease, second = Lease(1_000, 400), Vision(2)
    lease.end_token(second.token, 0)
    assert lease.may_take(second.who, 1, second.proof)


def test_holder_keeps_its_token_in_its_later_chains():
    lease, first = held()
    lease.take(first.who, 10, first.later(2_000))
    lease.add_token(Vision(2).token)
    assert lease.token == first.token


def test_dropped_lease_has_no_token():
    lease, _ = held()
    lease.drop()
    assert (lease.token, lease.holder, lease.expires_us, lease.proof) == ("", None, 0, NO_PROOF)


@pytest.mark.parametrize(("at_us", "succeeds"), [(0, False), (399, False), (400, False), (401, True), (999, True)])
def test_driver_with_a_token_is_succeeded_after_its_silence_by_one_with_a_token(at_us, succeeds):
    lease, first = held()
    second = Vision(2)
    lease.add_token(second.token)
    assert lease.may_take(second.who, at_us, second.proof) is succeeds
    assert not lease.may_take(second.who, at_us), "without its proof"
    assert not lease.may_take(Vision(3).who, at_us, Vision(3).proof), "without its token"
    assert not lease.may_take(Holder(source="guest", session="00000000"), at_us, second.proof), "of another rank"
    lease.take(first.who, at_us, first.proof)
    assert not lease.may_take(second.who, at_us + 400, second.proof), "the silence begins again"


def test_driver_without_a_token_is_not_succeeded():
    lease, _ = held(token_first=False)
    second = Vision(2)
    lease.add_token(second.token)
    assert not lease.may_take(second.who, 900, second.proof)


@pytest.mark.parametrize(("commands", "succeeds"), [(63, True), (64, False)])
def test_successor_proves_within_its_first_64_commands_whose_token_it_is(commands, succeeds):
    lease, _ = held()
    second = Vision(2)
    lease.add_token(second.token)
    assert lease.may_take(second.who, 500, second.later(commands)) is succeeds


@pytest.mark.parametrize(("commands", "known"), [(63, True), (64, False)])
def test_driver_proves_within_its_first_64_commands_whose_token_it_is(commands, known):
    lease, first = Lease(1_000, 400), Vision(1)
    lease.add_token(first.token)
    lease.take(first.who, 0, first.later(commands))
    assert (lease.token == first.token) is known


@pytest.mark.parametrize("gap_us", [0, 1_000, 50_000])
def test_holder_that_takes_the_lease_again_keeps_its_token(gap_us):
    lease, first = held()
    lease.take(first.who, 900, first.later(500))
    lease.take(first.who, 1_900 + gap_us, first.later(500))
    assert lease.token == first.token


def test_driver_keeps_its_token_over_a_human_and_over_a_stop():
    human = Holder(source="teleop", session="0000000f")
    for between in (lambda lease: lease.take(human, 1_000), lambda lease: None):
        lease, first = held()
        between(lease)
        lease.drop()
        lease.take(first.who, 9_000, first.later(500))
        assert lease.token == first.token
        lease.drop()
        lease.end_token(first.token, 9_500)
        lease.take(first.who, 10_000, first.later(501))
        assert lease.token == "", "a token that ended has no driver"


def another_drives(lease, number):
    """Let another driver take the free lease with a token, and lose both."""
    lease.drop()
    other = Vision(number + 2)
    lease.add_token(other.token)
    lease.take(other.who, 0, other.proof)
    lease.end_token(other.token, 0)


@pytest.mark.parametrize(("others", "known"), [(63, True), (64, False)])
def test_tokens_of_sixty_four_former_drivers_are_known(others, known):
    lease, first = held()
    for number in range(others):
        another_drives(lease, number)
    lease.take(first.who, 0, first.later(500))
    assert (lease.token == first.token) is known


def test_the_driver_that_held_the_lease_longest_ago_is_forgotten_first():
    lease, first = held()
    for number in range(100):
        another_drives(lease, number)
        lease.take(first.who, 0, first.later(500))
        assert lease.token == first.token


def test_succeeded_driver_is_fenced_and_one_whose_lease_ended_or_that_a_human_displaced_is_not():
    lease, first = held()
    second = Vision(2)
    lease.take(second.who, 500, second.proof)
    assert lease.is_fenced(first.who) and not lease.is_fenced(second.who)
    lease, first = held()
    lease.take(first.who, 500, first.proof)
    assert not lease.is_fenced(first.who) and lease.token == first.token, "it goes on"
    lease.take(second.who, 1_500, second.proof)
    assert not lease.is_fenced(first.who) and lease.token == ""
    human = Holder(source="teleop", session="0000000f")
    lease.add_token(first.token)
    lease.take(human, 1_600, first.proof)
    assert not lease.is_fenced(second.who) and lease.token == "", "a human has no token"
    lease.add_token(Vision(4).token)
    assert lease.token == ""


def test_human_that_holds_the_lease_gets_no_token():
    lease, vision = Lease(1_000, 400), Vision(1)
    lease.take(Holder(source="teleop", session="0000000f"), 0, vision.proof)
    lease.add_token(vision.token)
    assert lease.token == ""


def test_token_costs_no_hash(monkeypatch):
    """A peer may declare any number of tokens. Each one with a thousand hashes kept the driver from its ticks."""
    lease, first = held()
    monkeypatch.setattr("sightline.robot_side.safety.lease.tokens_of", None)
    for number in range(1_000):
        lease.add_token(f"{number:032x}")
    assert lease.end_token(first.token, 0)


@pytest.mark.parametrize("count", [63, 64, 100])
def test_tokens_are_bounded_and_that_of_the_holder_stays(count):
    lease, first = held()
    others = [Vision(number) for number in range(2, 2 + count)]
    for other in others:
        lease.add_token(other.token)
    kept = [other for other in others if lease.may_take(other.who, 500, other.proof)]
    assert kept == others[-63:], "64 with that of the holder"
    assert lease.end_token(first.token, 0)


def test_fenced_sessions_are_bounded_and_the_oldest_is_forgotten():
    lease, drivers = Lease(1_000, 400), [Vision(number) for number in range(1, 67)]
    for driver in drivers:
        lease.add_token(driver.token)
        lease.take(driver.who, 0, driver.proof)
        assert lease.end_token(driver.token, 0)
    assert [lease.is_fenced(driver.who) for driver in drivers] == [False] * 2 + [True] * 64
