"""Grant the lease to one (role, session) at a time, by rank, while its commands are accepted. Pure."""

from dataclasses import dataclass

from sightline.protocol.messages import Holder

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

    def live_holder(self, now_us: int) -> Holder | None:
        """Return the driver that holds the lease now."""
        return self.holder if now_us < self.expires_us else None

    def may_take(self, who: Holder, now_us: int) -> bool:
        """Return True if `who` holds the lease or outranks the holder, or if the lease is free."""
        holder = self.live_holder(now_us)
        # Equal ranks never succeed each other: two vision services would alternate at every command.
        return holder is None or holder == who or RANKS[who.source] > RANKS[holder.source]

    def take(self, who: Holder, now_us: int) -> None:
        """Take or renew the lease for `life_us`."""
        self.holder, self.expires_us = who, now_us + self.life_us

    def drop(self) -> None:
        """End the lease now."""
        self.holder, self.expires_us = None, 0

    def lost_human(self, now_us: int) -> bool:
        """Return True if a human held the lease and it expired."""
        # An expired holder stays stored for this question. `drop` ends it after the loss is handled.
        return self.holder is not None and self.holder.source in HUMANS and now_us >= self.expires_us
