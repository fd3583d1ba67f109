"""Grant the lease to one (role, session) at a time, by rank, while its commands are accepted. Pure."""

from dataclasses import dataclass

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Holder
from sightline.protocol.proof import NO_PROOF, Proof, continues

# Roles that may drive. STOP ranks above all of them and is not a role.
RANKS = {"guest": 0, "vision": 1, "teleop": 2}
# After the loss of one of these drivers, the robot stops and must be armed again.
HUMANS = frozenset({"teleop"})


@dataclass(slots=True)
class Lease:
    """The right to drive, valid until `expires_us`. Only accepted commands renew it.

    Args:
        life_us: time for which one command holds the lease.
    """

    life_us: int
    holder: Holder | None = None
    expires_us: int = 0
    proof: Proof = NO_PROOF
    """The last accepted proof of the holder, which its next command must continue."""

    def live_holder(self, now_us: int) -> Holder | None:
        """Return the driver that holds the lease now."""
        return self.holder if now_us < self.expires_us else None

    def may_take(self, who: Holder, now_us: int) -> bool:
        """Return True if `who` holds the lease or outranks the holder, or if the lease is free."""
        holder = self.live_holder(now_us)
        # Equal ranks never succeed each other: two vision services would alternate at every command.
        return holder is None or holder == who or RANKS[who.source] > RANKS[holder.source]

    def check_proof(self, who: Holder, proof: Proof, now_us: int) -> None:
        """Check that a message which names the holder is of the holder.

        Raises:
            WireError: NOT_PROVEN. A peer that has read the holder's session cannot continue its proofs.
        """
        if self.live_holder(now_us) == who and self.proof.proof is not None and not continues(proof.proof, self.proof):
            raise WireError(
                RejectReason.NOT_PROVEN, f"its proof does not continue that of the {who.source} that drives"
            )

    def take(self, who: Holder, now_us: int, proof: Proof = NO_PROOF) -> None:
        """Take or renew the lease for `life_us`. The first proof commits the holder to its chain."""
        self.holder, self.expires_us, self.proof = who, now_us + self.life_us, proof

    def advance(self, who: Holder, proof: Proof, now_us: int) -> None:
        """Store the proof of a request of the holder, so that no copy of it proves anything."""
        if self.live_holder(now_us) == who:
            self.proof = proof

    def drop(self) -> None:
        """End the lease now."""
        self.holder, self.expires_us, self.proof = None, 0, NO_PROOF

    def lost_human(self, now_us: int) -> bool:
        """Return True if a human held the lease and it expired."""
        # An expired holder stays stored for this question. `drop` ends it after the loss is handled.
        return self.holder is not None and self.holder.source in HUMANS and now_us >= self.expires_us
