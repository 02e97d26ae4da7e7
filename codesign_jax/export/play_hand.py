"""Plays the arm and the chambers of an export together, from one clock.

    python play_hand.py                                # lines of text on standard output, in time
    python play_hand.py --valves /dev/ttyUSB0 --arm 127.0.0.1:5005
    python play_hand.py --arm 127.0.0.1:5005 --no-valves                  # the arm alone
    python play_hand.py commands.csv --slow 2          # with the shaking, at half of the speed

The arm's table is commands_still.csv beside this program: the grasp without the shaking that tests
it in the simulation, which commands.csv has.  The pressures are those of valves.csv.

Every 10 ms (--period) the arm gets its pose as a datagram (UDP) of ASCII text: time [s], position
of the arm frame [mm], and its orientation as a unit quaternion w, x, y, z, in the table's frame:

    2.750,51.599120,-56.640035,45.071204,0.811290107,0.421470092,0.353369013,0.198250044

A program beside the arm's driver takes the newest datagram as the arm's target.  Every 50 ms the
valves get a line as play_valves.py has it, and at the end zeros.  On standard output a line
begins with "arm," or "valves,".

The player waits for Enter.  Where standard input is no terminal it refuses to start, unless
--no-prompt is given.  Ctrl-C, SIGTERM and SIGHUP (a terminal that closes, a lost connection) end
it with zeros for the valves.

Corners of the path are rounded: a pose is the mean of those within --smooth seconds around it, so
that a jump of the speed becomes an acceleration; the path begins half of that before time 0.  The
poses are checked as they are sent, after --slow, --period and --smooth: a path that is faster
than the limits is refused.
Their defaults: 250 mm/s, the number of the reduced speed of ISO 10218-1, and 13 m/s^2, 2.5 rad/s
and 25 rad/s^2, the limits of a Franka Emika Panda.  The standard has that speed for manual mode
with an enabling device in a person's hand: it does not make this program safe to stand by.
"""

import argparse
import contextlib
import csv
import math
import socket
import sys
import time
from pathlib import Path

try:
    import play_valves
except ImportError:  # within the package
    from codesign_jax.export import play_valves

TableError = play_valves.TableError
POSE = ("arm_x_mm", "arm_y_mm", "arm_z_mm", "arm_qw", "arm_qx", "arm_qy", "arm_qz")
LIMITS = {
    "speed": (250.0, "mm/s"),
    "acceleration": (13000.0, "mm/s²"),
    "turn": (143.0, "°/s"),
    "turn-acceleration": (1432.0, "°/s²"),
}
"""Largest speeds and accelerations of the arm by the names of their flags, with units."""
SMOOTH = 0.1
"""Time over which poses are averaged [s] [chosen]: less than the wrist's own period of 0.4 s."""

PERIOD = 0.01
"""Time between the poses that are sent [s]."""


def read(path):
    """Rows (time [s], x, y, z [mm], quaternion w, x, y, z) of a table of commands."""
    rows = []
    with open(path, newline="", encoding="utf-8") as file:
        for number, cells in enumerate(csv.DictReader(file), 2):
            try:
                row = [float(cells[name]) for name in ("time_s", *POSE)]
            except (KeyError, TypeError, ValueError):
                raise TableError(f"{path}, line {number}: no time and pose of an arm") from None
            if not all(map(math.isfinite, row)):
                raise TableError(f"{path}, line {number}: a number is not finite")
            if abs(math.hypot(*row[4:]) - 1) > 1e-3:
                raise TableError(f"{path}, line {number}: the quaternion is no unit quaternion")
            if rows and row[0] <= rows[-1][0]:
                raise TableError(f"{path}, line {number}: times must rise")
            if rows and sum(a * b for a, b in zip(rows[-1][4:], row[4:], strict=True)) < 0:
                row[4:] = [-v for v in row[4:]]  # the same orientation, near the last one
            rows.append(row)
    if len(rows) < 3:
        raise TableError(f"{path} has no path: fewer than three rows")
    steps = [b[0] - a[0] for a, b in zip(rows, rows[1:], strict=False)]
    if max(steps) > 1.01 * min(steps):
        raise TableError(f"{path}: its times are not evenly spaced")
    return rows


def smoothed(rows, duration):
    """The rows with each pose as the mean over a time [s] around it.

    The rows are evenly spaced.  The means begin half of that time before the first row, and end as
    much after the last one, at rest.
    """
    step = rows[1][0] - rows[0][0]
    half = round(duration / step / 2)
    last = len(rows) - 1
    means = []
    for k in range(-half, last + half + 1):
        near = [rows[min(max(k + i, 0), last)][1:] for i in range(-half, half + 1)]
        mean = [sum(column) / len(near) for column in zip(*near, strict=True)]
        length = math.hypot(*mean[3:])
        means.append([rows[0][0] + k * step, *mean[:3], *(v / length for v in mean[3:])])
    return means


def resampled(rows, period):
    """Poses at the multiples of a period [s], linear between the rows; not of unit length."""
    first = math.floor(rows[0][0] / period)
    last = math.ceil(rows[-1][0] / period)
    times = [k * period for k in range(first, last + 1)]
    return [[time, *play_valves.at(rows, time)] for time in times]


def prepared(rows, slow, smooth, period):
    """Poses as they are sent: slowed by a factor, at each period [s], the mean over a time [s].

    The mean is over real time, after the slowing.
    """
    means = smoothed(resampled(slowed(rows, slow), period), smooth)
    # The times of `play`, to the last digit, so that no pose is interpolated again.
    return [[round(row[0] / period) * period, *row[1:]] for row in means]


def _turned(before, after):
    """The turn from one unit quaternion to the next as a rotation vector [deg], if it is small."""
    w, x, y, z = before
    a, b, c, d = after
    vector = (
        w * b - x * a - y * d + z * c,
        w * c + x * d - y * a - z * b,
        w * d - x * c + y * b - z * a,
    )
    return [math.degrees(2 * v) for v in vector]


def peaks(rows):
    """Largest speed and acceleration of rows, by the names and units of `LIMITS`."""
    step = rows[1][0] - rows[0][0]
    pairs = [*zip(rows, rows[1:], strict=False)]
    velocities = [[(q - p) / step for p, q in zip(a[1:4], b[1:4], strict=True)] for a, b in pairs]
    turned = [[v / step for v in _turned(a[4:], b[4:])] for a, b in pairs]
    values = {}
    for name, speeds in (("", velocities), ("turn", turned)):
        # At rest before the first row and after the last.
        path = [[0.0] * 3, *speeds, [0.0] * 3]
        values[name or "speed"] = max(math.hypot(*v) for v in speeds)
        values[f"{name}-acceleration".strip("-")] = max(
            math.dist(a, b) / step for a, b in zip(path, path[1:], strict=False)
        )
    return values


def slowed(rows, factor):
    """Rows of times, and of times alone, that last longer by a factor."""
    return [[factor * row[0], *row[1:]] for row in rows]


def excess(values, limits):
    """Which of a path's peaks are above the limits, in words, or None."""
    over = [name for name in LIMITS if values[name] > limits[name] * (1 + 1e-6)]
    if not over:
        return None
    return ", ".join(
        f"{values[name]:.0f} {LIMITS[name][1]} (--max-{name} {limits[name]:g})" for name in over
    )


def least_slow(rows, limits, slow, smooth, period):
    """A factor --slow, in tenths, with which `check` accepts a path; None if 100 is too fast.

    Speeds fall with the factor, accelerations at most with its square: each try goes as far as
    that, and at least a tenth further, until the poses as they are sent keep the limits.
    """
    while slow <= 100:
        values = peaks(prepared(rows, slow, smooth, period))
        if not excess(values, limits):
            return slow
        shares = {name: values[name] / limits[name] for name in LIMITS}
        roots = [v**0.5 if name.endswith("acceleration") else v for name, v in shares.items()]
        tenths = math.ceil(10 * slow * max(roots) - 1e-6)
        slow = max(tenths, math.floor(10 * slow + 1e-6) + 1) / 10
    return None


def check(rows, limits, slow, smooth, period):
    """Poses as they are sent, or an error where they are faster than the limits."""
    poses = prepared(rows, slow, smooth, period)
    words = excess(peaks(poses), limits)
    if words:
        slower = least_slow(rows, limits, slow, smooth, period)
        hint = f"try --slow {slower:g}" if slower else "no --slow to 100 is enough: raise --smooth"
        raise TableError(f"the arm would reach {words}; {hint}, or give the limits of your arm")
    return poses


def arm_line(rows, moment):
    """A pose as it is sent."""
    x, y, z, *turn = play_valves.at(rows, moment)
    length = math.hypot(*turn)
    # More digits than an arm follows: coarser steps would be accelerations within a period.
    place = [f"{v:.6f}" for v in (x, y, z)]
    return ",".join([f"{moment:.3f}", *place, *(f"{v / length:.9f}" for v in turn)]) + "\n"


def play(poses, pressures, outputs, periods, wait=time.sleep, clock=time.monotonic):
    """Sends poses and pressures in time, and zeros to the valves at the end, whatever ends it.

    Args:
      poses: Rows of the arm; None: it is left out, as with the next.
      pressures: Rows of the valves.
      outputs: What sends a line to the arm, and to the valves.
      periods: Time between the lines of the arm, and of the valves, a multiple of it [s].
    """
    to_arm, to_valves = outputs
    period = periods[0]
    every = max(1, round(periods[1] / period))
    end = max(rows[-1][0] for rows in (poses, pressures) if rows)
    first = min(0, math.floor(poses[0][0] / period)) if poses else 0
    begin = clock() - first * period
    now = 0.0
    k = first
    try:
        while (now := k * period) < end + period:
            if pressures and k >= 0 and k % every == 0:
                to_valves(play_valves.line(now, play_valves.at(pressures, now)))
            if poses:
                to_arm(arm_line(poses, now))
            k += 1
            wait(max(0.0, begin + k * period - clock()))
    finally:
        if pressures:
            to_valves(play_valves.line(now, [0.0] * (len(pressures[0]) - 1)))


@contextlib.contextmanager
def datagrams(place):
    """Yields what sends text to HOST:PORT."""
    host, _, port = place.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise TableError(f"--arm {place} is no HOST:PORT")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
    except OSError:
        raise TableError(f"--arm {place}: no such host") from None
    with socket.socket(family, kind) as sender:
        yield lambda text: sender.sendto(text.encode("ascii"), address)


def _prefixed(word):
    return contextlib.nullcontext(lambda text: play_valves.print_out(f"{word},{text}"))


def _parser():
    beside = Path(__file__).parent
    kind = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=kind)
    parser.add_argument(
        "table", nargs="?", default=beside / "commands_still.csv", help="the arm's table"
    )
    parser.add_argument("--pressures", default=beside / "valves.csv", help="the valves' table")
    parser.add_argument("--arm", metavar="HOST:PORT", help="where the arm's datagrams go")
    parser.add_argument("--valves", metavar="PORT", help="serial line of the regulators")
    parser.add_argument("--baud", type=int, default=115200)
    parser.add_argument("--no-arm", action="store_true", help="the valves alone")
    parser.add_argument("--no-valves", action="store_true", help="the arm alone")
    parser.add_argument("--period", type=float, default=PERIOD, help="time between poses [s]")
    parser.add_argument("--slow", type=float, default=1.0, help="all takes this times as long")
    parser.add_argument("--smooth", type=float, default=SMOOTH, help="time of a mean pose [s]")
    for name, (most, unit) in LIMITS.items():
        parser.add_argument(f"--max-{name}", type=float, default=most, help=f"of the arm [{unit}]")
    play_valves.add_scaling(parser)
    parser.add_argument("--no-prompt", action="store_true", help="start without Enter")
    parser.add_argument(
        "--no-wait", action="store_true", help="write all lines at once, to standard output alone"
    )
    return parser


def _flag(name):
    return f"max_{name.replace('-', '_')}"


def _tables(options):
    """Rows of the arm and of the valves as they are to be played, each None if left out."""
    if not 0.001 <= options.period <= 1:
        raise TableError("--period must be 0.001 to 1 s")
    if not 0.1 <= options.slow <= 100:
        raise TableError("--slow must be 0.1 to 100")
    for name in LIMITS:
        if not getattr(options, _flag(name)) > 0:
            raise TableError(f"--max-{name} must be above 0")
    if not 0 <= options.smooth <= 1:
        raise TableError("--smooth must be 0 to 1 s")
    if options.no_arm and options.no_valves:
        raise TableError("--no-arm and --no-valves leave nothing to play")
    if options.no_wait and (options.arm or options.valves):
        raise TableError("--no-wait is too fast for an arm and valves: leave it, or both of them")
    poses = None
    pressures = None
    if not options.no_arm:
        limits = {name: getattr(options, _flag(name)) for name in LIMITS}
        rows = read(options.table)
        poses = check(rows, limits, options.slow, options.smooth, options.period)
    if not options.no_valves:
        rows, limits = play_valves.read(options.pressures)
        scaled = play_valves.scaled(rows, limits, options.divide, options.cap)
        pressures = slowed(scaled, options.slow)
    return poses, pressures


def _started(poses, options):
    """Lets a person start at a terminal once the arm stands where its path begins."""
    if options.no_wait or options.no_prompt:
        return
    if not sys.stdin.isatty():
        raise TableError("standard input is no terminal: --no-prompt starts without Enter")
    if poses:
        print(f"the arm must stand at {arm_line(poses, poses[0][0])}", end="", file=sys.stderr)
    print("Enter starts, Ctrl-C ends and empties the chambers", file=sys.stderr)
    if not sys.stdin.readline():
        raise KeyboardInterrupt  # Ctrl-D, or the terminal is gone


def main(words=None):
    """The program; returns its exit status."""
    options = _parser().parse_args(words)
    play_valves.catch_stops()
    return play_valves.exit_status(lambda: _run(options))


def _run(options):
    wait = (lambda seconds: None) if options.no_wait else time.sleep
    poses, pressures = _tables(options)
    arm = datagrams(options.arm) if options.arm else _prefixed("arm")
    valves = (
        play_valves.serial_line(options.valves, options.baud)
        if options.valves
        else _prefixed("valves")
    )
    with arm as to_arm, valves as to_valves:
        _started(poses, options)
        play(poses, pressures, (to_arm, to_valves), (options.period, 0.05), wait)


if __name__ == "__main__":
    sys.exit(main())
