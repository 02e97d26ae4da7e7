"""Sends the pressures of valves.csv to pressure regulators, a line of text for each period.

    python play_valves.py                        # to standard output, in time
    python play_valves.py --port /dev/ttyUSB0    # to a serial line: 8 bits, no parity, 1 stop bit
    python play_valves.py --no-wait > table.csv  # all lines at once
    python play_valves.py --port /dev/ttyUSB0 --hold 2 50    # 50 kPa in finger 2 until Ctrl-C

--hold is for the tests of one finger, of leaks and of its bend: its pressure rises within 5 s and
stays until the program is interrupted; the other fingers get zeros.

A line is the time [s] and the gauge pressure of each finger [kPa], in the order of the fingers,
with commas between and a line feed at the end, ASCII, a point as the decimal sign:

    2.750,60.000,60.000,60.000,60.000

A new line replaces the pressures of the one before.  The last line has zeros, which empty all
chambers, and comes also when the program is interrupted (Ctrl-C, SIGTERM, SIGHUP of a terminal
that closes or a lost connection) or fails.  A regulator that hears nothing for half a second should
empty its chamber by itself.

valves.csv has a row for each change, between which pressures are linear; two rows of one time are
a jump.  Needs Python alone; a serial line goes through pyserial where that is installed, and else
through the system's terminal interface (not on Windows).
"""

import argparse
import bisect
import contextlib
import csv
import math
import os
import signal
import sys
import time
from pathlib import Path


class TableError(ValueError):
    """A table of pressures that cannot be played."""


def read(path):
    """Rows (time, pressures...) of a table of pressures, and the limits of its comment, or none."""
    rows = []
    limits = []
    with open(path, newline="", encoding="utf-8") as file:
        for number, cells in enumerate(csv.reader(file), 1):
            if not cells or cells[0] == "time_s":
                continue
            try:
                if cells[0].startswith("#"):
                    limits = [float(v) for v in cells[1:]]
                    continue
                rows.append([float(v) for v in cells])
            except ValueError:
                raise TableError(f"{path}, line {number}: a cell is no number") from None
            if not all(math.isfinite(v) and v >= 0 for v in rows[-1]):
                raise TableError(f"{path}, line {number}: a number is below 0, or not finite")
            if len(rows[-1]) != len(rows[0]) or len(rows[-1]) < 2:
                raise TableError(f"{path}, line {number}: {len(cells)} cells")
            if rows[-1][0] < rows[0 if len(rows) == 1 else -2][0]:
                raise TableError(f"{path}, line {number}: times must not fall")
    if not rows:
        raise TableError(f"{path} has no rows")
    return rows, limits


def at(rows, moment):
    """Pressures at a time: linear between rows; of rows of one time the last."""
    after = bisect.bisect_right(rows, moment, key=lambda row: row[0])
    if after in (0, len(rows)):
        return rows[min(after, len(rows) - 1)][1:]
    start, *low = rows[after - 1]
    end, *high = rows[after]
    share = (moment - start) / (end - start)
    return [a + share * (b - a) for a, b in zip(low, high, strict=True)]


def scaled(rows, limits, divisors, cap=False):
    """The rows with each finger's pressure divided by its own number, or by one for all.

    Pressures above the limit of a finger's wall are refused, or cut to it with `cap`.
    """
    count = len(rows[0]) - 1
    if len(divisors) not in (1, count):
        raise TableError(f"--divide takes 1 number or {count}, not {len(divisors)}")
    divisors = divisors * count if len(divisors) == 1 else divisors
    if not all(v > 0 and math.isfinite(v) for v in divisors):
        raise TableError("--divide takes numbers above 0")
    scaled_rows = [
        [row[0], *(p / d for p, d in zip(row[1:], divisors, strict=True))] for row in rows
    ]
    for finger, limit in enumerate(limits[:count]):
        most = max(row[1 + finger] for row in scaled_rows)
        if most <= limit * (1 + 1e-6):
            continue
        if not cap:
            raise TableError(
                f"finger {finger} would get {most:.1f} kPa, and its wall stands {limit:.1f} kPa; "
                f"--cap sends no more than that, {100 * limit / most:.0f} % of the moment that it "
                "is to have; for all of it cast a thicker wall or a stiffer silicone"
            )
        for row in scaled_rows:
            row[1 + finger] = min(row[1 + finger], limit)
    return scaled_rows


RISE = 5.0
"""Time in which the pressure of a finger under test rises [s] [chosen]."""
HOLD = 24 * 3600.0
"""Longest test of a finger [s] [chosen]."""


def hold_rows(rows, finger, pressure):
    """Rows that raise one finger to a pressure [kPa] and hold it; `rows` give their number."""
    count = len(rows[0]) - 1
    if finger not in range(count):
        raise TableError(f"--hold takes a finger of 0 to {count - 1}, not {finger:g}")
    if not 0 <= pressure < math.inf:
        raise TableError("--hold takes a pressure of 0 kPa or more")
    full = [pressure * (k == finger) for k in range(count)]
    return [[0.0, *[0.0] * count], [RISE, *full], [HOLD, *full]]


def line(moment, pressures):
    """A line as it is sent."""
    return ",".join(f"{value:.3f}" for value in (moment, *pressures)) + "\n"


def play(rows, send, period, wait=time.sleep, clock=time.monotonic):
    """Sends a line for each period, and zeros at the end, whatever ends it."""
    begin = clock()
    now = 0.0
    k = 0
    try:
        while (now := k * period) < rows[-1][0] + period:
            send(line(now, at(rows, now)))
            k += 1
            wait(max(0.0, begin + k * period - clock()))
    finally:
        send(line(now, [0.0] * (len(rows[0]) - 1)))


@contextlib.contextmanager
def serial_line(port, baud):
    """Opens a serial line; yields what sends text on it."""
    try:
        import serial
    except ImportError:
        serial = None
    if serial is not None:
        with serial.Serial(port, baud, timeout=1, write_timeout=1) as device:
            yield lambda text: device.write(text.encode("ascii"))
            device.flush()
        return
    try:
        import termios
    except ImportError:
        raise OSError(0, "a serial line needs pyserial here: pip install pyserial") from None
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise OSError(0, f"--baud {baud} is no speed of this system")
    place = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        mode = termios.tcgetattr(place)
        control = mode[2] & ~(termios.CSIZE | termios.PARENB | termios.CSTOPB)
        raw = [0, 0, control | termios.CS8 | termios.CLOCAL | termios.CREAD, 0, speed, speed]
        termios.tcsetattr(place, termios.TCSANOW, [*raw, mode[6]])
        yield lambda text: os.write(place, text.encode("ascii"))
        termios.tcdrain(place)
    finally:
        os.close(place)


def add_scaling(parser):
    """The flags of `scaled`."""
    parser.add_argument(
        "--divide",
        type=float,
        nargs="+",
        default=[1.0],
        help="number by which pressures are divided, one for all fingers or one for each: the "
        "moment of the real finger as a share of the model's (codesign finger --fit)",
    )
    parser.add_argument(
        "--cap",
        action="store_true",
        help="cut pressures above the limit of a finger's wall to it, instead of refusing them",
    )


def closed_output():
    """The exit status where nobody reads standard output any more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def print_out(text):
    """Sends text to standard output at once."""
    sys.stdout.write(text)
    sys.stdout.flush()


def stop(number, frame):
    """Ends the program so that chambers are emptied first, whatever signal follows."""
    for name in _stops():
        signal.signal(name, signal.SIG_IGN)
    raise KeyboardInterrupt


def _stops():
    """Signals that end the program; Windows has no SIGHUP."""
    return [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]


def catch_stops():
    """Lets signals end the program by `stop`; what is ignored (nohup) stays ignored."""
    for name in _stops():
        if signal.getsignal(name) != signal.SIG_IGN:
            signal.signal(name, stop)


def main(words=None):
    """The program; returns its exit status."""
    beside = Path(__file__).with_name("valves.csv")
    kind = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=kind)
    parser.add_argument("table", nargs="?", default=beside, help="default: valves.csv beside this")
    parser.add_argument("--port", help="serial line, such as /dev/ttyUSB0 or COM3")
    parser.add_argument("--baud", type=int, default=115200)
    parser.add_argument("--period", type=float, default=0.05, help="time between lines [s]")
    parser.add_argument(
        "--hold",
        nargs=2,
        type=float,
        metavar=("FINGER", "KPA"),
        help="raise one finger alone to a pressure and hold it until Ctrl-C",
    )
    add_scaling(parser)
    parser.add_argument("--no-wait", action="store_true", help="send all lines at once")
    options = parser.parse_args(words)
    catch_stops()
    return exit_status(lambda: _run(options))


def exit_status(work):
    """Does a player's work and returns its exit status; an error is one line on stderr."""
    try:
        work()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return closed_output()
    except (OSError, ValueError) as error:
        print(f"error: {getattr(error, 'strerror', None) or error}", file=sys.stderr)
        return 2
    return 0


def _run(options):
    if not 0.001 <= options.period <= 10:
        raise TableError("--period must be 0.001 to 10 s")
    if options.hold and options.no_wait:
        raise TableError("--hold needs real time: leave --no-wait")
    rows, limits = read(options.table)
    if options.hold:
        rows = hold_rows(rows, *options.hold)
    rows = scaled(rows, limits, options.divide, options.cap)
    wait = (lambda seconds: None) if options.no_wait else time.sleep
    if options.port is None:
        play(rows, print_out, options.period, wait)
    else:
        with serial_line(options.port, options.baud) as send:
            play(rows, send, options.period, wait)


if __name__ == "__main__":
    sys.exit(main())
