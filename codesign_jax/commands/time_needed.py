"""How long a command will take, in words."""

from collections.abc import Sequence
from typing import NamedTuple

from codesign_jax.runs import rates
from codesign_jax.runs.progress import duration

UNKNOWN = "time: unknown; a short run with these effects and this engine measures the rate"


class TimedPart(NamedTuple):
    """Grasps of a command that one program simulates.

    Attributes:
      name: What they are for; empty if the command has no others.
      work: What is simulated at once.
      grasps: How many.
    """

    name: str
    work: rates.Work
    grasps: int


def text(parts: Sequence[TimedPart]) -> str:
    """Lines with the time of all parts, the shares of compiling and of the named ones, and why.

    Args:
      parts: The parts; the measurement that is named is that of the first.
    """
    found = [rates.estimate(part.work) for part in parts]
    known = [f for f in found if f is not None]
    if len(known) < len(found):
        return UNKNOWN
    times = [p.grasps / f.grasps_per_second for p, f in zip(parts, known, strict=True)]
    compiling = [f.compile_seconds for f in known]
    if None in compiling:
        line = f"time: about {duration(sum(times))}, and compiling"
    else:
        total = sum(c or 0.0 for c in compiling)
        line = f"time: about {duration(sum(times) + total)}, of which {total:.0f} s to compile or "
        line += "load programs"
    named = [f"{duration(t)} for {p.name}" for p, t in zip(parts, times, strict=True) if p.name]
    return "\n".join([", ".join([line, *named]), f"based on {known[0].basis}"])
