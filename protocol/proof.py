"""Prove that commands come from one sender: each command reveals one more element of a hash chain. Pure.

An element is the hash of the next one. Only the sender knows the elements that are not revealed yet, so no secret
crosses the network. A receiver hashes a new element until the result is the last accepted one.
"""

from collections.abc import Callable, Iterator
from hashlib import sha256
from typing import Final, NamedTuple

ELEMENT_BYTES: Final = 16
"""Security level: 128 bits."""
MAX_LOST: Final = 64
"""Security limit: hashes for one command. So many commands in a row may be lost, more than in the life of a lease."""
_LENGTH: Final = 1024
_ANNOUNCED: Final = 2 * MAX_LOST
"""Number of commands that announce the next chain, so that the robot receives at least one of them."""


class Proof(NamedTuple):
    """The proof fields in the header of a command."""

    proof: str | None
    next_proof: str | None = None


NO_PROOF: Final = Proof(None)


class ProofChain:
    """The hash chain of one sender. Before its end it continues with a new chain.

    Args:
        draw: returns ELEMENT_BYTES random bytes.
    """

    def __init__(self, draw: Callable[[int], bytes]) -> None:
        self._draw = draw
        self._elements = self._new()
        self.token: Final = _token(self._elements[-1])
        """The value in the token of this driver. Before the first proof only this sender can compute it."""
        self._following: list[bytes] = []
        self._announced: str | None = None

    def next(self) -> Proof:
        """Return the proof of the next command."""
        if not self._elements:
            self._elements, self._following, self._announced = self._following, [], None
        proof = self._elements.pop().hex()
        if self._announced is None and len(self._elements) < _ANNOUNCED:
            self._following = self._new()
            # The announced element is public from now on, so it is not a proof.
            self._announced = self._following.pop().hex()
        return Proof(proof, self._announced)

    def _new(self) -> list[bytes]:
        elements = [self._draw(ELEMENT_BYTES)]
        for _ in range(_LENGTH - 1):
            elements.append(_hashed(elements[-1]))
        return elements


def continues(proof: str | None, last: Proof) -> bool:
    """Return True if the sender of `last` revealed `proof`, at most MAX_LOST commands later."""
    if proof is None or last.proof is None:
        return False
    known = {bytes.fromhex(one) for one in last if one is not None}
    element = bytes.fromhex(proof)
    for _ in range(MAX_LOST):
        element = _hashed(element)
        if element in known:
            return True
    return False


def tokens_of(proof: str | None) -> Iterator[str]:
    """Yield the possible tokens of a driver whose `proof` is one of its first MAX_LOST."""
    if proof is None:
        return
    element = bytes.fromhex(proof)
    for _ in range(MAX_LOST):
        yield _token(element)
        element = _hashed(element)


def _token(element: bytes) -> str:
    # A separate hash function, because otherwise the hash of one token would be another token of the same driver.
    return sha256(b"sightline-token/" + element).digest()[:ELEMENT_BYTES].hex()


def _hashed(element: bytes) -> bytes:
    return sha256(element).digest()[:ELEMENT_BYTES]


def session_digest(source: str, session: str) -> str:
    """Return the public name of a driver's session: 8 hex digits, which the driver can compute, too."""
    return sha256(f"{source}/{session}".encode()).hexdigest()[:8]
