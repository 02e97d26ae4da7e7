"""Constants that nobody knows exactly: a table of their distributions, and draws from it.

A file of them has a table `[[constant]]` for each.  `codesign finger --posterior` writes the
constants of a finger that was measured; `constants/unmeasured.toml` has those of a hand before it
is built.

>>> import jax
>>> from codesign_jax.scene import draws
>>> table = draws.read("unmeasured")
>>> values = draws.drawn(table, jax.random.key(0), 1000)  # (draw, constant)
>>> place = [entry.key for entry in table.constant].index("objects.object.friction")
>>> bool(0.7 <= values[:, place].min() and values[:, place].max() <= 1.4)  # a factor
True
"""

import dataclasses
import math
from collections.abc import Sequence
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
_WIDEST = 1e9


@dataclasses.dataclass(frozen=True)
class Constant:
    """A constant and its distribution.

    Attributes:
      key: Key path of a number of the scene, such as `hand.material.shear_modulus`; one that leaves
        out an entry of a list means all of its entries.
      distribution: "lognormal" and "normal" have `mean` and `sd`, "loguniform" and "uniform" `low`
        and `high`.
      change: What a draw is: the constant's "value", a "factor" on the scene's, or a "shift".
      mean: Its mean; of "lognormal" its median.
      sd: Its standard deviation; of "lognormal" that of the logarithm.
      low: Its lower end.
      high: Its upper end.
      correlation: With each of the constants before it, of their normal scores; as many as are
        given, the others 0.
      source: Where the distribution comes from.
    """

    key: str
    source: str
    distribution: str = choice("lognormal", "normal", "loguniform", "uniform")
    change: str = choice(*CHANGES, default="value")
    mean: float | None = quantity("", -_WIDEST, _WIDEST, structure=True, default=None)
    sd: float | None = quantity("", 0, _WIDEST, structure=True, default=None)
    low: float | None = quantity("", -_WIDEST, _WIDEST, structure=True, default=None)
    high: float | None = quantity("", -_WIDEST, _WIDEST, structure=True, default=None)
    correlation: tuple[float, ...] = quantity("", -1, 1, structure=True, default=())

    @property
    def path(self) -> tuple[str, ...]:
        """Its key's parts."""
        return tuple(self.key.split("."))

    @property
    def logarithmic(self) -> bool:
        """Whether its logarithm is normal or uniform."""
        return self.distribution.startswith("log")

    @property
    def middle(self) -> float:
        """Its mean, of logarithmic distributions its median."""
        if self.mean is not None:
            return self.mean
        assert self.low is not None and self.high is not None
        if self.logarithmic:
            return math.sqrt(self.low * self.high)
        return (self.low + self.high) / 2

    @property
    def spread(self) -> float:
        """Its standard deviation, of logarithmic distributions the logarithm's."""
        if self.sd is not None:
            return self.sd
        assert self.low is not None and self.high is not None
        ends = np.log([self.low, self.high]) if self.logarithmic else (self.low, self.high)
        return float(ends[1] - ends[0]) / math.sqrt(12)

    def of_score(self, score: Any) -> Any:
        """The draw of a normal score, any shape; JAX."""
        if self.mean is not None and self.sd is not None:
            if self.logarithmic:
                return self.mean * jnp.exp(self.sd * score)
            return self.mean + self.sd * score
        assert self.low is not None and self.high is not None
        share = norm.cdf(score)
        if self.logarithmic:
            return self.low * (self.high / self.low) ** share
        return self.low + (self.high - self.low) * share


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
        place = f"{where}.constant {entry.key}"
        names = ("mean", "sd") if entry.distribution.endswith("normal") else ("low", "high")
        numbers = [getattr(entry, n) for n in names]
        given = {n for n in ("mean", "sd", "low", "high") if getattr(entry, n) is not None}
        if given != set(names):
            words = f"{' and '.join(names)}, and no other number"
            problems.append(f"{place}: distribution {entry.distribution!r} has {words}")
        elif entry.logarithmic and numbers[0] <= 0:
            problems.append(f"{place}: {names[0]} of a {entry.distribution} is above 0")
        elif names[0] == "low" and not numbers[0] < numbers[1]:
            problems.append(f"{place}: low = {numbers[0]:g} must be below high = {numbers[1]:g}")
        if entry.key in keys[:i]:
            problems.append(f"{place} is given more than once")
        if len(entry.correlation) > i:
            problems.append(
                f"{place}: correlation has {len(entry.correlation)} numbers, {i} before it"
            )
    if not problems and (np.linalg.eigvalsh(correlations(table)) < -1e-6).any():
        problems.append(f"{where}: the correlations contradict one another")
    return problems


def correlations(table: Constants) -> np.ndarray:
    """Correlations of the normal scores, shape (constant, constant)."""
    matrix = np.eye(len(table.constant))
    for i, entry in enumerate(table.constant):
        matrix[i, : len(entry.correlation)] = entry.correlation
        matrix[: len(entry.correlation), i] = entry.correlation
    return matrix


def root(table: Constants) -> np.ndarray:
    """A root of the correlations, by which independent scores are multiplied."""
    values, vectors = np.linalg.eigh(correlations(table))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def drawn(table: Constants, key: jax.Array, count: int) -> jax.Array:
    """Draws, shape (draw, constant): in the units of their keys, or factors.

    Draw t is that of fold_in(key, t), so that more draws do not change earlier ones.
    """
    size = len(table.constant)
    keys = jax.vmap(lambda t: jax.random.fold_in(key, t))(jnp.arange(count))
    scores = jax.vmap(lambda k: jax.random.normal(k, (size,)))(keys) @ root(table).T
    return jnp.stack([e.of_score(scores[:, i]) for i, e in enumerate(table.constant)], -1)


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


def text(table: Constants) -> str:
    """The table as a file has it."""
    entries = [
        {
            k: list(v) if isinstance(v, tuple) else v
            for k, v in dataclasses.asdict(e).items()
            if v is not None and v != ()
        }
        for e in table.constant
    ]
    top = {} if table.law is None else {"law": table.law}
    return tomli_w.dumps(top | {"constant": entries})
