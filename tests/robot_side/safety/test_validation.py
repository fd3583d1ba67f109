"""Every number of what the gate remembers (frames, pictures, sequence numbers): at it, before, after."""

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import AnswerHeader, Echo, Holder, Twist
from sightline.robot_side.safety.validation import (
    CommandResult,
    FreshnessRecord,
    IssuedRecord,
    RepeatRecord,
    SequenceRecord,
)

ROBOT, OTHER = "0000aaaa", "0000cccc"
VISION, OTHER_VISION = Holder(source="vision", session="0000bbbb"), Holder(source="vision", session="0000cccc")
HUMAN, OTHER_HUMAN = Holder(source="teleop", session="0000dddd"), Holder(source="teleop", session="0000eeee")
GUEST = Holder(source="guest", session="00000000")


def echo(seq=7, t_us=1_000, *, channel="frame", session=ROBOT):
    return Echo(channel=channel, session=session, seq=seq, t_us=t_us)


def refusal(judge, *args):
    with pytest.raises(WireError) as caught:
        judge(*args)
    return caught.value


# --- result ------------------------------------------------------------------------------------------------------


def test_result_without_a_reason_is_accepted():
    assert CommandResult(None).accepted and CommandResult(None) == CommandResult(None, "", None)
    assert not CommandResult(RejectReason.STALE).accepted


# --- issued frames -----------------------------------------------------------------------------------------------


def issued(*frames, channel="frame"):
    record = IssuedRecord(ROBOT)
    for seq, t_us in frames:
        record.add(channel, seq, t_us)
    return record


@pytest.mark.parametrize(
    ("age_us", "reason"),
    [(-1, RejectReason.FROM_FUTURE), (0, None), (1, None), (399, None), (400, None), (401, RejectReason.STALE)],
)
def test_age_is_from_now_up_to_the_limit(age_us, reason):
    record = issued((7, 1_000))
    if reason is None:
        assert record.age_us(echo(), 1_000 + age_us, 400) == age_us
    else:
        assert refusal(record.age_us, echo(), 1_000 + age_us, 400).reason is reason


def test_rejection_of_an_age_contains_the_milliseconds():
    record = issued((7, 1_000_000))
    assert refusal(record.age_us, echo(t_us=1_000_000), 999_000 - 1_000_000 + 1_000, 400).detail == (
        "cites frame 7, 1000 ms in the future"
    )
    assert refusal(record.age_us, echo(t_us=1_000_000), 1_500_000, 400_000).detail == (
        "frame 7 is 500 ms old, at most 400"
    )


@pytest.mark.parametrize("cited", [echo(6), echo(8), echo(t_us=999), echo(t_us=1_001), echo(channel="status")])
def test_only_exactly_issued_frames_are_known(cited):
    assert refusal(issued((7, 1_000)).age_us, cited, 1_000, 400).reason is RejectReason.UNKNOWN_FRAME


def test_only_this_session_counts():
    error = refusal(issued((7, 1_000)).age_us, echo(session=OTHER), 1_000, 400)
    assert error.reason is RejectReason.OTHER_SESSION and OTHER in error.detail and ROBOT in error.detail


@pytest.mark.parametrize(("count", "first_is_known"), [(255, True), (256, True), (257, False)])
def test_256_frames_are_kept_per_channel(count, first_is_known):
    record = issued(*((seq, 1_000) for seq in range(count)))
    record.add("status", 0, 5)
    if first_is_known:
        assert record.age_us(echo(0), 1_000, 0) == 0
    else:
        assert refusal(record.age_us, echo(0), 1_000, 0).reason is RejectReason.UNKNOWN_FRAME
    assert record.age_us(echo(1), 1_000, 0) == record.age_us(echo(count - 1), 1_000, 0) == 0


def test_the_newest_seq_is_per_channel_and_minus_one_before_the_first():
    record = issued((7, 1_000), (9, 1_000))
    assert (record.last_seq("frame"), record.last_seq("status")) == (9, -1)


# --- what a request cites ------------------------------------------------------------------------------------------


def status(seq, t_us=0, channel="status", session=ROBOT):
    return Echo(channel=channel, session=session, seq=seq, t_us=t_us)


@pytest.mark.parametrize("cited", [None, status(0, channel="frame"), status(0, channel="beat")])
def test_a_request_cites_a_status(cited):
    record = IssuedRecord(ROBOT)
    record.add("frame", 0, 0)
    with pytest.raises(WireError) as caught:
        record.check_request(cited, 0, 100)
    assert caught.value.reason is RejectReason.MALFORMED
    assert caught.value.detail == "a request that permits motion must cite a status"


@pytest.mark.parametrize(
    ("now_us", "reason"), [(0, None), (100, None), (101, RejectReason.STALE), (-1, RejectReason.FROM_FUTURE)]
)
def test_status_of_a_request_is_validated_like_a_frame(now_us, reason):
    record = IssuedRecord(ROBOT)
    record.add("status", 0, 0)
    try:
        record.check_request(status(0), now_us, 100)
    except WireError as error:
        assert error.reason is reason
    else:
        assert reason is None


@pytest.mark.parametrize(("seq", "denied"), [(4, True), (5, True), (6, False)])
def test_a_request_from_before_a_denial_is_stale(seq, denied):
    record = IssuedRecord(ROBOT)
    for number in range(6):
        record.add("status", number, 0)
    record.add("frame", 9, 0)
    record.deny_earlier()
    record.add("status", 6, 0)
    try:
        record.check_request(status(seq), 0, 100)
    except WireError as error:
        assert denied and error.reason is RejectReason.STALE
        assert error.detail == "cites a status from before the last STOP or disarm; repeat the request"
    else:
        assert not denied


def test_the_first_status_may_be_cited():
    record = IssuedRecord(ROBOT)
    record.add("status", 0, 0)
    record.check_request(status(0), 0, 100)
    record = IssuedRecord(ROBOT)
    record.deny_earlier()
    record.add("status", 0, 0)
    record.check_request(status(0), 0, 100)


# --- pictures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pictures", "unchanged_us"),
    [
        ([], 0),
        ([(10, 5)], 0),
        ([(10, 5), (30, 5)], 20),
        ([(10, 5), (30, 5), (60, 5)], 50),
        ([(10, 5), (30, 6)], 0),
        ([(10, 5), (30, 6), (60, 6)], 30),
        ([(10, 5), (30, 6), (60, 5)], 30),
        ([(10, 5), (30, 6), (60, 5), (90, 6)], 60),
        ([(10, 5), (30, 6), (60, 5), (90, 7)], 0),
        ([(10, 0), (30, 0)], 0),
        ([(10, 5), (30, 0), (60, 5)], 30),
        ([(10, 1), (30, 1)], 20),
        ([(10, -1), (30, -1)], 20),
    ],
)
def test_an_image_is_unchanged_since_it_was_first_seen(pictures, unchanged_us):
    record = FreshnessRecord()
    for t_us, fingerprint in pictures:
        record.add(t_us, fingerprint)
    assert record.unchanged_us() == unchanged_us


@pytest.mark.parametrize(("buffers", "unchanged_us"), [(2, 2_000), (255, 2_000), (256, 2_000), (257, 0)])
def test_a_camera_that_repeats_up_to_256_images_is_frozen(buffers, unchanged_us):
    record = FreshnessRecord()
    for index in range(buffers + 2_000):
        record.add(index, 1 + index % buffers)
    assert record.unchanged_us() == unchanged_us


@pytest.mark.parametrize(
    ("pictures", "t_us", "since_us"),
    [
        ([], 5, 5),
        ([(10, 7)], 10, 10),
        ([(10, 7)], 9, 9),
        ([(10, 7)], 11, 11),
        ([(10, 7), (20, 7)], 20, 10),
        ([(10, 7), (20, 7), (30, 8)], 20, 10),
        ([(10, 7), (20, 8), (30, 7)], 30, 10),
        ([(10, 7), (20, 7), *((at_us, 8) for at_us in range(21, 276))], 20, 10),
        ([(10, 7), (20, 7), *((at_us, 8) for at_us in range(21, 277))], 20, 20),
        ([(10, 7), *((at_us, at_us) for at_us in range(11, 266)), (300, 7)], 300, 10),
        ([(10, 7), *((at_us, at_us) for at_us in range(11, 267)), (300, 7)], 300, 300),
        ([(10, 7), (20, 8)], 20, 20),
        ([(10, 7), (20, 8)], 15, 15),
        ([(10, 0), (20, 0)], 20, 20),
    ],
)
def test_image_of_a_frame_is_as_old_as_its_first_copy(pictures, t_us, since_us):
    record = FreshnessRecord()
    for at_us, fingerprint in pictures:
        record.add(at_us, fingerprint)
    assert record.shown_since_us(t_us) == since_us


# --- sequence numbers --------------------------------------------------------------------------------------------

FIRST_SEQ, JUMP, MEMORY_US = 2**32, 2**20, 10_000_000


def header(seq, session="0000bbbb", source="vision"):
    return AnswerHeader(source=source, session=session, seq=seq, echo=echo())


def used(*headers, now_us=0, held=False):
    record = SequenceRecord()
    for one in headers:
        record.check(one, now_us)
        if held:
            record.promote((one.source, one.session))
    return record


@pytest.mark.parametrize(
    ("first", "then", "accepted"), [(0, 0, False), (0, 1, True), (5, 4, False), (5, 5, False), (5, 6, True)]
)
def test_sequence_numbers_only_grow(first, then, accepted):
    record = used(header(first))
    if accepted:
        record.check(header(then), 0)
    else:
        error = refusal(record.check, header(then), 0)
        assert error.reason is RejectReason.OUT_OF_ORDER
        assert error.detail == f"seq {then} of vision is not newer than {first}"


@pytest.mark.parametrize(
    ("record", "seq", "accepted"),
    [
        (used(), FIRST_SEQ, True), (used(), FIRST_SEQ + 1, False), (used(), 2**52, False),
        (used(header(7)), 7 + JUMP, True), (used(header(7)), 8 + JUMP, False), (used(header(7)), 2**52, False),
        (used(header(FIRST_SEQ)), FIRST_SEQ + JUMP, True),
    ],
)  # fmt: skip
def test_jump_of_a_sequence_number_is_bounded(record, seq, accepted):
    if accepted:
        record.check(header(seq), 0)
    else:
        error = refusal(record.check, header(seq), 0)
        assert error.reason is RejectReason.OUT_OF_ORDER
        assert error.detail == f"seq {seq} of vision jumps too far; start a new session"


def test_rejected_number_is_not_stored():
    record = used(header(5))
    refusal(record.check, header(3), 0)
    refusal(record.check, header(5 + JUMP + 1), 0)
    assert refusal(record.check, header(4), 0).detail == "seq 4 of vision is not newer than 5"
    record.check(header(6), 0)


def test_each_source_and_session_counts_for_itself():
    record = used(header(5))
    for sender in [("0000cccc", "vision"), ("0000bbbb", "teleop")]:
        record.check(header(0, *sender), 0)


@pytest.mark.parametrize(
    ("silent_us", "remembered"), [(MEMORY_US - 1, True), (MEMORY_US, True), (MEMORY_US + 1, False)]
)
def test_silent_sender_is_remembered_for_ten_seconds(silent_us, remembered):
    # A frame that old is STALE, so nothing of that sender can be replayed.
    record = used(header(5), now_us=1_000)
    if remembered:
        refusal(record.check, header(5), 1_000 + silent_us)
    else:
        record.check(header(5), 1_000 + silent_us)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(("others", "remembered"), [(62, True), (63, True), (64, False)])
def test_64_senders_of_each_kind_are_remembered(others, remembered, held):
    record = used(header(5), *(header(5, f"{index:08x}") for index in range(others)), held=held)
    if remembered:
        refusal(record.check, header(5), 0)
    else:
        record.check(header(5), 0)


@pytest.mark.parametrize("held", [False, True])
def test_the_longest_silent_sender_is_forgotten_first(held):
    senders = [header(5, f"{index:08x}") for index in range(64)]
    record = used(*senders, header(6, "00000000"), header(5, "0000ffff"), held=held)
    refusal(record.check, header(6, "00000000"), 0)
    record.check(header(5, "00000001"), 0)


def test_rejected_senders_evict_no_driver():
    record = used(header(5), held=True)
    for index in range(1_000):
        record.check(header(5, f"{index:08x}"), 0)
    refusal(record.check, header(5), 0)


def test_promoted_sender_counts_on():
    record = used(header(5), header(6, "0000cccc"))
    record.promote(("vision", "0000bbbb"))
    record.promote(("vision", "0000dddd"))
    refusal(record.check, header(5), 0)
    refusal(record.check, header(6, "0000cccc"), 0)
    record.check(header(6), 0)
    record.promote(("vision", "0000bbbb"))
    refusal(record.check, header(6), 0)
    record.check(header(0, "0000dddd"), 0)


def test_a_repeated_command_counts_from_the_first_until_it_changes():
    record, ahead = RepeatRecord(), Twist(linear_mps=0.2, angular_rad_s=0.0)
    record.add(ahead, 1_000)
    record.add(ahead, 3_000)
    assert [record.is_over(500, 1.0, now_us) for now_us in (1_499, 1_500, 1_501)] == [False, False, True]
    record.drive(-0.5, 1_000_000)
    record.drive(0.25, 2_000_000)
    assert [record.is_over(10_000, most_m, 3_000) for most_m in (0.999, 1.0)] == [True, False]
    record.add(Twist(linear_mps=0.2, angular_rad_s=0.1), 5_000)
    assert not record.is_over(0, 0.0, 5_000)
    assert record.is_over(0, 0.0, 5_001)


def test_before_the_first_command_without_a_header_time_and_distance_are_zero():
    record = RepeatRecord()
    assert [record.is_over(5, 0.0, now_us) for now_us in (5, 6)] == [False, True]
    assert [record.is_over(9, most_m, 0) for most_m in (-0.001, 0.0)] == [True, False]
    record.drive(1.0, 1_000_000)
    assert [record.is_over(9, most_m, 0) for most_m in (0.999, 1.0)] == [True, False]
