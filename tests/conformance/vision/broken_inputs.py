"""Broken vision services: too trusting or too strict with headers, pictures and cameras. Pure."""

import json
import re
from contextlib import suppress

from sightline.conformance.vision.hostile import CAMERAS, DOUBTED, READ, REJECTED
from sightline.conformance.vision.images import CAMERA, picture
from sightline.protocol.channels import SCAN, STATUS
from sightline.protocol.messages import Stamp
from tests.conformance.vision.broken import STANDING, BrokenVision, breaks, frame_header, header_of


class Guessing(BrokenVision):
    """Makes up a header from the last good header where `lenient` is true."""

    good = None

    def guessed(self, header):
        self.good = self.good | {"seq": self.good["seq"] + 1, "t_us": self.good["t_us"] + 1}
        return header_of(self.good)

    def hears(self, header, jpeg):
        if self.good is not None and self.lenient(header):
            return self.guessed(header), jpeg
        with suppress(ValueError):
            self.good = frame_header(header).model_dump()
        return header, jpeg


def fields_of(header):
    """The header as an object, or none."""
    try:
        fields = json.loads(header)
    except ValueError:
        return {}
    return fields if isinstance(fields, dict) else {}


def trusting(case, wrong, lenient):
    """Takes a broken header for a good one."""
    breaks(case, wrong)(type("Trusting", (Guessing,), {"lenient": lambda self, header: lenient(header)}))


def trusting_field(case, name, lenient):
    """Takes a broken field."""
    trusting(case, f"takes any `{name}`", lambda header: name in fields_of(header) and lenient(fields_of(header)[name]))


def lacking(case, name):
    """Can do without a field."""
    trusting(case, f"can do without `{name}`",
             lambda header: len(fields_of(header)) > 4 and name not in fields_of(header))


trusting("V-HOST-01", "needs no header", lambda header: not header)
trusting("V-HOST-02", "closes what is open", lambda header: header.startswith(b'{"v"') and header.endswith(b"]"))
trusting("V-HOST-03", "looks into lists", lambda header: header.startswith(b"[{"))
trusting("V-HOST-04", "replaces what is not UTF-8", lambda header: b"\xff\xfe" in header)
trusting("V-HOST-05", "takes a byte order mark", lambda header: header.startswith(b"\xef\xbb\xbf"))
trusting("V-HOST-06", "stops reading after the object", lambda header: header.endswith(b"}{}"))
trusting("V-HOST-24", "closes brackets", lambda header: b"[[[[" in header)
trusting_field("V-HOST-07", "v", lambda value: value == 2)
trusting_field("V-HOST-08", "v", lambda value: value == 0)
trusting_field("V-HOST-09", "v", lambda value: value == "1")
trusting_field("V-HOST-10", "seq", lambda value: isinstance(value, int) and value < 0)
trusting_field("V-HOST-11", "seq", lambda value: value == 2**53)
trusting_field("V-HOST-12", "seq", lambda value: isinstance(value, str))
trusting("V-HOST-13", "takes a real `seq`", lambda header: re.search(rb'"seq":\d+\.0\b', header))
trusting_field("V-HOST-14", "t_us", lambda value: value is True)
trusting_field("V-HOST-15", "session", lambda value: value == "ABCDEF01")
trusting_field("V-HOST-16", "session", lambda value: isinstance(value, str) and len(value) == 7)
trusting_field("V-HOST-20", "pose", lambda value: value == [0, 0])
trusting_field("V-HOST-21", "pose", lambda value: isinstance(value, list) and value[0] != value[0])
trusting_field("V-HOST-22", "pose", lambda value: value == [1e7, 0, 0])
trusting_field("V-HOST-23", "moving", lambda value: value is None)
trusting_field("V-HOST-25", "v", lambda value: value is True)
trusting_field("V-HOST-26", "v", lambda value: isinstance(value, float))
trusting_field("V-HOST-27", "applied", lambda value: len(value) == 1)
trusting_field("V-HOST-28", "latency_us", lambda value: value == -1)
trusting_field("V-HOST-29", "moving", lambda value: isinstance(value, str))
trusting("V-HOST-30", "takes an exponent in `seq`", lambda header: re.search(rb'"seq":\d+e0\b', header))
lacking("V-HOST-17", "t_us")
lacking("V-HOST-18", "seq")
lacking("V-HOST-19", "session")


# --- too strict ------------------------------------------------------------------------------------------------------


def strict(case, wrong, bad):
    """Drops a good header."""
    def hears(self, header, jpeg):
        return None if bad(header) else (header, jpeg)
    breaks(case, wrong)(type("Strict", (BrokenVision,), {"hears": hears}))


strict("V-FRAM-11", "needs odometry", lambda header: b"pose" not in header and b'"v"' in header)
strict("V-FRAM-12", "reads less than 512 bytes", lambda header: len(header) == 512)
strict("V-FRAM-13", "stumbles over null", lambda header: b'"latency_us":null' in header)
strict("V-FRAM-14", "knows all fields there are", lambda header: b"weather" in header)
strict("V-FRAM-15", "needs a version", lambda header: b'"v"' not in header and b"pose" in header)
strict("V-FRAM-17", "reads one line", lambda header: b"\n" in header)
strict("V-FRAM-18", "does not know escapes", lambda header: b"\\u" in header)
strict("V-FRAM-20", "takes 0 for nothing", lambda header: b'"seq":0,' in header)


@breaks("V-FRAM-16", "takes the first of two fields")
class FirstField(BrokenVision):
    def hears(self, header, jpeg):
        return (header[: header.index(b',"v":1')] + b"}" if header.count(b'"seq"') == 2 else header), jpeg


class Ordered(BrokenVision):
    """Stands where it should not move at all: a frame that is not newer than the last of its session."""

    last = None

    def hears(self, header, jpeg):
        try:
            known = frame_header(header)
        except ValueError:
            return header, jpeg
        last, self.last = self.last, known
        if last and last.session == known.session and self.drives_by(last.seq, last.t_us, known.seq, known.t_us):
            self._publish(known, STANDING, 0)
            return None
        return header, jpeg


def unordered(case, wrong, drives_by):
    """Answers what it should not."""
    breaks(case, wrong)(type("Unordered", (Ordered,), {"drives_by": lambda self, *four: drives_by(*four)}))


unordered("V-CAUS-08", "drives by an older frame", lambda seq, t_us, seq2, t_us2: seq2 < seq and t_us2 < t_us)
unordered("V-CAUS-09", "drives twice by one frame", lambda seq, t_us, seq2, t_us2: seq2 == seq and t_us2 == t_us)
unordered("V-CAUS-10", "compares only `seq`", lambda seq, t_us, seq2, t_us2: seq2 > seq and t_us2 < t_us)
unordered("V-CAUS-11", "drives by a frozen camera", lambda seq, t_us, seq2, t_us2: seq2 > seq and t_us2 == t_us)


class Leaping(Ordered):
    """Does not answer what leaps."""

    def _publish(self, header, answer, compute_us):
        if answer is not STANDING:
            super()._publish(header, answer, compute_us)


def leaping(case, wrong, too_far):
    """Drops a frame that leaps."""
    breaks(case, wrong)(type("Leaping", (Leaping,), {"drives_by": lambda self, *four: too_far(*four)}))


leaping("V-CAUS-13", "waits for what was never sent", lambda seq, t_us, seq2, t_us2: seq2 - seq > 50)


class Believing(Leaping):
    """Believes in a time that lies ahead, so that earlier frames are old from then on."""

    newest_us = 0

    def drives_by(self, _seq, t_us, _seq2, t_us2):
        least_us, most_us = self.believed_us
        self.newest_us = self.newest_us or t_us
        if least_us < t_us2 - self.newest_us < most_us:
            self.newest_us = t_us2
        return t_us2 < self.newest_us - 1_000_000


breaks("V-CAUS-14", "believes in an hour")(type("Believing", (Believing,), {"believed_us": (3_000_000_000, 10**14)}))
breaks("V-CAUS-15", "believes in any time")(type("Believing", (Believing,), {"believed_us": (10**14, 2**63)}))


breaks("V-CAUS-20", "believes in a minute")(type("Believing", (Believing,), {"believed_us": (6_000_000, 60_000_000)}))


class LargestSeq(BrokenVision):
    """Drops each frame that is not above the largest `seq`, which may leap by a number in `believed`."""

    newest = ("", 0)

    def hears(self, header, jpeg):
        with suppress(ValueError):
            known = frame_header(header)
            leap, (least, most) = known.seq - self.newest[1], self.believed
            if known.session != self.newest[0] or 0 < leap <= 1_000 or least < leap < most:
                self.newest = known.session, known.seq
            elif leap <= 0:
                return None
        return header, jpeg


breaks("V-CAUS-16", "believes in any `seq`")(type("AnySeq", (LargestSeq,), {"believed": (10**9, 2**53)}))
breaks("V-CAUS-21", "believes in a million of `seq`")(type("Million", (LargestSeq,), {"believed": (1_000, 10**6)}))


@breaks("V-CAUS-17", "bans each session that it left")
class Bans(BrokenVision):
    session, left = "", frozenset()

    def hears(self, header, jpeg):
        with suppress(ValueError):
            known = frame_header(header).session
            if known in self.left:
                return None
            self.left |= {self.session} - {known}
            self.session = known
        return header, jpeg


class BelievesStamps(BrokenVision):
    """Drops each frame from before the newest message of `believed`, of the same session."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.newest_us = {}
        self.link.subscribe(self.believed, self.on_stamp)

    def on_stamp(self, message):
        with suppress(ValueError):
            stamp = Stamp.model_validate_json(message.header)
            self.newest_us[stamp.session] = max(stamp.t_us, self.newest_us.get(stamp.session, 0))

    def hears(self, header, jpeg):
        with suppress(ValueError):
            known = frame_header(header)
            if known.t_us < self.newest_us.get(known.session, 0) - 1_000_000:
                return None
        return header, jpeg


breaks("V-CAUS-18", "believes the time of a status")(type("BelievesStatus", (BelievesStamps,), {"believed": STATUS}))
breaks("V-CAUS-19", "believes the time of a scan")(type("BelievesScan", (BelievesStamps,), {"believed": SCAN}))


# --- pictures and cameras --------------------------------------------------------------------------------------------


def seeing(case, wrong, odd, instead):
    """Takes one picture for another."""
    def hears(self, header, jpeg):
        fooled = jpeg == odd and self._camera is not None and self._camera.width_px == CAMERA.width_px
        return header, (instead if fooled else jpeg)
    breaks(case, wrong)(type("Seeing", (BrokenVision,), {"hears": hears}))


for _id, (_title, _jpeg) in (REJECTED | DOUBTED).items():
    seeing(_id, f"drives by this: {_title}", _jpeg(), picture("left"))
for _id, (_, _title, _, _jpeg) in READ.items():
    seeing(_id, f"not so: {_title}", _jpeg(), b"")


class Fragile(BrokenVision):
    """Ends for good when it has met everything in `fatal`."""

    def hears(self, header, jpeg):
        self.met = getattr(self, "met", set()) | {one for one, fits in self.fatal.items() if fits(header, jpeg)}
        if len(self.met) == len(self.fatal):
            self.dead = True
            return None
        return header, jpeg


def fragile(case, wrong, **fatal):
    """Ends for good after some frames."""
    breaks(case, wrong)(type("Fragile", (Fragile,), {"fatal": fatal}))


fragile("V-LIM-31", "has met a PNG and a text, and is done", png=lambda header, jpeg: jpeg.startswith(b"\x89"),
        text=lambda header, jpeg: jpeg == b"0.5000|0.0000")
fragile("V-HOST-31", "has met a list and a byte order mark, and is done",
        array=lambda header, jpeg: header.startswith(b"[{"), mark=lambda header, jpeg: header.startswith(b"\xef"))
fragile("V-HOST-33", "flies off its map", far=lambda header, jpeg: b"1000000" in header and b"-1000000" in header)


@breaks("V-HOST-32", "counts broken headers to thirty, and is done")
class Patient(BrokenVision):
    broken = 0

    def hears(self, header, jpeg):
        try:
            frame_header(header)
        except ValueError:
            self.broken += 1
        self.dead = self.broken >= 30
        return header, jpeg


@breaks("V-LIM-32", "decodes every scan")
class Thorough(BrokenVision):
    def hears(self, header, jpeg):
        if jpeg.count(b"\xff\xda") > 100:
            self.busy_until_us = self.now_us + 3_000_000
        return header, jpeg


def believing(case, wrong, payload, differs):
    """Believes one bad camera."""
    def believes(self, message):
        fields = fields_of(message.header)
        return message.payload == payload and all(fields.get(name) == value for name, value in differs.items())
    breaks(case, wrong)(type("Believing", (BrokenVision,), {"believes": believes}))


for _id, (_title, _, _payload, _differs) in CAMERAS.items():
    believing(_id, f"believes this: {_title}", _payload, _differs)


@breaks("V-HOST-51", "looks through an absurd lens, and is done")
class Dizzy(BrokenVision):
    def believes(self, message):
        self.dead = self.dead or fields_of(message.payload).get("fx_px") == 1e-3
        return False


class Eavesdropping(BrokenVision):
    """Takes frames that its link turns away."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        receive = self.link.receive

        def hears_all(key, header, payload):
            if self.overhears(key):
                key = f"sightline/{robot}/frame"
            receive(key, header, payload)

        self.link.receive = hears_all
        matched = self.link.subscribes_to
        self.link.subscribes_to = lambda key: self.overhears(key) or matched(key)


for _id, _key in (("V-HOST-61", "sightline/*/frame"), ("V-HOST-62", "sightline/xr1/frame"), ("V-HOST-63", "**")):
    breaks(_id, f"takes what comes under {_key}")(
        type("Eavesdropping", (Eavesdropping,), {"overhears": lambda self, key, mine=_key: key == mine}))
