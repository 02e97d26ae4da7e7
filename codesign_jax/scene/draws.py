"""Constants that nobody knows exactly: a table of their distributions, and draws from it.

A file of them has a table `[[constant]]` for each.  `codesign finger --posterior` writes the
constants of a finger that was measured; `constants/unmeasured.toml` has those of a hand before it
is built.  A scene with such a table (`Scene.drawn`) has other constants in every trial.

>>> import jax
>>> from codesign_jax.scene import draws
>>> table = draws.read("unmeasured")
>>> values = draws.deviations(table, jax.random.key(0), 1000)  # (draw, constant)
>>> place = [entry.key for entry in table.constant].index("objects.object.friction")
>>> bool(0.7 <= values[:, place].min() and values[:, place].max() <= 1.4)  # a factor
True
"""

import dataclasses
import functools
import math
import operator
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w
from jax.scipy.stats import norm

from codesign_jax.scene import library, schema, silicones
from codesign_jax.scene.schema import choice, quantity

CHANGES = ("value", "factor", "shift")
"""What a draw is: the constant itself, a factor on the scene's, or what is added to it."""
ROOTS = ("hand", "objects", "contact")
"""Where the keys of constants begin."""
_WIDEST = 1e9


@schema.table
@dataclasses.dataclass(frozen=True)
class Constant:
    """A constant and its distribution.

    Attributes:
      key: Key path of a number of the scene, such as `hand.material.shear_modulus`. A path that
        does not say which entry of a list, such as `hand.finger.tilt`, means all entries.
      distribution: "lognormal" and "normal" have `mean` and `sd`, "loguniform" and "uniform" `low`
        and `high`.
      change: What a draw is: the constant's "value", a "factor" on the scene's, or a "shift".
      mean: Its mean; of "lognormal" its median.
      sd: Its standard deviation; of "lognormal" that of the logarithm.
      low: Its lower end.
      high: Its upper end.
      correlation: Correlations of its normal score with those of the constants before it, in their
        order; those not given are 0.
      source: Where the distribution comes from.
    """

    key: str
    source: str
    distribution: str = choice("lognormal", "normal", "loguniform", "uniform")
    change: str = choice(*CHANGES, default="value")
    mean: float | None = quantity("", -_WIDEST, _WIDEST, default=None)
    sd: float | None = quantity("", 0, _WIDEST, default=None)
    low: float | None = quantity("", -_WIDEST, _WIDEST, default=None)
    high: float | None = quantity("", -_WIDEST, _WIDEST, default=None)
    correlation: tuple[float, ...] = quantity("", -1, 1, default=())

    @property
    def path(self) -> tuple[str, ...]:
        """Its key's parts."""
        return tuple(self.key.split("."))

    @property
    def logarithmic(self) -> bool:
        """Whether its logarithm is normal or uniform."""
        return self.distribution.startswith("log")

    @property
    def middle(self) -> Any:
        """Its mean, of logarithmic distributions its median; a number, or traced."""
        if self.mean is not None:
            return self.mean
        assert self.low is not None and self.high is not None
        if self.logarithmic:
            return (self.low * self.high) ** 0.5
        return (self.low + self.high) / 2

    @property
    def is_factor(self) -> bool:
        """Whether a draw multiplies the scene's own number, which is the middle, or is added."""
        return self.change == "factor" or (self.change == "value" and self.logarithmic)

    @property
    def spread(self) -> float:
        """Its standard deviation, of logarithmic distributions the logarithm's."""
        if self.sd is not None:
            return self.sd
        assert self.low is not None and self.high is not None
        ends = np.log([self.low, self.high]) if self.logarithmic else (self.low, self.high)
        return float(ends[1] - ends[0]) / math.sqrt(12)

    def deviation(self, score: Any) -> Any:
        """The factor on the scene's number, or the shift of it, of a normal score; JAX."""
        value = self._of_score(score)
        if self.change != "value":
            return value
        return value / self.middle if self.logarithmic else value - self.middle

    def _of_score(self, score: Any) -> Any:
        if self.mean is not None and self.sd is not None:
            if self.logarithmic:
                return self.mean * jnp.exp(self.sd * score)
            return self.mean + self.sd * score
        assert self.low is not None and self.high is not None
        share = norm.cdf(score)
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


@schema.table
@dataclasses.dataclass(frozen=True)
class Constants:
    """Constants that are drawn, together.

    Attributes:
      law: Bending law that a shear modulus among them belongs to; not given: the hand's.
      constant: The constants.
    """

    law: str | None = choice(*silicones.LAWS, default=None)
    constant: tuple[Constant, ...] = ()


def read(name: str | Path) -> Constants:
    """Reads a file of constants, by the name of one that is built in or its path.

    Raises:
      InputError: With everything that is wrong with it.
    """
    path = library.find("constants", name)
    problems: list[str] = []
    table = schema.parse(Constants, library.read(path), path.name, problems)
    if table is not None:
        problems += check(table, path.name)
    if problems or table is None:
        raise schema.InputError(problems)
    return table


def check(table: Constants, where: str) -> list[str]:
    """What is wrong with a table whose numbers are each in range."""
    problems = []
    keys = [entry.key for entry in table.constant]
    for i, entry in enumerate(table.constant):
        key = f"{where}.constant {entry.key}"
        names = ("mean", "sd") if entry.distribution.endswith("normal") else ("low", "high")
        numbers = [getattr(entry, n) for n in names]
        present = {n for n in ("mean", "sd", "low", "high") if getattr(entry, n) is not None}
        if present != set(names):
            words = f"has {' and '.join(names)}, and no other number"
            sentence = f"{key}: distribution {entry.distribution!r} {words}"
            problems.append(schema.Problem("conflict", sentence))
        elif entry.logarithmic and numbers[0] <= 0:
            problems.append(
                schema.Problem("range", f"{key}: {names[0]} of a {entry.distribution} is above 0")
            )
        elif names[0] == "low" and not numbers[0] < numbers[1]:
            problems.append(
                schema.Problem(
                    "order", f"{key}: low = {numbers[0]:g} must be below high = {numbers[1]:g}"
                )
            )
        if entry.key in keys[:i]:
            problems.append(schema.Problem("conflict", f"{key} is given more than once"))
        if len(entry.correlation) > i:
            problems.append(
                schema.Problem(
                    "size",
                    f"{key}: correlation has {len(entry.correlation)} numbers, {i} before it",
                )
            )
    if not problems and (np.linalg.eigvalsh(correlations(table)) < -1e-6).any():
        problems.append(
            schema.Problem("conflict", f"{where}: the correlations contradict one another")
        )
    return problems


def correlations(table: Constants) -> np.ndarray:
    """Correlations of the normal scores, shape (constant, constant)."""
    matrix = np.eye(len(table.constant))
    for i, entry in enumerate(table.constant):
        matrix[i, : len(entry.correlation)] = entry.correlation
        matrix[: len(entry.correlation), i] = entry.correlation
    return matrix


def scores(table: Constants, key: jax.Array) -> jax.Array:
    """Normal scores of the constants with their correlations, shape (constant,)."""
    size = len(table.constant)
    free = jax.random.normal(key, (size,))
    if not any(entry.correlation for entry in table.constant):
        return free
    near = jnp.eye(size)
    for i, entry in enumerate(table.constant):
        for k, value in enumerate(entry.correlation):
            near = near.at[i, k].set(value).at[k, i].set(value)
    # Rounded correlations of 1 have no root.
    return jnp.linalg.cholesky(near + 1e-6 * jnp.eye(size)) @ free


def deviations(
    table: Constants, key: jax.Array, count: int, first: jax.typing.ArrayLike = 0
) -> jax.Array:
    """Factors on, or shifts of, the scene's constants, shape (draw, constant).

    Draw t is that of fold_in(key, t), so that more draws do not change earlier ones.
    """
    numbers = jnp.asarray(first) + jnp.arange(count)
    normal = jax.vmap(lambda t: scores(table, jax.random.fold_in(key, t)))(numbers)
    return jnp.stack([e.deviation(normal[:, i]) for i, e in enumerate(table.constant)], -1)


def applied(scene: Any, table: Constants, shifts: Any) -> Any:
    """The scene with deviations of its constants, which may be traced.

    Args:
      shifts: The deviations of each constant, shape (constant,), or a sequence of arrays (trial,).
    """
    for i, entry in enumerate(table.constant):
        operation = operator.mul if entry.is_factor else operator.add
        scene = changed(scene, entry.path, functools.partial(operation, shifts[i]))
    return scene


def changed(table: Any, path: Sequence[str], change: Callable[[Any], Any]) -> Any:
    """A table with change(number) in place of the numbers of a key path."""
    if not path:
        return change(table)
    if isinstance(table, tuple):
        named = [
            str(getattr(e, "name", i)) == path[0] or str(i) == path[0] for i, e in enumerate(table)
        ]
        if any(named):
            pairs = zip(table, named, strict=True)
            return tuple(changed(e, path[1:], change) if mine else e for e, mine in pairs)
        return tuple(changed(entry, path, change) for entry in table)
    return schema.replaced(table, **{path[0]: changed(getattr(table, path[0]), path[1:], change)})


def structure(table: Constants) -> Constants:
    """The table without what no program depends on."""
    entries = tuple(dataclasses.replace(entry, source="") for entry in table.constant)
    return dataclasses.replace(table, constant=entries)


def key_problems(scene: Any, table: Constants, where: str) -> list[str]:
    """Keys that are no constants which a trial may have."""
    known = set()
    for path, _ in jax.tree_util.tree_leaves_with_path(scene):
        key = jax.tree_util.keystr(path).lstrip(".")
        known |= {re.sub(r"\[\d+\]", "", key), re.sub(r"\[(\d+)\]", r".\1", key)}
    for shape in scene.objects.object:
        known |= {f"objects.object.{shape.name}.{n}" for n in ("friction", "mass")}
    known = {key for key in known if key.split(".")[0] in ROOTS}
    problems = []
    for entry in table.constant:
        if entry.key not in known:
            problems.append(
                schema.Problem(
                    "unknown",
                    f"{where}: {entry.key!r} is no constant; {schema.nearest(entry.key, known)}",
                )
            )
    return problems


def nominal(table: Constants) -> dict[tuple[str, ...], Any]:
    """Values by key path that make a scene's own constants the middle of their distributions."""
    values: dict[tuple[str, ...], Any] = {
        e.path: e.middle for e in table.constant if e.change == "value"
    }
    if table.law is not None and ("hand", "material", "shear_modulus") in values:
        values["hand", "material", "law"] = table.law
    return values


def of_logs(
    keys: Sequence[str], mean: np.ndarray, covariance: np.ndarray, law: str, source: str
) -> Constants:
    """The table of constants whose logarithms are normal.

    Args:
      mean: Means of the logarithms, shape (K,).
      covariance: Their covariance, shape (K, K).
    """
    sd = np.sqrt(np.diag(covariance))
    near = covariance / np.outer(sd, sd)
    entries = (
        Constant(
            key=key,
            distribution="lognormal",
            source=source,
            mean=_short(math.exp(mean[i])),
            sd=_short(sd[i]),
            correlation=tuple(round(float(v), 4) for v in near[i, :i]),
        )
        for i, key in enumerate(keys)
    )
    return Constants(law=law, constant=tuple(entries))


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def plain(table: Constants) -> dict[str, Any]:
    """The table as a file has it, as dictionaries and lists."""
    entries = [
        {
            k: list(v) if isinstance(v, tuple) else v
            for k, v in dataclasses.asdict(e).items()
            if v is not None and v != ()
        }
        for e in table.constant
    ]
    top = {} if table.law is None else {"law": table.law}
    return top | {"constant": entries}


def text(table: Constants) -> str:
    """The file of a table."""
    return tomli_w.dumps(plain(table))
