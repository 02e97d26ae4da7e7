"""Key frames: pose of the arm frame and pressures over time, as a file that a scene names.

A value is a number, the name of a number that the design or the scene has, or a sum of such terms,
each with a factor if need be: `"zero_height + arm_z - 0.01"`, `"0.5 * pressure"`; `sums` reads it.
docs/control.md has the names.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.scene import hand as hands
from codesign_jax.scene import keypaths, schema, sums, unit_slips
from codesign_jax.scene.hand_tables import PARAMETERS, UNITS, Hand, Parameter
from codesign_jax.scene.schema import choice, table
from codesign_jax.scene.sums import Sum
from codesign_jax.types import Params

POSE = ("x", "y", "z", "roll", "pitch", "yaw")
"""Channels of the pose, in the order of `Params.arm`."""
_OF_SCENE = {
    "s": ("approach", "inflate", "lift", "disturb", "ungrasp", "release", "deflate_time"),
    "m": ("start_height", "zero_height", "arm_x", "arm_y", "arm_z"),
    "rad": ("arm_roll", "arm_pitch", "arm_yaw"),
    "Pa": ("pressure",),
}
"""Names that every scene has, by the SI unit of what may use them."""
_NAME = re.compile(r"[a-z]\w*", re.ASCII)


def _sum(unit: str, **kwargs: Any) -> Any:
    return dataclasses.field(metadata={"unit": unit}, **kwargs)


@table
@dataclasses.dataclass(frozen=True)
class Frame:
    """A key frame; what it leaves out is as in the frame before.

    What the first frame leaves out is the design's: the pose `arm_x` to `arm_yaw`, at the height
    `start_height`, with empty chambers.

    Attributes:
      time: When the frame is reached; 0 for the first one.
      x: Position of the arm frame.
      y: Position of the arm frame.
      z: Height of the arm frame above the table.
      roll: Orientation of the arm frame.
      pitch: Orientation of the arm frame; positive points the fingers towards +x.
      yaw: Orientation of the arm frame.
      pressure: Pressure of each finger. A file gives one value for all, an array with one for each,
        or a table by names of groups, whose other fingers stay as they were.
      interpolation: How the next frame is reached: linearly, or by a jump when its time has come.
    """

    time: Sum = _sum("s")
    x: Sum | None = _sum("m", default=None)
    y: Sum | None = _sum("m", default=None)
    z: Sum | None = _sum("m", default=None)
    roll: Sum | None = _sum("deg", default=None)
    pitch: Sum | None = _sum("deg", default=None)
    yaw: Sum | None = _sum("deg", default=None)
    pressure: tuple[Sum, ...] | None = _sum("Pa", default=None)
    interpolation: str = choice("linear", "held", default="linear")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ControlParameter:
    """A parameter that key frames name, which is free in every preset of the hand.

    Attributes:
      name: Its name in key frames and designs.
      unit: Unit of the numbers here, and in presets, commands and tables.
      low: Lower bound.
      high: Upper bound.
      default: Value where nothing else is given.
      per: Whether each finger has a value of its own, which only pressures may, or the hand has
        one.
    """

    name: str
    unit: str = choice(*UNITS)
    low: float
    high: float
    default: float
    per: str = choice("finger", "hand", default="hand")

    @property
    def row(self) -> Parameter:
        """The parameter as a row of the hand's table."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Parameter(domain="control", **values)


@dataclasses.dataclass(frozen=True)
class ControlFile:
    """A control file; docs/control.md shows how to write one.

    Attributes:
      name: Name of the control, as in results.
      description: What the control is, in a line.
      group: Names of groups of fingers, to which a `pressure` may refer. Fingers are counted from
        0.
    """

    name: str
    description: str
    frame: tuple[dict[str, Any], ...] = dataclasses.field(metadata={"table": Frame})
    parameter: tuple[ControlParameter, ...] = ()
    group: dict[str, Any] = dataclasses.field(default_factory=dict)


@table
@dataclasses.dataclass(frozen=True)
class Control:
    """A control file: key frames, and the parameters that they add to the hand's table.

    Attributes:
      name: Name of the control, as in results.
      description: What the control is, in a line.
      frame: The key frames, in the order of their times.
      parameter: Parameters of the control's own.
    """

    name: str
    description: str
    frame: tuple[Frame, ...]
    parameter: tuple[ControlParameter, ...] = ()

    def as_file(self) -> dict[str, Any]:
        """The content of a file that reads as this control."""
        table: dict[str, Any] = {"name": self.name, "description": self.description}
        if self.parameter:
            table["parameter"] = [dataclasses.asdict(p) for p in self.parameter]
        return table | {"frame": [_frame_table(frame) for frame in self.frame]}


def structure(control: Control) -> Control:
    """The control without what no program depends on."""
    rows = (dataclasses.replace(p, low=0.0, high=0.0, default=0.0) for p in control.parameter)
    return dataclasses.replace(control, name="", description="", parameter=tuple(rows))


def load(name: str | Path, hand: Hand, *, overrides: Mapping[Any, Any] | None = None) -> Control:
    """Reads a control and checks what does not depend on the scene's numbers; `check` does."""
    problems: list[str] = []
    table, path, key_paths = keypaths.read("controls", name, overrides, problems)
    control = _Reader(table, path.name, len(hand.finger), problems).control()
    if problems or control is None:
        raise schema.InputError(keypaths.as_given(problems, key_paths))
    return control


def read_parameters(rows: Any, where: str) -> tuple[ControlParameter, ...]:
    """Parameters from rows as those of a file, for what else than key frames has some."""
    problems: list[str] = []
    reader = _Reader({}, where, 0, problems)
    tables = [keypaths.plain(row, where) for row in rows]
    parsed = [schema.parse(ControlParameter, row, where, problems) for row in tables]
    for i, row in enumerate(parsed):
        if row is not None:
            reader.parameter(row, f"{where}[{i}]")
    if problems:
        raise schema.InputError(problems)
    return tuple(row for row in parsed if row is not None)


def with_parameters(hand: Hand, control: Control) -> Hand:
    """The hand with the control's parameters in its table."""
    return dataclasses.replace(
        hand, parameter=(*hand.parameter, *(p.row for p in control.parameter))
    )


def without_parameters(hand: Hand) -> Hand:
    """The hand as its file has it."""
    parameters = tuple(p for p in hand.parameter if p.name in PARAMETERS)
    return dataclasses.replace(hand, parameter=parameters)


# --- values over a design ------------------------------------------------------------------------


def times(scene: Any, params: Params) -> jax.Array:
    """Times of the key frames [s], shape (frame,)."""
    names = _names(scene, params)
    frame_times = [_value(frame.time, names) for frame in scene.control.frame]
    return jnp.stack([jnp.asarray(t, float) for t in frame_times])


def poses(scene: Any, params: Params, count: int | None = None, numpy: Any = jnp) -> Any:
    """Poses of the arm frame at key frames [m, rad], shape (frame, 6).

    Args:
      scene: The scene.
      params: Parameters of one hand.
      count: Number of the first frames that are taken; None for all.
      numpy: Module of the array that is returned: with NumPy, to which no traced number can be
        given, nothing is compiled.
    """
    names = _names(scene, params)
    pose: dict[str, Any] = {axis: params.arm[i] for i, axis in enumerate(POSE)}
    pose["z"] = scene.arm.start_height
    rows = []
    for frame in scene.control.frame[:count]:
        fields = {axis: getattr(frame, axis) for axis in POSE}
        pose |= {axis: _value(v, names) for axis, v in fields.items() if v is not None}
        rows.append([*pose.values()])
    dtype = params.arm.dtype
    return numpy.stack([numpy.stack([numpy.asarray(v, dtype) for v in row]) for row in rows])


def pressures(scene: Any, params: Params) -> list[tuple[Any, jax.Array]]:
    """Pressures at the key frames as terms, whose products are to be added.

    Factors are interpolated and not products: chambers that are held keep their exact pressure, and
    emptied ones have none.

    Returns:
      Named numbers [Pa], of shape (finger,) or (), and their factors, shape (frame, finger); the
      number is 1 where the factors are the numbers of the file.
    """
    names = _names(scene, params)
    dtype = jnp.result_type(params.pressure)
    rows = []
    now = [{}] * scene.num_fingers
    for frame in scene.control.frame:
        if frame.pressure is not None:
            now = [_factors(v) for v in frame.pressure]
        rows.append(now)
    used = sorted({name for row in rows for value in row for name in value})
    return [
        (
            names[name] if name else 1.0,
            jnp.array([[value.get(name, 0.0) for value in row] for row in rows], dtype),
        )
        for name in used
    ]


def first_pressure(scene: Any, params: Params) -> jax.Array:
    """Pressures with which chambers begin [Pa], shape (finger,): those that the supply reaches."""
    none = jnp.zeros_like(params.pressure)
    wanted = sum((value * factors[0] for value, factors in pressures(scene, params)), none)
    if scene.effects.pressure_dynamics:
        return jnp.minimum(wanted, scene.pneumatics.maximum)
    return wanted


def begins_empty(scene: Any) -> bool:
    """Whether the key frames begin with no pressure, whatever the design's numbers."""
    first = scene.control.frame[0].pressure or ()
    return not any(factor for total in first for factor in _factors(total).values())


def _names(scene: Any, params: Params) -> dict[str, Any]:
    values = _scene_times(scene)
    values |= {key: getattr(scene.arm, key) for key in ("start_height", "zero_height")}
    values |= {f"arm_{axis}": params.arm[i] for i, axis in enumerate(POSE)}
    return values | {"pressure": params.pressure} | (params.control or {})


def _scene_times(scene: Any) -> dict[str, Any]:
    return {**vars(scene.phases), "release": scene.window[1] - scene.phases.settle}


def _value(total: Sum, names: Mapping[str, Any]) -> Any:
    terms = ((1.0 if t.factor is None else t.factor, names[t.name]) for t in total.term)
    parts = [factor * value for factor, value in terms]
    if total.number is not None:
        parts.insert(0, total.number * (UNITS["deg"][1] if total.unit == "deg" else 1.0))
    value = parts[0] if parts else 0.0
    for part in parts[1:]:
        value = value + part
    return value


def _factors(total: Sum) -> dict[str, Any]:
    """Factors by name; that of no name is the number."""
    factors = {t.name: 1.0 if t.factor is None else t.factor for t in total.term}
    return factors if total.number is None else factors | {"": total.number}


# --- reading -------------------------------------------------------------------------------------


def _frame_table(frame: Frame) -> dict[str, Any]:
    fields = {f.name: getattr(frame, f.name) for f in dataclasses.fields(frame)}
    entries = {
        k: sums.text(v) if isinstance(v, Sum) else v for k, v in fields.items() if v is not None
    }
    if frame.pressure is not None:
        values = [sums.text(v) for v in frame.pressure]
        entries["pressure"] = values if len(set(frame.pressure)) > 1 else values[0]
    return entries


_UNITS = {f.name: f.metadata["unit"] for f in dataclasses.fields(Frame) if "unit" in f.metadata}


class _Reader:
    """Reads one file; problems are collected."""

    def __init__(self, table: Any, where: str, fingers: int, problems: list[str]):
        self.table = table
        self.where = where
        self.fingers = fingers
        self.problems = problems
        self.groups: dict[str, list[int]] = {}
        self.units = {name: unit for unit, names in _OF_SCENE.items() for name in names}

    def control(self) -> Control | None:
        """The control, or None where the file is not of its schema."""
        file = schema.parse(ControlFile, self.table, self.where, self.problems)
        if file is None:
            return None
        for i, row in enumerate(file.parameter):
            self.parameter(row, f"{self.where}.parameter[{i}]")
        for name, fingers in file.group.items():
            self._group(name, fingers)
        frames = []
        now = (Sum("Pa", 0.0),) * self.fingers
        for i, entry in enumerate(file.frame):
            frame = self._frame(entry, f"{self.where}.frame[{i}]", now)
            frames.append(frame)
            now = frame.pressure or now
        if not frames or frames[0].time != Sum("s", 0.0):
            self.problems.append(
                schema.Problem(
                    "order", f"{self.where}.frame[0].time must be 0: a grasp begins with it"
                )
            )
        return Control(file.name, file.description, tuple(frames), file.parameter)

    def parameter(self, row: ControlParameter, path: str) -> None:
        if not _NAME.fullmatch(row.name) or row.name in self.units or row.name in PARAMETERS:
            self.problems.append(
                schema.Problem(
                    "conflict",
                    f"{path}.name = {schema.shown(row.name)} must be a lower-case word not taken",
                )
            )
        if not row.low < row.high:
            self.problems.append(
                schema.Problem("order", f"{path}: low {row.low:g} must be below high {row.high:g}")
            )
        elif not row.low <= row.default <= row.high:
            key = f"{path}.default"
            why = schema.range_problem(key, row.default, row.unit, row.low, row.high)
            self.problems.append(schema.Problem("range", str(why)))
        if row.per == "finger" and UNITS[row.unit][0] != "Pa":
            self.problems.append(
                schema.Problem(
                    "unsupported", f"{path}.per = 'finger' is for pressures, not for {row.unit}"
                )
            )
        self.units[row.name] = UNITS[row.unit][0]

    def _group(self, name: str, fingers: Any) -> None:
        whole = isinstance(fingers, list) and all(type(f) is int for f in fingers)
        if not whole or not all(0 <= f < self.fingers for f in fingers):
            sentence = (
                f"{self.where}.group.{name} = {schema.shown(fingers)} must be an array of fingers, "
                f"0 to {self.fingers - 1}"
            )
            self.problems.append(schema.Problem("type", sentence))
            fingers = []
        self.groups[name] = fingers

    def _frame(self, entry: dict[str, Any], path: str, now: tuple[Sum, ...]) -> Frame:
        known = [f.name for f in dataclasses.fields(Frame)]
        values: dict[str, Any] = {"time": Sum("s", 0.0)}
        for key, value in entry.items():
            if key not in known:
                why = schema.nearest(key, known)
                self.problems.append(
                    schema.Problem(
                        "unknown", f"{path}.{schema.shown(key)[1:-1]} is not a known key; {why}"
                    )
                )
            elif key == "interpolation":
                if value not in ("linear", "held"):
                    self.problems.append(
                        schema.Problem("unknown", f"{path}.{key} must be 'linear' or 'held'")
                    )
                values[key] = value
            elif key == "pressure":
                values[key] = self._pressure(value, f"{path}.{key}", now)
            else:
                values[key] = self._sum(value, f"{path}.{key}", _UNITS[key])
        if "time" not in entry:
            self.problems.append(schema.Problem("missing", f"{path}.time is missing (unit s)"))
        return Frame(**values)

    def _pressure(self, value: Any, path: str, now: tuple[Sum, ...]) -> tuple[Sum, ...]:
        if isinstance(value, dict):
            per_finger: list[Sum] = list(now)
            for name, entry in value.items():
                if name not in self.groups:
                    why = schema.nearest(name, self.groups)
                    self.problems.append(
                        schema.Problem("unknown", f"{path}.{name} is not a group; {why}")
                    )
                    continue
                total = self._sum(entry, f"{path}.{name}", "Pa")
                for finger in self.groups[name]:
                    per_finger[finger] = total
        elif isinstance(value, list):
            if len(value) != self.fingers:
                self.problems.append(
                    schema.Problem(
                        "size", f"{path} has {len(value)} entries, the hand {self.fingers} fingers"
                    )
                )
            per_finger = [self._sum(v, f"{path}[{i}]", "Pa") for i, v in enumerate(value)]
        else:
            per_finger = [self._sum(value, path, "Pa")] * self.fingers
        return tuple(per_finger)

    def _sum(self, value: Any, path: str, unit: str) -> Sum:
        total = sums.read(value, unit)
        if isinstance(total, str):
            self.problems.append(
                schema.Problem("syntax", f"{path} = {schema.shown(value)} {total}")
            )
            return Sum(unit, 0.0)
        expected = UNITS[unit][0]
        fitting = [name for name, u in self.units.items() if u == expected]
        for term in total.term:
            if term.name not in self.units and (
                why := sums.unit_words(term.name, term.factor, unit)
            ):
                self.problems.append(
                    schema.Problem("syntax", f"{path} = {schema.shown(value)} {why}")
                )
            elif term.name not in self.units:
                why = schema.nearest(term.name, fitting)
                self.problems.append(
                    schema.Problem(
                        "unknown", f"{path} names an unknown parameter {term.name!r}; {why}"
                    )
                )
            elif self.units[term.name] != expected:
                sentence = (
                    f"{path}: {term.name!r} has the unit {self.units[term.name]}, not {expected}; "
                    f"valid: {', '.join(fitting)}"
                )
                self.problems.append(schema.Problem("type", sentence))
        return total


# --- checks over all designs ---------------------------------------------------------------------


def check(scene: Any, where: str) -> list[str]:
    """Problems with key frames in any design of the hand's presets."""
    ranges = {row.name: _ends(row.row) for row in scene.control.parameter}
    fixed = {name: (value, value) for name, value in _scene_times(scene).items()}
    problems = [*_falling(scene.control.frame, fixed | ranges, where)]
    for low, high, limits in _walls(scene.hand):
        problems += _too_high(scene.control.frame, ranges, low, high, limits, where)
    problems += _unlike_lines(scene.control, scene.hand, where)
    return list(dict.fromkeys(problems))


def _unlike_lines(control: Control, hand: Hand, where: str) -> Iterator[str]:
    """Fingers of one pressure line whose pressures differ."""
    count = len(hand.finger)
    groups = hand.valves.known(count)
    hint = ""
    if hand.valves.searched(count):
        groups = (tuple(range(count)),)
        hint = "; give hand.valves.groups in place of lines"
        for row in control.parameter:
            if row.per == "finger":
                words = f"fingers may share a pressure line{hint}"
                yield schema.Problem("conflict", f"{where}.parameter {row.name}: {words}")
    for i, frame in enumerate(control.frame):
        for group in groups:
            if frame.pressure is not None and len({frame.pressure[k] for k in group}) > 1:
                words = (
                    f"fingers {list(group)} may share a pressure line, and have unlike pressures"
                )
                key = f"{where}.frame[{i}].pressure"
                yield schema.Problem("conflict", f"{key}: {words}{hint}")


def doubts(scene: Any, where: str) -> list[str]:
    """Warnings about legal but suspicious key frames: kPa given as Pa, frames after the grasp."""
    return [*_faint(scene.control, where), *_late(scene, where), *_unused(scene.control, where)]


def _faint(control: Control, where: str) -> Iterator[str]:
    """Numbers that are pressures of nearly zero."""
    for i, frame in enumerate(control.frame):
        numbers = dict.fromkeys(v.number for v in frame.pressure or () if v.number is not None)
        for number in numbers:
            if words := unit_slips.kilopascals(number):
                yield f"{where}.frame[{i}].pressure: its number {words}"
    for row in control.parameter:
        if UNITS[row.unit][0] != "Pa":
            continue
        if words := unit_slips.kilopascals(_ends(row.row)):
            yield f"{where}.parameter {row.name}: the largest pressure {words}"


def _late(scene: Any, where: str) -> Iterator[str]:
    """Frames whose time lies after the end of the grasp, in every design or in some.

    A frame whose time names a phase is no slip where that phase is off, as in a scene without
    release: it may lie after the grasp's end, but not after that of all phases.
    """
    settle = scene.phases.settle
    ends = {name: (value, value) for name, value in _scene_times(scene).items()}
    known = {*ends}
    ends |= {row.name: _ends(row.row) for row in scene.control.parameter}
    for i, frame in enumerate(scene.control.frame):
        factors = _factors(frame.time)
        last = scene.phases.ungrasp if known & {*factors} else scene.end_time - settle
        least, most = _range(factors, ends)
        if most <= last + 1e-9:
            continue
        state = "never reached" if least > last + 1e-9 else "not reached in some designs"
        yield (
            f"{where}.frame[{i}].time = {schema.shown(sums.text(frame.time))} is {state}: the "
            f"grasp ends after {last:g} s"
        )


def _unused(control: Control, where: str) -> Iterator[str]:
    """Parameters of pose and pressure that no frame reads, so that a search of them is idle."""
    first = control.frame[0]
    used = {f"arm_{axis}" for axis in POSE if axis != "z" and getattr(first, axis) is None}
    for frame in control.frame:
        for name in _UNITS:
            values = getattr(frame, name) or ()
            for total in values if isinstance(values, tuple) else (values,):
                used |= {term.name for term in total.term}
    unread = [n for n in (*(f"arm_{axis}" for axis in POSE), "pressure") if n not in used]
    if unread:
        yield f"{where}: no key frame reads {', '.join(unread)}: without a policy it has no effect"


def _ends(row: Parameter) -> tuple[float, float]:
    factor = UNITS[row.unit][1]
    return row.low * factor, row.high * factor  # type: ignore[operator]


def _range(
    factors: Mapping[str, float], ends: Mapping[str, tuple[float, float]]
) -> tuple[Any, ...]:
    both = [sorted((f * ends[n][0], f * ends[n][1])) for n, f in factors.items() if n]
    return tuple(factors.get("", 0.0) + sum(pair[side] for pair in both) for side in (0, 1))


def _falling(frames: tuple[Frame, ...], ends: Mapping[str, Any], where: str) -> Iterator[str]:
    """Times that do not grow; a frame that repeats the one before may have its time."""
    for i, (a, b) in enumerate(zip(frames, frames[1:], strict=False), 1):
        first = _factors(a.time)
        second = _factors(b.time)
        step = {n: second.get(n, 0.0) - first.get(n, 0.0) for n in {**first, **second}}
        least = _range(step, ends)[0]
        changes = any(
            v is not None and v != getattr(a, f.name)
            for f in dataclasses.fields(b)[1:-1]
            for v in [getattr(b, f.name)]
        )
        if least < -1e-9 or (changes and least < 1e-9):
            earlier = f"{-least:g} s before it" if least < -1e-9 else "at that time"
            before, after = (schema.shown(sums.text(frame.time)) for frame in (a, b))
            sentence = (
                f"{where}.frame[{i}].time = {after} must come after that of frame[{i - 1}], "
                f"{before}, and is {earlier} in some design"
            )
            yield schema.Problem("order", sentence)


def _walls(hand: Hand) -> Iterator[tuple[Any, ...]]:
    for bounds in hands.all_bounds(hand):
        both = zip(bounds["wall"], bounds.get("tip_wall", bounds["wall"]), strict=True)
        thinnest = [map(min, *ends) for ends in both]  # of a tapered finger
        walls = [[hand.pressure_limit.per_wall * w for w in side] for side in thinnest]
        yield *bounds["pressure"], list(zip(*walls, strict=True))


def _too_high(
    frames: tuple[Frame, ...],
    ranges: Mapping[str, Any],
    low: Any,
    high: Any,
    limits: Any,
    where: str,
) -> Iterator[str]:
    for i, frame in enumerate(frames):
        for finger, value in enumerate(frame.pressure or ()):
            factors = _factors(value)
            # A search keeps `pressure` below the limit of its wall, so that the worst design is at
            # an end of the limits, or where the limit begins to hold.
            pressures = sorted(
                {*limits[finger], min(max(high[finger], limits[finger][0]), limits[finger][1])}
            )
            for limit in pressures:
                ends = {**ranges, "pressure": (min(low[finger], limit), min(high[finger], limit))}
                least, most = _range(factors, ends)
                key = f"{where}.frame[{i}].pressure"
                text = schema.shown(sums.text(value))
                if most > limit * (1 + 1e-9):
                    sentence = (
                        f"{key} = {text} of finger {finger} may be {most:.6g} Pa, above the limit "
                        f"of {limit:.6g} Pa of its wall"
                    )
                    yield schema.Problem("range", sentence)
                    break
                if least < 0:
                    words = f"of finger {finger} may be {least:.6g} Pa, below zero"
                    yield schema.Problem("range", f"{key} = {text} {words}")
                    break


def lacking(control: Control, fingers: tuple[int, ...]) -> Control:
    """The control of a hand without some of its fingers, which are counted from 0."""
    frames = [
        frame
        if frame.pressure is None
        else dataclasses.replace(
            frame, pressure=tuple(p for f, p in enumerate(frame.pressure) if f not in fingers)
        )
        for frame in control.frame
    ]
    return dataclasses.replace(control, frame=tuple(frames))
