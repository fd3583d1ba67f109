"""Who drives: one (role, session) at a time, by rank, for as long as its commands are accepted. Pure."""

from dataclasses import dataclass

from sightline.protocol.messages import Holder

RANKS = {"guest": 0, "vision": 1, "teleop": 2}
"""Roles that may drive; STOP stands above all and is no driver."""
HUMANS = frozenset({"teleop"})


@dataclass(slots=True)
class Lease:
    """Held until `expires_us`; renewed only by accepted commands."""

    life_us: int
    holder: Holder | None = None
    expires_us: int = 0

    def live_holder(self, now_us: int) -> Holder | None:
        """Who drives now."""
        return self.holder if now_us < self.expires_us else None

    def may_take(self, who: Holder, now_us: int) -> bool:
        """Whether `who` holds it, or outranks the holder, or there is no holder."""
        holder = self.live_holder(now_us)
        return holder is None or holder == who or RANKS[who.source] > RANKS[holder.source]

    def take(self, who: Holder, now_us: int) -> None:
        """Hold or renew."""
        self.holder, self.expires_us = who, now_us + self.life_us

    def drop(self) -> None:
        """End it."""
        self.holder, self.expires_us = None, 0

    def lost_human(self, now_us: int) -> bool:
        """Whether a human held it and let it run out."""
        return self.holder is not None and self.holder.source in HUMANS and now_us >= self.expires_us
