"""A gate with its own clock, and short ways to say what arrives. Used by the gate's tests."""

from sightline.protocol.messages import AnswerHeader, Echo, Request, RequestHeader, Twist, Verb
from sightline.robot_side.safety.guard import RangeGuard
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.gate import SafetyGate

ROBOT, VISION, OTHER, HUMAN = "0000aaaa", "0000bbbb", "0000cccc", "0000dddd"
MS = 1000


class Rig:
    """Time advances only when told; a frame is issued at every millisecond asked for."""

    def __init__(self, guard: RangeGuard | None = None, stopped: bool = False, **config):
        self.gate = SafetyGate(SafetyConfig(**config), ROBOT, guard=guard, stopped=stopped)
        self.now_us = 10_000_000
        self._frame = 0
        self._seq = 0
        self.applied = []

    def frame(self, age_ms: float = 0.0) -> Echo:
        """A frame issued `age_ms` ago."""
        self._frame += 1
        t_us = self.now_us - round(age_ms * MS)
        self.gate.issued.add("frame", self._frame, t_us)
        return Echo(channel="frame", session=ROBOT, seq=self._frame, t_us=t_us)

    def header(self, echo=None, source="vision", session=VISION, seq=None) -> AnswerHeader:
        """A command's header; `seq` counts up by itself."""
        self._seq += 1
        return AnswerHeader(
            source=source, session=session, seq=self._seq if seq is None else seq, echo=echo or self.frame()
        )

    def offer(self, linear=0.3, angular=0.0, *, header=None, source="vision", session=VISION, age_ms=0.0):
        """Offer a command on a frame of `age_ms`."""
        header = header or self.header(self.frame(age_ms), source, session)
        return self.gate.offer(source, header, Twist(linear_mps=linear, angular_rad_s=angular), self.now_us)

    def step(self, after_ms: float = 20.0):
        """Let time pass, then step."""
        self.now_us += round(after_ms * MS)
        decision = self.gate.step(self.now_us)
        self.applied.append((self.now_us, decision.twist))
        return decision

    def request(self, verb: Verb, source="operator", session=HUMAN, echo=True):
        """Ask for something, citing a status issued now."""
        cited = None
        if echo:
            self._frame += 1
            self.gate.issued.add("status", self._frame, self.now_us)
            cited = Echo(channel="status", session=ROBOT, seq=self._frame, t_us=self.now_us)
        header = RequestHeader(source=source, session=session, seq=self._frame, echo=cited)
        return self.gate.request(header, Request(id=1, verb=verb), self.now_us)

    def armed(self, source="vision", session=VISION):
        """Five live commands, then arm."""
        for _ in range(5):
            self.offer(source=source, session=session)
            self.step()
        self.request(Verb.ARM)
        return self

    def drive(self, ms: float, linear=0.5, angular=0.0, **kwargs):
        """Fresh commands every 20 ms for `ms`."""
        for _ in range(round(ms / 20)):
            self.offer(linear, angular, **kwargs)
            self.step()
        return self

    def silence(self, ms: float, tick_ms: float = 20.0):
        """No commands for `ms`."""
        for _ in range(round(ms / tick_ms)):
            self.step(tick_ms)
        return self
