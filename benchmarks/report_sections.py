"""What the performance page shows: each section's command, and why it is there. Pure."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Section:
    """One command of the page and why it is there; `name` is what `--section` calls it.

    With a `picture` the command gets `--out`, and its loop.png is shown under that name.
    """

    name: str
    title: str
    why: str
    arguments: tuple[str, ...]
    picture: str = ""


_SEEDS: Final = "201,202,203,204,205,206"
_BALLS: Final = "behind,circle,eight,pushed,static,walls"
"""All others are on docs/behaviours.md."""


def _rows(*names: str, extra: tuple[str, ...] = (), seconds: int = 60) -> tuple[str, ...]:
    only = [part for name in names for part in ("--only", name)]
    return ("bench", "network", *only, *extra, "--seconds", f"{seconds}")


SECTIONS: Final = (
    Section(
        "following",
        "Following, in virtual time",
        "The services' own logic in lockstep with the simulated world; scored from world truth, judged by the worst "
        "run. Seeds that nothing was tuned on; loss is on each leg.",
        ("score", "--scenario", _BALLS, "--seeds", _SEEDS, "--latency-ms", "50", "--loss", "0.1"),
    ),
    Section(
        "eight",
        "A figure of eight under latency",
        "Added latency from capture to command, half on each leg. At 400 ms no frame is young enough: the robot is to "
        "stand still.",
        ("score", "--scenario", "eight", "--seeds", _SEEDS, "--latency-ms", "0,100,200,400", "--loss", "0.1"),
    ),
    Section(
        "demo",
        "The same in real time",
        "`sightline demo`: real processes over Zenoh. The median of six seeds is held against the bounds above x 1.5; "
        "every run's recorded frames, replayed through a fresh pipeline, must give the twists that were on the wire.",
        ("bench", "demo", "--scenario", _BALLS, "--seeds", _SEEDS, "--seconds", "12"),
    ),
    Section(
        "killed",
        "Killed at speed",
        "Vision and the network process, killed with -9 while driving at 0.3 m/s or more, ten times each; judged "
        "from the simulated motors' own log. [faults.md](faults.md) has more faults.",
        ("faults", "--only", "vision.kill", "--only", "network.kill", "--only", "vision.restart", "--repeat", "10"),
    ),
    Section("odometry", "Odometry", "Against the simulated world's truth.", ("bench", "odometry")),
    Section("gate", "Gate", "One command judged and one step decided.", ("bench", "gate")),
    Section("messages", "Messages", "Encode and decode, hot.", ("bench", "codec")),
    Section(
        "vision",
        "Vision",
        "`Pipeline.step`, decoding included, and the learned detector's network: hot, one thread. Medians are judged; "
        "the best round of a dozen frames is what it takes when a shared machine is least disturbed.",
        ("bench", "pipeline"),
    ),
    Section(
        "loop",
        "The whole loop",
        "Capture to the driver's verdict over Zenoh, robot and vision in their own processes on this machine, beside "
        "the floor (the same pipeline in one process, paced the same), bare TCP, and what others build, on the same "
        "pictures in the same run. On loopback transports tie: what is compared is what a user gets. Peers see as the "
        "older write-ups do, with OpenCV's whole-picture pipeline; `+our eyes` shows a peer's transport alone, with "
        "Sightline's pipeline in it and without credit, age or a gate, and is not judged.",
        ("bench", "loop", "--seconds", "15"),
        "loop-zenoh.png",
    ),
    Section(
        "loop-websocket",
        "The whole loop over WebSocket",
        "The same with `sightline.v1` between robot and vision.",
        ("bench", "loop", "--transport", "websocket", "--seconds", "15"),
        "loop-websocket.png",
    ),
    Section(
        "loop-slow",
        "A detector of 80 ms",
        "Every detector waits 80 ms longer, as for an accelerator, while 30 pictures a second come. Age must stay "
        "flat.",
        ("bench", "loop", "--detector-delay-ms", "80", "--seconds", "60"),
        "loop-slow.png",
    ),
    Section(
        "loop-overload",
        "A colour detector, overloaded twice by the frame rate",
        "60 pictures a second for detectors that work 33.3 ms on each: the robot takes at most 240 a second, which the "
        "pipeline as it is keeps up with, so that every detector repeats its own work instead.",
        ("bench", "loop", "--overload", "2", "--fps", "60", "--seconds", "60"),
        "loop-overload.png",
    ),
    Section(
        "watchers",
        "Viewers",
        "Ten viewers of the control stream itself, one of whom never reads and one reads once a second, and what they "
        "cost whoever drives.",
        ("bench", "watchers", "--viewers", "10", "--seconds", "60"),
    ),
    Section(
        "watchers-websocket",
        "Viewers over WebSocket",
        "The same with `sightline.v1`.",
        ("bench", "watchers", "--transport", "websocket", "--viewers", "10", "--seconds", "60"),
    ),
    Section(
        "network",
        "Slow and lossy networks",
        "Robot and vision, as two machines would have them, in two network namespaces; every packet goes over a wire "
        "that loses and slows it. Ages are from capture to the accepted command. Where packets are lost, five seeds, "
        "each demand as the worst of them fared.",
        _rows("radio", "bursts", "thin", "through", "step", "rise", extra=("--seeds", "1,2,3,4,5")),
    ),
    Section(
        "network-far",
        "Far and broken networks",
        "The same wire with nothing lost: a round trip of 2, 40 and 200 ms, five seconds without a wire, and one.",
        _rows("near", "rtt40", "rtt200", "cut", "nothing", seconds=30),
    ),
    Section(
        "network-sites",
        "Several machines",
        "The same wire. A robot stands and turns again in `standby`, `router` and `moved`, judged from what its wheels "
        "were told. In `fleet` one process plays the twenty robots, with sessions, headers and credit of their own: "
        "forty robot processes on two cores would measure themselves.",
        _rows("uplink", "standby", "router", "moved", "fleet"),
    ),
    Section(
        "network-stop",
        "STOP through a full medium",
        "One medium of 1 Mbit/s that both directions share, packet after packet, video offered at 4 Mbit/s, and a "
        "person beyond it who says STOP, resets and says it again. From the word to the simulated motors' own log.",
        ("bench", "network", "--only", "medium", "--seconds", "120"),
    ),
    Section(
        "network-websocket",
        "The same networks over WebSocket",
        "With `sightline.v1` between robot and vision; rows with a router or a fleet need Zenoh.",
        ("bench", "network", "--transport", "websocket", "--seeds", "1,2,3,4,5", "--seconds", "60"),
    ),
    Section(
        "camera",
        "Camera pass-through",
        "A V4L2 camera's own JPEGs through the plug-in, its thread included, into the network process; the device is a "
        "stand-in that gives 640x480 at 30 fps, and what it takes itself is left out.",
        ("bench", "camera", "--seconds", "60"),
    ),
    Section(
        "robot",
        "A robot without NumPy, OpenCV and PyBullet",
        "`sightline[zenoh]` in a new environment, driving in the simulation; memory is the kernel's high-water mark.",
        ("bench", "robot", "--seconds", "60"),
    ),
)
