"""Broken vision services: wrong headers, wrong twists, wrong echoes, wrong counts. Pure."""

import secrets

from sightline.conformance.vision.images import picture
from sightline.protocol.channels import REQUEST, key_for
from sightline.protocol.messages import Stamp
from sightline.protocol.proof import NO_PROOF, Proof
from sightline.protocol.spec.message_cases import packed
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from tests.conformance.vision.broken import STANDING, BrokenVision, breaks, frame_header


def rewriting(case, wrong, change=lambda fields: {}, text=lambda text: text, **how):
    """Changes every answer's header by `change` and every twist's payload by `text`."""
    class Rewriting(BrokenVision):
        def writes(self, fields, old):
            self.puts(fields | change(fields), None if old is None else text(old), **how)
    breaks(case, wrong)(Rewriting)


def echoing(case, wrong, change):
    """Changes every echo."""
    rewriting(case, wrong, lambda fields: {"echo": fields["echo"] | change(fields["echo"])})


rewriting("V-FRAM-05", "writes teleop into the header", lambda it: {"source": "teleop"})
rewriting("V-FRAM-06", "drives as teleop", lambda it: {"source": "teleop"}, source="teleop")
rewriting("V-HEAD-01", "writes a byte order mark", before=b"\xef\xbb\xbf")
rewriting("V-HEAD-02", "pads its headers", after=b" " * 500)
rewriting("V-HEAD-03", "speaks version 2", lambda it: {"v": 2})
rewriting("V-HEAD-04", "has a session in upper case", lambda it: {"session": "ABCDEF01"})
rewriting("V-HEAD-05", "counts in texts", lambda it: {"seq": str(it["seq"])})
rewriting("V-HEAD-08", "computes in less than no time", lambda it: {"compute_us": -1})
rewriting("V-HEAD-09", "does not state its computing time", lambda it: {"compute_us": 0})
rewriting("V-HEAD-10", "is NaN sure", lambda it: {"sure": float("nan")})
rewriting("V-HEAD-11", "names a scan that never came", lambda it: {"scan": it["seq"]})
rewriting("V-GRAM-01", "ends a twist with a newline", text=lambda text: text + b"\n")
rewriting("V-GRAM-03", "writes five decimals", text=lambda text: text.replace(b"|", b"0|") + b"0")
rewriting("V-GRAM-04", "writes -0", text=lambda text: b"-" + text if text.startswith(b"0.0000") else text)
rewriting("V-CAUS-12", "states ten seconds", lambda it: {"compute_us": 10_000_000})
echoing("V-CAUS-01", "cites a status", lambda it: {"channel": "status"})
echoing("V-CAUS-02", "cites its own session", lambda it: {"session": it["session"][::-1]})
echoing("V-CAUS-03", "cites `seq` as a real number", lambda it: {"seq": float(it["seq"])})
echoing("V-CAUS-04", "rounds times to milliseconds",
        lambda it: {"t_us": it["t_us"] if it["t_us"] > 2**50 else it["t_us"] // 1000 * 1000})
echoing("V-FRAM-19", "keeps 32 bits of `seq`", lambda it: {"seq": it["seq"] % (2**32 if it["seq"] > 2**40 else 2**53)})


@breaks("V-CAUS-22", "states its computing time in milliseconds")
class Milliseconds(BrokenVision):
    """Takes 60 ms for a large image."""

    later = large = None

    def hears(self, header, jpeg):
        self.large = len(jpeg) > 100_000 and jpeg.count(b"\xff\xfe") == 0
        return header, jpeg

    def writes(self, fields, text):
        if self.large:
            self.later = (self.now_us + 60_000, fields | {"compute_us": 62}, text)
        else:
            self.puts(fields | {"compute_us": 2}, text)

    def idle(self):
        if self.later is not None and self.now_us >= self.later[0]:
            self.puts(*self.later[1:])
            self.later = None


@breaks("V-HEAD-06", "names no source")
class NoSource(BrokenVision):
    def writes(self, fields, text):
        self.puts({name: value for name, value in fields.items() if name != "source"}, text)


@breaks("V-HEAD-07", "echoes no channel")
class NoChannel(BrokenVision):
    def writes(self, fields, text):
        echo = {name: value for name, value in fields["echo"].items() if name != "channel"}
        self.puts(fields | {"echo": echo}, text)


@breaks("V-GRAM-02", "divides by zero where the target is far left")
class NotANumber(BrokenVision):
    far = False

    def decides(self, header, answer):
        self.far = answer.seen.bearing_rad is not None and answer.seen.bearing_rad > 0.1
        return answer

    def writes(self, fields, text):
        self.puts(fields, b"nan|" + text.split(b"|")[1] if self.far else text)


@breaks("V-FRAM-01", "answers no target that follows an empty picture")
class Surprised(BrokenVision):
    last = b""

    def hears(self, header, jpeg):
        surprised = self.last == picture("absent") and jpeg == picture("right")
        self.last = jpeg
        return None if surprised else (header, jpeg)


@breaks("V-FRAM-02", "acknowledges what it drives by")
class Both(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields, text)
        if text is not None:
            self.answered += 1
            self.puts(fields | {"seq": self.answered}, None)


@breaks("V-FRAM-03", "gives its acks a payload")
class LoudAck(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields, text, payload=b"ok" if text is None else text)


@breaks("V-FRAM-04", "repeats it under another key")
class AnotherKey(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields, text)
        self.network.put("sightline/r1/twist/Vision", packed(fields), b"0|0", self.link)


class Again(BrokenVision):
    """Sends a twist again."""

    last = None

    def writes(self, fields, text):
        self.puts(fields, text)
        if text is not None and self.link.connected:
            self.last = (self.now_us, fields, text)

    def again(self):
        self.answered += 1
        self.puts(self.last[1] | {"seq": self.answered}, self.last[2])


@breaks("V-CAUS-06", "repeats each twist after 600 ms")
class Twice(Again):
    def idle(self):
        if self.last and self.now_us - self.last[0] >= 600_000:
            self.again()
            self.last = None


@breaks("V-SIL-01", "keeps the robot going when frames cease")
class Lively(Again):
    def idle(self):
        if self.last and self.now_us - self.last[0] >= 1_500_000:
            self.again()
            self.last = (self.now_us - 1_300_000, *self.last[1:])

    def lost(self):
        self.last = None


@breaks("V-CAUS-05", "begins before the first frame")
class Early(BrokenVision):
    framed, shown, since_us = "", "", 0

    def decides(self, header, answer):
        self.framed = header.session
        return answer

    def believes(self, message):
        try:
            stamp = Stamp.model_validate_json(message.header)
        except ValueError:
            return False
        if stamp.session != self.shown:
            self.shown, self.since_us = stamp.session, self.now_us
        if stamp.session != self.framed and self.now_us - self.since_us > 900_000:
            self.since_us = self.now_us
            self._publish(stamp, STANDING, 0)
        return False


@breaks("V-REQ-01", "arms a robot that is not armed")
class Arming(BrokenVision):
    def on_status(self, message):
        if b"DISARMED" in message.payload:
            self.network.put(key_for("r1", REQUEST, "vision"), packed({"v": 1}), b'{"id":1,"verb":"arm"}', self.link)


# --- counts ----------------------------------------------------------------------------------------------------------


@breaks("V-SEQ-01", "is another every ten answers")
class ManySessions(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields | {"session": f"{fields['seq'] // 10:08x}"}, text)


class PerSession(BrokenVision):
    """Knows how many frames of the robot's session were answered."""

    robot_session, count = "", 0

    def decides(self, header, answer):
        if header.session != self.robot_session:
            self.robot_session, self.count = header.session, 0
            self.starts_anew()
        self.count += 1
        return answer

    def starts_anew(self):
        """A new session of the robot's."""


@breaks("V-SEQ-02", "forgets to count once")
class CountsTwice(PerSession):
    def writes(self, fields, text):
        self.puts(fields | {"seq": fields["seq"] - (self.count == 20)}, text)


@breaks("V-SEQ-03", "does not count its acks")
class AcksAlike(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields | ({"seq": 1} if text is None else {}), text)


@breaks("V-SEQ-04", "counts from one for every start of the robot")
class CountsAfresh(PerSession):
    def writes(self, fields, text):
        self.puts(fields | {"seq": self.count}, text)


@breaks("V-SEQ-05", "does not look at a robot that counts from the beginning")
class KeepsCount(BrokenVision):
    last = ("", 0)

    def decides(self, header, answer):
        if header.seq < 100 and self.last[1] > 1_000 and header.session != self.last[0]:
            return PipelineAnswer(None, Observation("old"))
        self.last = (header.session, header.seq)
        return answer


@breaks("V-SEQ-06", "follows a session that is over")
class Nostalgic(BrokenVision):
    sessions = ()

    def hears(self, header, jpeg):
        try:
            known = frame_header(header)
        except ValueError:
            return header, jpeg
        if known.session in self.sessions[:-1]:
            self._publish(known, STANDING, 0)
            return None
        if known.session not in self.sessions:
            self.sessions = (*self.sessions, known.session)
        return header, jpeg


@breaks("V-SEQ-07", "counts by the microsecond since 1970")
class CountsTheTime(BrokenVision):
    def writes(self, fields, text):
        self.puts(fields | {"seq": 1_800_000_000_000_000 + self.now_us}, text)


# --- proofs ----------------------------------------------------------------------------------------------------------


class OwnProofs(BrokenVision):
    """Gets its proofs from `next`."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.chain, self.sender.proofs = self.sender.proofs, self


@breaks("V-PROOF-01", "proof is random")
class RandomProof(OwnProofs):
    def next(self):
        return Proof(secrets.token_hex(16))


@breaks("V-PROOF-02", "continues in another chain than the one that it announced")
class OtherChain(OwnProofs):
    def next(self):
        proof = self.chain.next()
        return proof._replace(next_proof=proof.next_proof and proof.next_proof[::-1])


@breaks("V-PROOF-03", "has no proof")
class NoProof(OwnProofs):
    def next(self):
        return NO_PROOF
