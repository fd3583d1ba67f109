"""Robots that are wrong about who drives. Pure."""

from hashlib import sha256

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Holder, State, Twist, Verb
from sightline.protocol.proof import NO_PROOF, Proof
from sightline.robot_side.safety.lease import RANKS, Lease
from tests.conformance.robot.broken.breaking import bend_out, breaks, fields_of, wrap

STILL = Twist(linear_mps=0.0, angular_rad_s=0.0)


def lease_of(robot, **methods):
    """The gate's lease as a class of its own, with other methods."""
    gate = robot.driving.gate
    gate._lease = type("BrokenLease", (Lease,), methods)(gate._lease.life_us, gate._lease.succession_us)


def who_sends(message):
    """The holder that a message's header names."""
    fields = fields_of(message.header) or {}
    try:
        return Holder(source=fields["source"], session=fields["session"])
    except (KeyError, ValueError):
        return None


@breaks("R-LEASE-01", "R-PROOF-07")
def tells_no_holder(robot):
    bend_out(robot, "status", lambda _header, payload: payload.pop("holder", None))


@breaks("R-LEASE-02", "R-LEASE-23", "R-LEASE-25", "R-SEQ-12")
def lets_two_drive(robot):
    def may_take(self, who, now_us, proof=NO_PROOF):
        holder = self.live_holder(now_us)
        return Lease.may_take(self, who, now_us, proof) or (
            holder is not None and who.source == holder.source == "vision")

    lease_of(robot, may_take=may_take)


@breaks("R-LEASE-03")
def loser_is_not_told(robot):
    def bend(_header, payload):
        if (payload.get("last_refusal") or {}).get("reason") == "NOT_HOLDER":
            payload["last_refusal"]["detail"] = "another driver"

    bend_out(robot, "status", bend)


@breaks("R-LEASE-04", "R-LEASE-31")
def lease_lasts_two_seconds(robot):
    robot.driving.gate._lease.life_us = 2_000_000


@breaks("R-LEASE-05", "R-LEASE-25", "R-LEASE-31")
def lease_ends_at_once(robot):
    robot.driving.gate._lease.life_us = 480_000


@breaks("R-LEASE-06")
def refused_commands_renew(robot):
    def around(inner, message):
        gate, who = robot.driving.gate, who_sends(message)
        before = gate.counters["UNKNOWN_FRAME"]
        inner(message)
        if gate.counters["UNKNOWN_FRAME"] > before and gate.holder(robot.now()) == who:
            gate._lease.take(who, robot.now())

    wrap(robot, "on_twist", around)


@breaks("R-PROOF-09")
def a_proof_may_be_65_commands_ahead(robot):
    def check_proof(self, who, proof, now_us):
        try:
            Lease.check_proof(self, who, proof, now_us)
        except WireError:
            if proof.proof is None:
                raise
            before = sha256(bytes.fromhex(proof.proof)).digest()[:16].hex()
            Lease.check_proof(self, who, Proof(before), now_us)

    lease_of(robot, check_proof=check_proof)


@breaks("R-LEASE-07", "R-PROOF-01", "R-PROOF-02", "R-PROOF-03", "R-PROOF-04", "R-PROOF-07", "R-PROOF-09", "R-PROOF-11",
        "R-PROOF-12")
def acks_renew(robot):
    def around(inner, message):
        inner(message)
        gate, who = robot.driving.gate, who_sends(message)
        if who is not None and gate.holder(robot.now()) == who:
            gate._lease.take(who, robot.now())

    wrap(robot, "on_ack", around)


@breaks("R-LEASE-08")
def acks_take(robot):
    def around(inner, message):
        inner(message)
        gate, who = robot.driving.gate, who_sends(message)
        if who is not None and who.source in RANKS and not gate.counters and gate.holder(robot.now()) is None:
            gate._lease.take(who, robot.now())

    wrap(robot, "on_ack", around)


@breaks("R-LEASE-09")
def humans_wait_in_line(robot):
    def may_take(self, who, now_us, proof=NO_PROOF):
        holder = self.live_holder(now_us)
        if self.is_fenced(who) or (holder and holder.source == who.source):
            return Lease.may_take(self, who, now_us, proof)
        outranks = holder is not None and holder.source == "guest" and who.source != "guest"
        return holder is None or holder == who or outranks

    lease_of(robot, may_take=may_take)


@breaks("R-LEASE-10")
def vision_takes_from_humans(robot):
    gate = robot.driving.gate

    def may_take(self, who, now_us, proof=NO_PROOF):
        holder = self.live_holder(now_us)
        stolen = holder is not None and holder.source == "teleop" and gate.state is State.DISARMED
        return Lease.may_take(self, who, now_us, proof) or (stolen and who.source == "vision")

    lease_of(robot, may_take=may_take)


@breaks("R-LEASE-11", "R-ARM-17", "R-LEASE-28")
def lost_humans_are_not_noticed(robot):
    robot.driving.gate._notice_lost_human = lambda now_us: None


@breaks("R-LEASE-12", "R-ARM-16")
def humans_let_go_without_effect(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us):
        if who.source != "teleop" or gate.holder(now_us) != who:
            return inner(who, now_us)
        gate._lease.drop()
        return "released"

    wrap(gate, "release", around)


@breaks("R-LEASE-28")
def humans_who_only_acquired_are_not_missed(robot):
    def lost_human(self, now_us):
        return Lease.lost_human(self, now_us) and robot.driving.gate._live_commands > 0

    lease_of(robot, lost_human=lost_human)


@breaks("R-LEASE-29")
def humans_take_from_humans(robot):
    takes_from(robot, "teleop", "teleop")


@breaks("R-LEASE-30")
def guests_take_from_vision(robot):
    takes_from(robot, "guest", "vision")


def takes_from(robot, source, holder):
    """A driver of role `source` takes the lease from one of role `holder`."""
    def may_take(self, who, now_us, proof=NO_PROOF):
        live = self.live_holder(now_us)
        stolen = live is not None and (who.source, live.source) == (source, holder)
        return stolen or Lease.may_take(self, who, now_us, proof)

    lease_of(robot, may_take=may_take)


@breaks("R-LEASE-31")
def lease_lasts_a_little_longer(robot):
    robot.driving.gate._lease.life_us = 1_400_000


@breaks("R-LEASE-13")
def acquire_is_a_word(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us, *proof):
        if who.source in RANKS and gate._lease.may_take(who, now_us):
            return "acquired"
        return inner(who, now_us, *proof)

    wrap(gate, "acquire", around)


@breaks("R-LEASE-14")
def acquire_renews(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us, *proof):
        detail = inner(who, now_us, *proof)
        gate._lease.take(who, now_us, *proof)
        return detail

    wrap(gate, "acquire", around)


@breaks("R-LEASE-15")
def release_is_a_word(robot):
    wrap(
        robot.driving.gate, "release",
        lambda inner, who, now_us: "released" if who.source == "vision" else inner(who, now_us),
    )  # fmt: skip


@breaks("R-LEASE-16")
def anybody_releases(robot):
    gate = robot.driving.gate
    wrap(gate, "release", lambda inner, who, now_us: inner(gate.holder(now_us) or who, now_us))


@breaks("R-LEASE-17")
def acquire_of_an_equal(robot):
    gate = robot.driving.gate

    def around(inner, who, now_us, *proof):
        holder = gate.holder(now_us)
        return "acquired" if holder and holder.source == who.source else inner(who, now_us, *proof)

    wrap(gate, "acquire", around)


@breaks("R-LEASE-21", "R-LEASE-26")
def tokens_end_no_lease(robot):
    robot.driving.gate.end_token = lambda token, now_us: False


@breaks("R-LEASE-22")
def ended_sessions_drive_again(robot):
    lease_of(robot, _fence=lambda self, who: None)


@breaks("R-LEASE-23")
def any_token_ends_the_lease(robot):
    lease_of(robot, end_token=lambda self, token, now_us: Lease.end_token(self, self.token or token, now_us))


@breaks("R-LEASE-24")
def silent_holders_keep_the_lease(robot):
    robot.driving.gate._lease.succession_us = 10_000_000


@breaks("R-LEASE-25")
def silent_holders_yield_to_all(robot):
    def may_take(self, who, now_us, proof=NO_PROOF):
        silent_us = now_us - (self.expires_us - self.life_us)
        return Lease.may_take(self, who, now_us, proof) or (bool(self.token) and silent_us > 400_000)

    lease_of(robot, may_take=may_take)


@breaks("R-LEASE-26")
def later_proofs_have_no_token(robot):
    lease_of(robot, _known_token=lambda self, who: "")


@breaks("R-LEASE-27")
def ended_tokens_keep_no_driver_out(robot):
    lease_of(robot, has_left=lambda self, who, proof, now_us: False)


@breaks("R-LEASE-18")
def acquire_of_a_watcher(robot):
    wrap(
        robot.driving.gate, "acquire",
        lambda inner, who, now_us, *proof: inner(who, now_us, *proof) if who.source in RANKS else "acquired",
    )  # fmt: skip


# --- proof of identity -----------------------------------------------------------------------------------------------


def proofs_of(robot, check):
    """`check(lease, who, proof, now_us)`: True for a proof that is accepted; else the reference checks it."""

    def check_proof(self, who, proof, now_us):
        if not check(self, who, proof, now_us):
            Lease.check_proof(self, who, proof, now_us)

    lease_of(robot, check_proof=check_proof)


@breaks("R-PROOF-01", "R-PROOF-03", "R-PROOF-04", "R-PROOF-07", "R-PROOF-09", "R-PROOF-10", "R-PROOF-11",
        "R-PROOF-12")
def any_proof_will_do(robot):
    proofs_of(robot, lambda lease, who, proof, now_us: proof.proof is not None)


@breaks("R-PROOF-02", "R-PROOF-10", "R-PROOF-13")
def no_proof_will_do(robot):
    proofs_of(robot, lambda lease, who, proof, now_us: proof.proof is None)


@breaks("R-PROOF-14")
def acquire_commits_nothing(robot):
    wrap(robot.driving.gate, "acquire", lambda inner, who, now_us, _proof: inner(who, now_us))


@breaks("R-PROOF-15")
def requests_use_up_no_proof(robot):
    lease_of(robot, advance=lambda self, who, proof, now_us: None)


@breaks("R-PROOF-16")
def keys_demand_no_proof(robot):
    robot.driving.gate._needs_proof = False


@breaks("R-PROOF-13")
def humans_need_no_proof(robot):
    proofs_of(robot, lambda lease, who, proof, now_us: proof.proof is None and who.source == "teleop")


@breaks("R-PROOF-03")
def the_last_proof_will_do(robot):
    proofs_of(robot, lambda lease, who, proof, now_us: proof.proof is not None and proof.proof == lease.proof.proof)


@breaks("R-PROOF-04", "R-PROOF-07", "R-PROOF-10")
def forged_seq_is_used_up(robot):
    gate = robot.driving.gate

    def around(inner, who, header, now_us):
        try:
            inner(who, header, now_us)
        except WireError:
            gate._sequence.check(header, now_us)
            raise

    wrap(gate, "_check_proof", around)


@breaks("R-PROOF-05")
def each_command_must_arrive(robot):
    def check(lease, who, proof, now_us):
        if lease.live_holder(now_us) == who and proof.proof and not follows_at_once(proof.proof, lease.proof):
            raise WireError(RejectReason.NOT_PROVEN, "a command is missing")
        return False

    proofs_of(robot, check)


def follows_at_once(proof, last):
    element = bytes.fromhex(proof)
    for _ in range(20):
        element = sha256(element).digest()[:16]
        if element.hex() in last:
            return True
    return False


@breaks("R-PROOF-06")
def ignores_the_next_chain(robot):
    def take(self, who, now_us, proof=NO_PROOF):
        Lease.take(self, who, now_us, Proof(proof.proof))

    lease_of(robot, take=take)


@breaks("R-PROOF-07")
def releases_for_anyone(robot):
    gate = robot.driving.gate

    def around(inner, header, request, now_us):
        if request.verb is Verb.RELEASE:
            return gate.release(Holder(source=header.source, session=header.session), now_us)
        return inner(header, request, now_us)

    wrap(gate, "request", around)


@breaks("R-PROOF-10")
def arms_for_anyone(robot):
    gate = robot.driving.gate

    def around(inner, header, request, now_us):
        if request.verb is Verb.ARM and header.proof is None:
            return gate.arm(Holder(source=header.source, session=header.session), now_us)
        return inner(header, request, now_us)

    wrap(gate, "request", around)


@breaks("R-PROOF-11")
def the_announced_element_will_do(robot):
    proofs_of(robot, lambda lease, who, proof, now_us: proof.proof in lease.proof[1:] and proof.proof is not None)


@breaks("R-PROOF-12")
def announcements_last(robot):
    def take(self, who, now_us, proof=NO_PROOF):
        held = self.live_holder(now_us) == who
        Lease.take(self, who, now_us, proof._replace(
            next_proof=proof.next_proof or (self.proof.next_proof if held else None)))

    lease_of(robot, take=take)


@breaks("R-PROOF-08")
def shows_the_session(robot):
    def bend(_header, payload):
        holder = robot.driving.gate.holder(robot.now())
        if holder is not None:
            payload["reason"] = f"driven by {holder.session}"

    bend_out(robot, "status", bend)
