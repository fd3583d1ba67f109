"""Grant the lease to one (role, session) at a time, by rank, while its commands are accepted. Pure."""

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import cast

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Holder
from sightline.protocol.proof import NO_PROOF, Proof, continues, tokens_of

# Roles that may drive. STOP ranks above all of them and is not a role.
RANKS = {"guest": 0, "vision": 1, "teleop": 2}
# After the loss of one of these drivers, the robot stops and must be armed again.
HUMANS = frozenset({"teleop"})
# Security limits: present and ended tokens of drivers, fenced sessions, and sessions with a known token. The token of
# the holder is removed last.
_MAX_TOKENS, _MAX_FENCED, _MAX_KNOWN = 64, 64, 64


@dataclass(slots=True)
class Lease:
    """The right to drive, valid until `expires_us`. Only accepted commands renew it.

    Args:
        life_us: time for which one command holds the lease.
        succession_us: silence after which another driver of the same rank may succeed. Both need a token.
    """

    life_us: int
    succession_us: int
    holder: Holder | None = None
    expires_us: int = 0
    proof: Proof = NO_PROOF
    """The last accepted proof of the holder, which its next command must continue."""
    token: str = ""
    """The token of the holder, or "". The end of the token ends the lease."""
    _tokens: OrderedDict[str, None] = field(default_factory=OrderedDict)
    _ended: OrderedDict[str, int] = field(default_factory=OrderedDict)
    """The newest ended tokens -> end time."""
    _fenced: OrderedDict[Holder, None] = field(default_factory=OrderedDict)
    """Sessions that lost the lease by the end of their token or to a successor. A late command never drives."""
    _known: OrderedDict[Holder, str] = field(default_factory=OrderedDict)
    """Sessions that held the lease -> token, because later proofs no longer show it."""

    def live_holder(self, now_us: int) -> Holder | None:
        """Return the driver that holds the lease now."""
        return self.holder if now_us < self.expires_us else None

    def is_fenced(self, who: Holder) -> bool:
        """Return True for a session that must not drive again."""
        return who in self._fenced

    def has_left(self, who: Holder, proof: Proof, now_us: int) -> bool:
        """Return True for a driver that has just withdrawn its token. The withdrawal may overtake its last command.

        A command that comes later than the life of a lease is too old. Until then no other driver may succeed a session
        without a token.
        """
        # Any client can compute the token of a driver from its proofs, so this must not exclude a human.
        return who.source not in HUMANS and any(
            now_us - self._ended[token] < self.life_us for token in tokens_of(proof.proof) if token in self._ended)

    def may_take(self, who: Holder, now_us: int, proof: Proof = NO_PROOF) -> bool:
        """Return True if `who` holds the lease, outranks the holder or succeeds it, or if the lease is free."""
        holder = self.live_holder(now_us)
        if self.is_fenced(who):
            return False
        # A holder that drives has no successor of equal rank, because two vision services would alternate.
        if holder == who:
            return True
        if holder is None or RANKS[who.source] > RANKS[holder.source]:
            return not self.has_left(who, proof, now_us)
        silent_us = now_us - (self.expires_us - self.life_us)
        return bool(self.token) and silent_us > self.succession_us and who.source == holder.source \
            and bool(self._token_of(proof))

    def check_proof(self, who: Holder, proof: Proof, now_us: int) -> None:
        """Check that a message in the name of the holder comes from the holder.

        Raises:
            WireError: NOT_PROVEN. A peer that knows the holder's session cannot continue its proofs.
        """
        if self.live_holder(now_us) == who and self.proof.proof is not None and not continues(proof.proof, self.proof):
            raise WireError(
                RejectReason.NOT_PROVEN, f"its proof does not continue that of the {who.source} that drives"
            )

    def take(self, who: Holder, now_us: int, proof: Proof = NO_PROOF) -> None:
        """Take or renew the lease for `life_us`. The first proof commits the holder to its chain."""
        holder = self.live_holder(now_us)
        if holder != who:
            if holder is not None and holder.source == who.source:
                self._fence(holder)
            self.token = "" if who.source in HUMANS else self._known_token(who) or self._token_of(proof)
            self._remember(who)
        self.holder, self.expires_us, self.proof = who, now_us + self.life_us, proof

    def advance(self, who: Holder, proof: Proof, now_us: int) -> None:
        """Store the proof of a request of the holder, so that a copy of it is not valid again."""
        if self.live_holder(now_us) == who:
            self.proof = proof

    def drop(self) -> None:
        """End the lease now."""
        self.holder, self.expires_us, self.proof, self.token = None, 0, NO_PROOF, ""

    def add_token(self, token: str) -> None:
        """Store the token of a driver that may take the lease. It computes no hash, because a peer may send many."""
        self._ended.pop(token, None)
        self._tokens[token] = None
        if len(self._tokens) > _MAX_TOKENS:
            del self._tokens[next(one for one in self._tokens if one != self.token)]

    def end_token(self, token: str, now_us: int) -> bool:
        """Return True if this token ended the current lease. Its session never drives again, even if it expired."""
        if token in self._tokens:
            del self._tokens[token]
            self._ended[token] = now_us
            if len(self._ended) > _MAX_TOKENS:
                self._ended.popitem(last=False)
        if not token or token != self.token:
            return False
        is_live = self.live_holder(now_us) is not None
        self._fence(cast(Holder, self.holder))  # a token always has a holder
        self.drop()
        return is_live

    def _token_of(self, proof: Proof) -> str:
        """Return the token whose driver revealed `proof`, or "" without one."""
        return next((token for token in tokens_of(proof.proof) if token in self._tokens), "")

    def _known_token(self, who: Holder) -> str:
        """Return the token of an earlier lease of a session, also after a human driver, or ""."""
        token = self._known.get(who, "")
        return token if token in self._tokens else ""

    def _remember(self, who: Holder) -> None:
        if self.token:
            self._known[who] = self.token
            self._known.move_to_end(who)
            if len(self._known) > _MAX_KNOWN:
                self._known.popitem(last=False)

    def _fence(self, who: Holder) -> None:
        self._fenced[who] = None
        if len(self._fenced) > _MAX_FENCED:
            self._fenced.popitem(last=False)

    def lost_human(self, now_us: int) -> bool:
        """Return True if a human held the lease and it expired."""
        # An expired holder stays stored for this check. `drop` removes it after the loss is handled.
        return self.holder is not None and self.holder.source in HUMANS and now_us >= self.expires_us
