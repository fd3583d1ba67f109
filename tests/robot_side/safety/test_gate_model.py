"""The gate against a model that knows only the promises: arrivals, ticks and requests in any order and at any time."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, State, Verb
from sightline.robot_side.safety import gate as safety
from sightline.robot_side.safety.states import TRANSITIONS
from tests.fixtures.safety import HUMAN, MS, OTHER, VISION, Rig

pytestmark = pytest.mark.computes

RANK = {"guest": 0, "vision": 1, "teleop": 2}
DRIVERS = [("vision", VISION), ("vision", OTHER), ("teleop", HUMAN), ("teleop", OTHER), ("guest", OTHER)]
AGES_MS = [0, 0, 0, 20, 149.999, 150, 150.001, 200, 250, 399.999, 400, 400.001, 500, -0.001]
TICKS_MS = [1, 20, 20, 20, 20, 60, 149, 151, 299, 301, 401, 700, 999, 1000, 1001, 9_000, 10_001]
PAUSES_MS = [0, 0.001, 5, 19, 999.999, 1000, 1001]
ENDINGS = ["nothing", "fault", "another comes", "silence", Verb.STOP, Verb.DISARM, Verb.RELEASE]
OFF = (State.DISARMED, State.STOPPED, State.FAULT)


class Promises:
    """The permitted behavior, from the design alone: no ramp, no table of states, no code of the gate."""

    def __init__(self, auto_arm):
        self.off = State.DISARMED  # where the wheels are off, None while armed
        self.auto_arm = self.auto_allowed = auto_arm
        self.holder, self.until_us, self.live = None, 0, 0
        self.good = None  # (capture, arrival, life) of the newest accepted command
        self.hold_since_us = None

    def pass_time(self, now_us):
        """A human with an expired lease is lost, and the next driver does not continue."""
        if self.holder and now_us >= self.until_us:
            human, self.holder = self.holder[0] == "teleop", None
            if human and self.off is None:
                self.leave(State.DISARMED)

    def leave(self, off, auto=False):
        if self.off is not off:
            self.live, self.good = 0, None
            self.auto_allowed = self.auto_allowed and auto
        self.off, self.hold_since_us = off, None

    def verdict(self, who, age_us):
        """The reason to reject a command by `who` on a frame of `age_us`, or None for an applied one."""
        if age_us < 0:
            return RejectReason.FROM_FUTURE
        if age_us > 400_000:
            return RejectReason.STALE
        if self.off in (State.STOPPED, State.FAULT):
            return RejectReason(str(self.off))
        if self.holder not in (None, who) and RANK[who[0]] <= RANK[self.holder[0]]:
            return RejectReason.NOT_HOLDER
        return RejectReason.DISARMED if self.off else None

    def take(self, who, now_us):
        self.holder, self.until_us = who, now_us + 1_000_000

    def arm(self, now_us):
        self.off, self.good, self.hold_since_us = None, None, now_us

    def may_arm(self, rolling):
        return self.off is State.DISARMED and self.holder and self.live >= 5 and not rolling

    def state(self, now_us):
        """The state at a step."""
        if self.off:
            return self.off
        silent_us, age_us = (now_us - self.good[1], now_us - self.good[0]) if self.good else (None, None)
        if silent_us is not None and silent_us <= self.good[2] and age_us < 400_000:
            self.hold_since_us = None
            return State.ACTIVE if age_us <= 150_000 else State.DEGRADED
        self.hold_since_us = now_us if self.hold_since_us is None else self.hold_since_us
        if now_us - self.hold_since_us > 10_000_000:
            self.leave(State.DISARMED, auto=True)
            return State.DISARMED
        return State.HOLD


class Gate(RuleBasedStateMachine):
    """Drives a real gate and the promises side by side."""

    @initialize(auto_arm=st.booleans())
    def begin(self, auto_arm):
        self.rig, self.promises = Rig(auto_arm=auto_arm, guests=True), Promises(auto_arm)
        self.still_since_us = self.rig.now_us

    # --- what happens --------------------------------------------------------------------------------------------

    @rule(
        driver=st.sampled_from(DRIVERS), age_ms=st.sampled_from(AGES_MS), linear=st.sampled_from([0.5, -0.5, 0.0, 48.0])
    )
    def command(self, driver, age_ms, linear):
        now_us, promises = self.rig.now_us, self.promises
        promises.pass_time(now_us)
        expected = promises.verdict(driver, round(age_ms * MS))
        verdict = self.rig.offer(linear, 1.0, source=driver[0], session=driver[1], age_ms=age_ms)
        assert verdict.reason == expected, verdict.detail
        if expected in (None, RejectReason.DISARMED):
            promises.live = promises.live + 1 if promises.holder == driver else 1
            promises.take(driver, now_us)
        if expected is None:
            life_us = 250_000 if driver[0] == "guest" else 300_000
            promises.good = now_us - round(age_ms * MS), now_us, life_us

    @rule(after_ms=st.sampled_from(TICKS_MS))
    def tick(self, after_ms):
        before = self.rig.gate.applied
        self.rig.now_us += round(after_ms * MS)
        now_us, promises = self.rig.now_us, self.promises
        promises.pass_time(now_us)
        if promises.auto_allowed and promises.may_arm(before != STILL):
            promises.arm(now_us)
        decision = self.rig.gate.step(now_us)
        assert decision.state is promises.state(now_us), decision.reason
        self._wheels_keep_the_promises(before, decision)

    def _wheels_keep_the_promises(self, before, decision):
        moving = decision.state in (State.ACTIVE, State.DEGRADED)
        assert abs(decision.twist.linear_mps) <= 0.5 + 1e-9 and abs(decision.twist.angular_rad_s) <= 2.5 + 1e-9
        if not moving:
            assert abs(decision.twist.linear_mps) <= abs(before.linear_mps), "never faster without a young frame"
            assert abs(decision.twist.angular_rad_s) <= abs(before.angular_rad_s)
        self.still_since_us = None if moving else self.still_since_us or self.rig.now_us
        if self.still_since_us and self.rig.now_us - self.still_since_us >= 400_000:
            assert decision.twist == STILL, "the ramp from top speed takes 340 ms"

    @rule(pause_ms=st.sampled_from(PAUSES_MS))
    def pause(self, pause_ms):
        """Time passes before the driver's next tick; a command or a request may come in between."""
        self.rig.now_us += round(pause_ms * MS)

    @rule(driver=st.sampled_from(DRIVERS[:3]), age_ms=st.sampled_from([None, 0, 200]), then=st.sampled_from(ENDINGS))
    def drive_and_then(self, driver, age_ms, then):
        """The usual way to motion (None: armed, no command yet), and one thing that ends it."""
        self._bring_to_rest(driver)
        for _ in range(5):
            self.command(driver, 0, 0.0)
        self.ask(Verb.ARM, driver)
        for _ in range(3 if age_ms is not None else 0):
            self.command(driver, age_ms, 0.5)
            self.tick(20)
        if isinstance(then, Verb):
            self.ask(then, driver)
        elif then == "fault":
            self.drive_fails()
        elif then == "another comes":
            self.pause(1000)
            self.command(DRIVERS[0] if driver != DRIVERS[0] else DRIVERS[1], 0, 0.5)
        elif then == "silence":
            self.tick(1)
            self.tick(1001 if driver[0] == "teleop" else 10_001)

    def _bring_to_rest(self, driver):
        for _ in range(25):
            if self.rig.gate.applied != STILL:
                self.tick(20)
        self.ask(Verb.RESET, driver)

    @rule(
        verb=st.sampled_from(
            [Verb.STOP, Verb.RESET, Verb.RESET, Verb.ARM, Verb.ARM, Verb.ACQUIRE, Verb.RELEASE, Verb.DISARM]
        ),
        who=st.sampled_from([*DRIVERS, ("operator", OTHER)]),
    )
    def ask(self, verb, who):
        self.promises.pass_time(self.rig.now_us)
        expected = self._expected(verb, who)
        try:
            self.rig.request(verb, *who)
        except WireError:
            assert not expected
        else:
            assert expected

    @rule()
    def drive_fails(self):
        self.rig.gate.fault("broken")
        if self.promises.off is not State.STOPPED:
            self.promises.leave(State.FAULT)

    def _expected(self, verb, who):
        """Return True for a granted request, and apply its changes."""
        promises, now_us = self.promises, self.rig.now_us
        rolling = self.rig.gate.applied != STILL
        beside_human = promises.holder not in (None, who) and promises.holder[0] == "teleop"
        match verb:
            case Verb.STOP:
                promises.leave(State.STOPPED)
                return True
            case Verb.DISARM:
                if promises.off is None:
                    promises.leave(State.DISARMED)
                promises.auto_allowed = False
                return True
            case Verb.RELEASE:
                self._release(who)
                return True
            case Verb.ACQUIRE:
                granted = who[0] in RANK and (promises.holder in (None, who) or RANK[who[0]] > RANK[promises.holder[0]])
                if granted:
                    promises.live = promises.live if promises.holder == who else 0
                    promises.take(who, now_us)
                return granted
            case Verb.RESET:
                return self._reset(beside_human, rolling)
        return self._arm(beside_human, rolling, now_us)

    def _release(self, who):
        promises = self.promises
        if promises.holder == who:
            promises.holder, promises.good = None, None
            if who[0] == "teleop" and promises.off is None:
                promises.leave(State.DISARMED)

    def _reset(self, beside_human, rolling):
        latched = self.promises.off in (State.STOPPED, State.FAULT)
        if beside_human or (latched and rolling):
            return False
        if latched:
            self.promises.leave(State.DISARMED)
        return True

    def _arm(self, beside_human, rolling, now_us):
        promises = self.promises
        if beside_human:
            return False
        if promises.off is None:
            return True
        if not promises.may_arm(rolling):
            return False
        promises.arm(now_us)
        promises.auto_allowed = promises.auto_arm
        return True

    # --- what always holds ---------------------------------------------------------------------------------------

    @invariant()
    def off_where_it_should_be(self):
        state = self.rig.gate.state
        STATES.add(state)
        if self.promises.off in (State.STOPPED, State.FAULT):
            assert state is self.promises.off, "latched"
        assert self.promises.off is not None or state not in OFF

    @invariant()
    def one_driver_at_most_and_the_one_promised(self):
        holder, promised = self.rig.gate.holder(self.rig.now_us), self.promises.holder
        live = promised is not None and self.rig.now_us < self.promises.until_us
        assert (holder and (holder.source, holder.session)) == (promised if live else None)


STATES, TAKEN = set(), set()


@pytest.mark.parametrize("examples", [100, pytest.param(250, marks=pytest.mark.slow)])
def test_the_gate_keeps_its_promises_and_every_state_and_transition_was_visited(examples, monkeypatch):
    STATES.clear()
    TAKEN.clear()
    real = safety.next_state

    def recorded(state, event):
        TAKEN.add((state, event))
        return real(state, event)

    monkeypatch.setattr(safety, "next_state", recorded)
    run_state_machine_as_test(
        Gate,
        settings=settings(
            max_examples=examples, stateful_step_count=40, derandomize=True, database=None
        ),
    )
    assert set(State) == STATES
    assert set(TRANSITIONS) <= TAKEN, sorted(map(str, set(TRANSITIONS) - TAKEN))
