"""Flat parameter vectors: names, units, bounds, presets and the pressure limit (Table I).

A *design* vector holds a preset's free parameters in the order of the hand's table, one entry a
finger where the row says so, in SI units and radians.  `Params` has all of them by name, with those
that the preset fixes or ties.

>>> import numpy as np
>>> from codesign_jax import parameters, scene
>>> space = parameters.design_space(scene.load("paper").hand, "2d")
>>> space.names, space.units, space.is_morphology
(('length', 'arm_z'), ('mm', 'mm'), (True, False))
>>> space.from_units([95.0, 30.0])  # mm to m
array([0.095, 0.03 ])
>>> space.params(np.array([95.0, 0.03]))
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: length = 95.0 is outside [0.001, 1] m; did you mean 0.095? ...
"""

import dataclasses
import functools
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import design_files, loading, schema, unit_slips
from codesign_jax.scene.buildable import Buildable, on_lines
from codesign_jax.scene.description import Scene
from codesign_jax.scene.hand import UNITS, Free, Hand, Parameter, Preset, Valves, structure
from codesign_jax.scene.hand_tables import PARAMETERS, TIP, highest_pressure, per_finger
from codesign_jax.types import Params, Tip, random_key_problem

ARM = tuple(f"arm_{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw"))
"""Rows of the hand's table in the order of `Params.arm`."""
# The limit is strict (p_i < d_i * 80 kPa / 2 mm); this margin keeps it so in float32.
_STRICT = 1.0 - 1e-6


@dataclasses.dataclass(frozen=True)
class DesignSpace:
    """The free parameters of a preset and how they fill the hand's table.

    Attributes:
      hand: The hand's parameter table and pressure limit, without its other numbers: hands that
        differ in those have equal spaces.
      names: Names of the free parameters, e.g. "length[2]", "length[0+3]" or "length" where tied.
      units: Units in which the hand file states them.
      scale: Factor from that unit to SI, shape (parameter,).
      bounds: Lower and upper bounds [SI] of legal designs, as tuples, which can be hashed; `low`
        and `high` are arrays.
      is_morphology: True for morphology, False for control, shape (parameter,).
      base: Fixed values and defaults [SI] of all rows of the table one behind the other, one entry
        or one a finger, shape (entry,).
      source: For each of them the design's entry that replaces it, or -1, shape (entry,).
      idle: Parameters that the preset leaves free, but which have no effect and are fixed at their
        default: name and why.
      buildable: The limits that proposals of a search keep besides; None for Table I alone.
    """

    hand: Hand
    names: tuple[str, ...]
    units: tuple[str, ...]
    scale: tuple[float, ...]
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    is_morphology: tuple[bool, ...]
    base: tuple[float, ...]
    source: tuple[int, ...]
    idle: tuple[tuple[str, str], ...] = ()
    buildable: Buildable | None = None

    def __str__(self) -> str:
        """In a line or two; parameters of several fingers with the same bounds stand together."""
        entries = zip(self.names, self.units, self.scale, *self.bounds, strict=True)
        counts: dict[str, int] = {}
        for name, unit, scale, low, high in entries:
            words = f"{name.split('[')[0]}{{}} {low / scale:.6g} to {high / scale:.6g} {unit}"
            counts[words] = counts.get(words, 0) + 1
        rows = [words.format(f" ({n})" if n > 1 else "") for words, n in counts.items()]
        return f"{self.num_parameters} parameters: {', '.join(rows)}"

    @property
    def low(self) -> np.ndarray:
        """Lower bounds [SI], shape (parameter,)."""
        return np.array(self.bounds[0])

    @property
    def high(self) -> np.ndarray:
        """Upper bounds [SI], shape (parameter,)."""
        return np.array(self.bounds[1])

    @functools.cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds [SI] in which a search proposes designs, each of shape (parameter,)."""
        if self.buildable is None:
            return self.low, self.high
        rows = [name.split("[")[0] for name in self.names]
        ends = zip(rows, *self.bounds, strict=True)
        low, high = zip(*(self.buildable.bounds(*end) for end in ends), strict=True)
        return np.array(low), np.array(high)

    @property
    def of_table(self) -> "DesignSpace":
        """The space with Table I alone, without limits of a scene and searched pressure lines."""
        hand = dataclasses.replace(self.hand, valves=Valves())
        return dataclasses.replace(self, hand=hand, buildable=None)

    @property
    def num_parameters(self) -> int:
        """Number of free parameters."""
        return len(self.names)

    @functools.cached_property
    def structure(self) -> "DesignSpace":
        """The space without numbers that no program reads, so that others share its programs.

        Values of fixed parameters and the pressure limit stay: programs have them as constants.
        """
        zeros = (0.0,) * self.num_parameters
        entries = zip(self.base, self.source, strict=True)
        rows = (dataclasses.replace(p, low=0.0, high=0.0, default=0.0) for p in self.hand.parameter)
        return dataclasses.replace(
            self,
            hand=dataclasses.replace(self.hand, parameter=tuple(rows)),
            scale=zeros,
            # Limits of a scene are projected within the bounds.
            bounds=(zeros, zeros) if self.buildable is None else self.bounds,
            idle=(),
            base=tuple(0.0 if source >= 0 else value for value, source in entries),
        )

    def params(self, design: jax.typing.ArrayLike) -> Params:
        """Returns the named parameters of a design vector [SI], shape (parameter,).

        Raises:
          InputError: If it has another shape, and see `refuse_unit_slips`.
        """
        self._refuse_shape(design, "")
        self.refuse_unit_slips(design)
        return _named(self, jnp.asarray(design))

    def table(self, design: np.typing.ArrayLike) -> dict[str, Any]:
        """Values of a design [SI] by the rows of the hand's table, in the rows' units.

        Those that each finger has of its own are arrays, shape (finger,).

        Raises:
          InputError: As `params`.
        """
        params = jax.tree.map(lambda v: np.asarray(v, float), self.params(np.asarray(design)))
        return {
            row.name: _value(params, row.name) / UNITS[row.unit][1] for row in self.hand.parameter
        }

    def entries(self, name: str) -> np.ndarray:
        """The design's entries that a row of the hand's table has, -1 for one that is fixed.

        Returns:
          Indices, shape (finger,), or (1,) of a row that all fingers share.
        """
        return np.array(self.source[_rows(self.hand)[name]])

    def project(self, design: jax.typing.ArrayLike) -> jax.Array:
        """The nearest design that a search may propose, parameter by parameter.

        Free pressures are lowered under their limit p_i < per_wall * d_i (Table I), and fingers
        that share a pressure line get one; see `buildable.on_lines`. Where limits of
        the scene hold, those lower them further, lengths and angles of the arm are clipped to the
        box, and the arm is raised; see `buildable`.

        Args:
          design: Design vector [SI], shape (parameter,).

        Returns:
          The projected vector, shape (parameter,).
        """
        self._refuse_shape(design, "")
        self.refuse_unit_slips(design)
        return _projected(self, jnp.asarray(design))

    def sample(self, key: jax.Array, n: int, *, first: Any = 0) -> jax.Array:
        """Draws designs that a search may propose: within the box, and projected.

        Every parameter is uniform in the box and independent of the others, but for what `project`
        changes: a finger with a pressure above its limit has the highest one that it may have.
        Design i draws from fold_in(key, i), so that more
        designs do not change earlier ones, and any of them can be drawn without the others.

        Args:
          key: Typed key.
          n: Number of designs.
          first: Index of the first design; may be traced.

        Returns:
          Designs first to first + n - 1 [SI], shape (n, parameter).

        Raises:
          InputError: If `key` is not one typed key, or `n` is no whole number or below 1.
        """
        _refuse_draws(key, n)
        return _sampled(self, n, key, first)

    def refuse_unit_slips(self, designs: np.typing.ArrayLike) -> None:
        """Refuses designs that were given in other units than SI; see `from_units` for those.

        Only numbers that a factor between units would bring into the range that makes sense for
        their parameter are refused, and only outside of programs that are being traced.

        Args:
          designs: Design vectors [SI], shape (..., parameter).

        Raises:
          InputError: With every such number and its suggested value, or if the last axis is not
            that of the parameters. Of pressures that are all nearly zero, a warning is given.
        """
        self._refuse_shape(designs, "..., ")
        if isinstance(designs, jax.core.Tracer):
            return
        columns = np.moveaxis(np.asarray(designs, float), -1, 0)
        rows = [name.split("[")[0] for name in self.names]
        slips = []
        for name, row, column in zip(self.names, rows, columns, strict=True):
            slips += unit_slips.slips(name, row, column)
        if slips:
            raise schema.InputError(slips)
        unit_slips.hint_at_kilopascals(columns[[row == "pressure" for row in rows]])

    def check(self, designs: np.typing.ArrayLike) -> None:
        """Checks designs where they come in: they are numbers in SI units, and legal ones.

        Functions that are traced do not; of traced designs only the shape is checked.

        Args:
          designs: Design vectors [SI], shape (..., parameter).

        Raises:
          InputError: If a number is not finite, and see `refuse_unit_slips`. Of designs outside of
            the bounds or above the pressure limit, which are simulated all the same, a warning is
            given.
        """
        self.refuse_unit_slips(designs)
        if isinstance(designs, jax.core.Tracer):
            return
        rows = np.asarray(designs, float).reshape(-1, self.num_parameters)
        self._refuse_infinite(rows)
        units = [UNITS[unit][0] for unit in self.units]
        problems = self._outside(units, self.low, self.high, rows)
        if above := self._above_the_limit(rows):
            sentence = (
                f"{above} of {len(rows)} designs with a pressure above the limit of the wall, to "
                "which space.project lowers it"
            )
            problems.append(schema.Problem("range", sentence))
        if several := self._off_the_lines(rows):
            sentence = (
                f"{several} of {len(rows)} designs with more pressures than the hand's "
                f"{self.hand.valves.lines} lines, which space.project groups"
            )
            problems.append(schema.Problem("conflict", sentence))
        if problems:
            text = f"designs that are not legal, simulated all the same: {'; '.join(problems)}"
            warnings.warn(text, stacklevel=3)

    def _refuse_infinite(self, rows: np.ndarray) -> None:
        """Refuses numbers that are none, designs of shape (design, parameter) in any units."""
        bad: np.ndarray = ~np.isfinite(rows)
        names = zip(self.names, np.asarray(bad.any(0)), rows.T, bad.T, strict=True)
        problems = [
            schema.Problem("range", f"{name} = {column[where][0]} is not a finite number")
            for name, any_bad, column, where in names
            if any_bad
        ]
        if problems:
            raise schema.InputError(problems)

    def _outside(
        self, units: Sequence[str], low: np.ndarray, high: np.ndarray, rows: np.ndarray
    ) -> list[str]:
        ends = zip(self.names, units, low, high, rows.T, strict=True)
        return [problem for end in ends if (problem := unit_slips.outside(*end))]

    def _off_the_lines(self, rows: np.ndarray) -> int:
        """Number of designs [SI], shape (design, parameter), with more pressures than lines."""
        lines = self.hand.valves.searched(len(self.hand.finger))
        if not lines:
            return 0
        pressures = np.sort(_params(self, rows).pressure)
        return int(((np.diff(pressures) > 0).sum(1) >= lines).sum())

    def _above_the_limit(self, rows: np.ndarray) -> int:
        """Number of designs [SI], shape (design, parameter), with a pressure above its limit."""
        params = _params(self, rows)
        # A pressure at its limit is a legal one, also as a float32.
        above = params.pressure > _caps(self.hand, params) * (1 + 1e-6)
        return int(above.any(1).sum())

    def refuse_population(self, population: np.typing.ArrayLike) -> None:
        """Refuses what are not designs of this space, shape (particle, parameter).

        Raises:
          InputError: If the shape is another one.
        """
        rows = isinstance(population, list | tuple) and not isinstance(population, Params)
        if not rows and not hasattr(population, "ndim"):
            words = f"population is a {type(population).__name__}, not an array of designs [SI]"
            hint = "; rollout.evaluate takes Params" if isinstance(population, Params) else ""
            raise schema.InputError.of("type", words + hint)
        if np.ndim(population) != 2:
            shape = np.shape(population)
            hint = "; population[None] makes a batch of one" if len(shape) == 1 else ""
            raise schema.InputError.of(
                "size", f"population has shape {shape}, not (particle, parameter){hint}"
            )
        self._refuse_shape(population, "particle, ")

    def _refuse_shape(self, designs: np.typing.ArrayLike, leading: str) -> None:
        shape = np.shape(designs)
        count = self.num_parameters
        if shape[-1:] != (count,) or (not leading and len(shape) > 1):
            names = ", ".join(self.names)
            hint = "; jax.vmap maps over designs" if not leading and len(shape) > 1 else ""
            raise schema.InputError.of(
                "size", f"designs have shape {shape}, not ({leading}{count},): {names}{hint}"
            )

    def default(self) -> np.ndarray:
        """Returns the table's default design, shape (parameter,), inside the bounds [SI].

        A value that fingers share is the default of the first of them.
        """
        base = _defaults(self.hand)
        first = [self.source.index(j) for j in range(self.num_parameters)]
        return np.clip(base[first], self.low, self.high)

    def in_units(self, design: np.typing.ArrayLike) -> np.ndarray:
        """Converts design vectors from SI to the hand file's units, shape (..., parameter).

        Raises:
          InputError: If the last axis is not that of the parameters.
        """
        self._refuse_shape(design, "..., ")
        return np.asarray(design) / np.asarray(self.scale)

    def from_units(self, design: np.typing.ArrayLike) -> np.ndarray:
        """Converts design vectors from the hand file's units to SI, shape (..., parameter).

        A design outside of the space's bounds is converted as well, with a warning: it may be
        simulated, though no optimiser proposes it.

        Raises:
          InputError: If the last axis is not that of the parameters, or a number is not finite.
        """
        self._refuse_shape(design, "..., ")
        values = np.asarray(design, float)
        scale = np.asarray(self.scale)
        rows = values.reshape(-1, self.num_parameters)
        self._refuse_infinite(rows)
        problems = self._outside(self.units, self.low / scale, self.high / scale, rows)
        if words := "; ".join(problems):
            text = f"design outside of the space's bounds, which is simulated all the same: {words}"
            warnings.warn(text, stacklevel=2)
        return values * scale


@functools.partial(jax.jit, static_argnums=0)
def _named(space: DesignSpace, design: jax.Array) -> Params:
    """`DesignSpace.params`; one program a space."""
    return _params(space, design)


def _params(space: DesignSpace, designs: Any) -> Params:
    """`DesignSpace.params` of designs of shape (..., parameter), NumPy's or JAX's as these are."""
    numpy = designs.__array_namespace__()

    def take(name: str) -> Any:
        part = _rows(space.hand)[name]
        source = space.entries(name)
        fixed = np.array(space.base[part], designs.dtype)
        values = numpy.where(source >= 0, designs[..., np.maximum(source, 0)], fixed)
        return values if _row(space.hand, name).per == "finger" else values[..., 0]

    rows = [row.name for row in space.hand.parameter if row.name not in PARAMETERS]
    return Params(
        length=take("length"),
        height=take("height"),
        wall=take("wall"),
        spread=take("spread"),
        arm=numpy.stack([take(name) for name in ARM], -1),
        pressure=take("pressure"),
        control={name: take(name) for name in rows} or None,
        tip=Tip(*(take(name) for name in TIP)) if space.hand.section.tapered else None,
    )


def _value(params: Params, name: str) -> Any:
    """The value of a row of the hand's table, shape (..., finger), or (...) if fingers share it."""
    if name in ARM:
        return params.arm[..., ARM.index(name)]
    if name in TIP:
        return params.tip[TIP.index(name)]  # type: ignore[index]
    if name in PARAMETERS:
        return getattr(params, name)
    return params.control[name]  # type: ignore[index]


@functools.partial(jax.jit, static_argnums=0)
def _projected(space: DesignSpace, design: jax.Array) -> jax.Array:
    """`DesignSpace.project` of a design whose units are known to be right; one program a space."""
    if space.buildable is not None:
        design = _lengthened(space, jnp.clip(design, *_representable(space)))
    params = _params(space, design)
    caps = _caps(space.hand, params)
    if space.buildable is not None:
        caps = space.buildable.highest_pressure(caps, params)
    for i, j in enumerate(space.entries("pressure")):
        if j >= 0:
            design = design.at[j].min(caps[i] * _STRICT)
    design = _on_lines(space, design, caps * _STRICT)
    return design if space.buildable is None else _raised(space, design)


def _on_lines(space: DesignSpace, design: jax.Array, highest: jax.Array) -> jax.Array:
    """A design whose fingers share the hand's pressure lines, where a search chooses by which.

    Args:
      highest: Highest pressures of the fingers [Pa], shape (finger,).
    """
    places = space.entries("pressure")
    lines = space.hand.valves.searched(len(places))
    if not lines or (places < 0).any():
        return design
    return design.at[places].set(on_lines(design[places], highest, lines))


def _lengthened(space: DesignSpace, design: jax.Array) -> jax.Array:
    """A design whose free lengths are the least ones of their fingers' heights, or more."""
    assert space.buildable is not None
    least = space.buildable.least_length(_params(space, design).height)
    for i, j in enumerate(space.entries("length")):
        if j >= 0:
            design = design.at[j].max(jnp.minimum(least[i], space.box[1][j]))
    return design


def _raised(space: DesignSpace, design: jax.Array) -> jax.Array:
    """A design whose arm is high enough, as far as its height is free and in its bounds."""
    assert space.buildable is not None
    [j] = space.entries("arm_z")
    if j < 0:
        return design
    least = space.buildable.least_height(*_params(space, design).arm[3:])
    return design.at[j].max(jnp.minimum(least, space.box[1][j]))


def _caps(hand: Hand, params: Params) -> Any:
    """Highest pressures by Table I [Pa], shape (..., finger)."""
    return highest_pressure(hand, params.wall, None if params.tip is None else params.tip.wall)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _sampled(space: DesignSpace, n: int, key: jax.Array, first: Any) -> jax.Array:
    """`DesignSpace.sample`; one program a space and number."""
    low, high = _representable(space)

    def draw(i: jax.Array) -> jax.Array:
        unit = jax.random.uniform(jax.random.fold_in(key, i), low.shape, low.dtype)
        return _projected(space, jnp.minimum(low + (high - low) * unit, high))

    return jax.vmap(draw)(first + jnp.arange(n))


def _representable(space: DesignSpace) -> tuple[np.ndarray, np.ndarray]:
    """The box in the float type of programs, rounded inwards."""
    kind = np.dtype(jnp.result_type(float))
    least, most = space.box
    low = least.astype(kind)
    high = most.astype(kind)
    low = np.where(low < least, np.nextafter(low, kind.type(np.inf)), low)
    return low, np.where(high > most, np.nextafter(high, kind.type(-np.inf)), high)


def _refuse_draws(key: Any, n: Any) -> None:
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
        raise schema.InputError.of("range", f"n = {n!r} designs must be a whole number, at least 1")
    if problem := random_key_problem(key):
        raise schema.InputError.of("type", problem)


def fingers_of(name: str) -> list[int]:
    """The fingers of a parameter's name, such as [0, 3] of "length[0+3]"; none for all of them."""
    _, _, inside = name.partition("[")
    return [int(k) for k in inside.removesuffix("]").split("+") if k]


@functools.partial(jax.jit, static_argnums=0)
def params_of(space: DesignSpace, designs: jax.typing.ArrayLike) -> Params:
    """Named parameters of designs [SI], shape (design, parameter); one program a space."""
    return jax.vmap(space.params)(designs)


def design_space(hand: Hand, preset: str = "full") -> DesignSpace:
    """Builds the design space of a preset; parameters of the scene's control are free as well.

    Args:
      preset: Name of a preset of the hand, or "full" for the whole table (the paper's 23D; "23d"
        for a table of 23 parameters).

    Raises:
      InputError: if the hand has no such preset.
    """
    rows = [
        p for p in hand.parameter if p.name in PARAMETERS and p.name not in without_effect(hand)
    ]
    total = sum(hand.width(p) for p in rows)
    if preset in ("full", f"{total}d"):
        chosen = Preset(preset, ())
    else:
        known = {p.name: p for p in hand.preset}
        if preset not in known:
            hint = _hint(preset, [*known, "full", f"{total}d"])
            raise schema.InputError.of(
                "unknown", f"preset {preset!r} unknown for hand {hand.name}; {hint}"
            )
        chosen = known[preset]
    return _build(hand, chosen, everything=chosen.whole)


class Design(NamedTuple):
    """A design with its scene.

    Attributes:
      scene: The scene that its file names.
      space: Design space of its preset.
      design: The design [SI units], shape (parameter,).
    """

    scene: Scene
    space: DesignSpace
    design: np.ndarray


def read_design(
    path: str | Path,
    *,
    accuracy: str | Path | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> Design:
    r"""Reads a design file, as `codesign studio` writes it and every command takes it.

    Parameters that the file leaves out have the hand file's defaults.

    Args:
      path: The file, .toml.
      accuracy: As of `scene.load`.
      overrides: As of `scene.load`.

    Raises:
      InputError: With every problem of the file, or of the scene that it names.

    >>> import pathlib, tempfile
    >>> from codesign_jax import parameters
    >>> path = pathlib.Path(tempfile.mkdtemp(), "mine.toml")
    >>> _ = path.write_text('preset = "2d"\n[design]\nlength = 95\narm_z = 30')  # mm
    >>> grasping, space, design = parameters.read_design(path)
    >>> space.names, design
    (('length', 'arm_z'), array([0.095, 0.03 ]))
    """
    file = design_files.read(Path(path))
    control = {("control",): file.control} if file.control else {}
    scene = loading.load(
        file.scene,
        hand_name=file.hand or None,
        object_set=file.objects or None,
        accuracy=accuracy,
        overrides=control | dict(overrides or {}),
    )
    space = design_space(scene.hand, file.preset)
    return Design(
        scene, space, design_files.parse(space, file.pairs, space.default(), Path(path).name)
    )


def without_effect(hand: Hand) -> dict[str, str]:
    """Parameters that change nothing in a hand, with the reason; no preset searches them."""
    shares: list[Any] = [finger.spread for finger in hand.finger]  # a number may be an array
    if all(isinstance(share, int | float) and share == 0 for share in shares):
        return {"spread": "every finger has spread = 0"}
    return {}


def _hint(preset: str, names: list[str]) -> str:
    sizes = {int(name[:-1]): name for name in names if re.fullmatch(r"\d+d", name)}
    if sizes and re.fullmatch(r"\d+[dD]", preset):
        return f"did you mean {sizes[min(sizes, key=lambda n: abs(n - int(preset[:-1])))]!r}?"
    return schema.nearest(preset, names)


def _build(hand: Hand, preset: Preset, *, everything: bool) -> DesignSpace:
    base = _defaults(hand)
    parts = _rows(hand)
    source = np.full(base.shape, -1)
    for name, value in preset.fixed.items():
        row = _row(hand, name)
        factor = UNITS[row.unit][1]
        base[parts[name]] = np.array(per_finger(value, hand.width(row))) * factor
    free = {f.name: f for f in preset.free}
    idle = {n: why for n, why in without_effect(hand).items() if everything or n in free}
    columns: list[tuple[str, str, float, float, float, bool]] = []
    for row in hand.parameter:
        if not everything and row.name not in free and row.name in PARAMETERS:
            continue  # those of the control are free in every preset
        if row.name in idle:
            continue
        factor = UNITS[row.unit][1]
        width = hand.width(row)
        spec = free.get(row.name, Free(row.name))
        if width > 1 and UNITS[row.unit][0] == "Pa":
            spec = spec.joined(hand.valves.known(width), width)
        low, high = spec.bounds(row, width)
        for group in spec.groups(width):
            source[parts[row.name]][list(group)] = len(columns)
            fingers = "" if len(group) == width else f"[{'+'.join(map(str, group))}]"
            morphology = row.domain == "morphology"
            ends = low[group[0]] * factor, high[group[0]] * factor
            columns.append((f"{row.name}{fingers}", row.unit, factor, *ends, morphology))
    if not columns:
        reasons = "; ".join(f"{name} has no effect: {why}" for name, why in idle.items())
        words = f"preset {preset.name!r} of hand {hand.name} leaves nothing to search"
        raise schema.InputError.of("missing", f"{words}: {reasons}")
    names, units, scale, low, high, domain = zip(*columns, strict=True)
    space = DesignSpace(
        _table_alone(hand),
        names,
        units,
        scale,
        (low, high),
        domain,
        tuple(base),
        tuple(source.tolist()),
        tuple(idle.items()),
        hand.buildable if preset.limits else None,
    )
    _refuse_empty(space, hand.name)
    _refuse_unlike_fingers(space, f"preset {preset.name!r} of hand {hand.name}")
    return space


def _refuse_empty(space: DesignSpace, hand_name: str) -> None:
    """Refuses limits of a scene that leave nothing of a parameter's range."""
    columns = map(space.in_units, (*space.box, *space.bounds))
    ends = zip(space.names, space.units, *columns, strict=True)
    problems = [
        schema.Problem(
            "range",
            f"{name}: limits of the scene ({least:g} to {most:g} {unit}) leave nothing of the "
            f"range of hand {hand_name}, {low:g} to {high:g} {unit}",
        )
        for name, unit, least, most, low, high in ends
        if least > most
    ]
    if problems:
        raise schema.InputError(problems)


def _refuse_unlike_fingers(space: DesignSpace, where: str) -> None:
    """Refuses pressures that fingers of one pressure line cannot have."""
    places = space.entries("pressure")
    fixed = np.array(space.base[_rows(space.hand)["pressure"]])
    count = len(places)
    valves = space.hand.valves
    free = places[0] >= 0  # of all fingers, or of none
    low = space.low[places]
    high = space.high[places]
    problems = []
    for group in valves.known(count):
        line = [*group]
        if not free and np.ptp(fixed[line]) > 0:
            problems.append(
                schema.Problem(
                    "conflict", f"{where} fixes unlike pressures of fingers {line} of one line"
                )
            )
        if free and low[line].max() >= high[line].min():
            problems.append(
                schema.Problem(
                    "conflict", f"{where}: fingers {line} of one line have no pressure in common"
                )
            )
    if lines := valves.searched(count):
        if not free and len(np.unique(fixed)) > lines:
            problems.append(
                schema.Problem(
                    "conflict", f"{where} fixes more pressures than valves.lines = {lines}"
                )
            )
        if free and (np.ptp(low) > 0 or np.ptp(high) > 0):
            sentence = (
                f"{where}: valves.lines = {lines} needs pressures with the same bounds for all "
                "fingers; give valves.groups instead"
            )
            problems.append(schema.Problem("unsupported", sentence))
    if problems:
        raise schema.InputError(problems)


def _table_alone(hand: Hand) -> Hand:
    return dataclasses.replace(
        structure(schema.typical(hand)),
        parameter=hand.parameter,
        pressure_limit=hand.pressure_limit,
        valves=hand.valves,
    )


def _row(hand: Hand, name: str) -> Parameter:
    return next(p for p in hand.parameter if p.name == name)


@functools.cache
def _rows(hand: Hand) -> dict[str, slice]:
    """Where the entries of each row of the hand's table are, see `DesignSpace.base`."""
    ends = np.cumsum([0] + [hand.width(row) for row in hand.parameter]).tolist()
    names = (row.name for row in hand.parameter)
    return {name: slice(*ends[k : k + 2]) for k, name in enumerate(names)}


def _defaults(hand: Hand) -> np.ndarray:
    values = [
        np.array(per_finger(p.default, hand.width(p)), float) * UNITS[p.unit][1]
        for p in hand.parameter
    ]
    return np.concatenate(values)
