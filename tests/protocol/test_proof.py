"""Hash chains: what continues one, what does not, and that a chain never ends."""

from random import Random

import pytest

from sightline.protocol import proof as proof_module
from sightline.protocol.proof import ELEMENT_BYTES, MAX_LOST, NO_PROOF, Proof, ProofChain, continues, session_digest

pytestmark = pytest.mark.computes


def chain(seed=1):
    return ProofChain(Random(seed).randbytes)


@pytest.mark.parametrize(("lost", "accepted"), [(0, True), (1, True), (63, True), (64, False), (65, False)])
def test_next_proof_continues_after_at_most_63_lost_commands(lost, accepted):
    proofs = chain()
    last = proofs.next()
    for _ in range(lost):
        proofs.next()
    assert continues(proofs.next().proof, last) is accepted
    assert MAX_LOST == 64


@pytest.mark.parametrize(("lost", "hashes"), [(0, 1), (63, MAX_LOST), (64, MAX_LOST), (500, MAX_LOST)])
def test_proof_costs_a_hash_for_each_lost_command_and_never_more_than_the_limit(monkeypatch, lost, hashes):
    proofs, counted, hashed = chain(), [], proof_module._hashed
    last = proofs.next()
    for _ in range(lost):
        proofs.next()
    newest = proofs.next().proof
    monkeypatch.setattr(proof_module, "_hashed", lambda element: counted.append(element) or hashed(element))
    continues(newest, last)
    assert len(counted) == hashes


def test_revealed_proof_continues_nothing():
    proofs = chain()
    first, second = proofs.next(), proofs.next()
    assert not continues(second.proof, second)
    assert not continues(first.proof, second)
    assert not continues(chain(2).next().proof, first)
    assert not continues(None, first) and not continues(None, NO_PROOF) and not continues(first.proof, NO_PROOF)


@pytest.mark.parametrize("step", [1, 2, 63, 64])
def test_chain_continues_in_the_next_chain(step):
    proofs = chain()
    last, renewals = proofs.next(), set()
    for _ in range(5_000):
        for _ in range(step - 1):
            proofs.next()
        proof = proofs.next()
        assert continues(proof.proof, last)
        renewals.add(proof.next_proof)
        last = proof
    assert len(renewals - {None}) >= 4


def test_announced_element_proves_nothing():
    proofs = chain()
    announced = next(proof for proof in iter(proofs.next, None) if proof.next_proof)
    assert not continues(announced.next_proof, announced)
    assert not continues(announced.next_proof, Proof(announced.proof))


def test_no_element_is_revealed_twice_and_none_is_the_seed_of_a_later_one():
    proofs = chain()
    seen = [proofs.next().proof for _ in range(3_000)]
    assert len(set(seen)) == len(seen) and all(len(one) == 2 * ELEMENT_BYTES for one in seen)


def test_digest_of_a_session_is_short_and_belongs_to_the_role():
    assert session_digest("vision", "0000bbbb") == "20500bbc"
    assert session_digest("teleop", "0000bbbb") != session_digest("vision", "0000bbbb")
    assert session_digest("vision", "0000bbbb") != "0000bbbb"
