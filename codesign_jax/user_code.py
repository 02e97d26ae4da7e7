"""Code of the user, named on the command line as `module:name`: an optimiser, a cost or a policy.

The module is sought in the working directory first, then among the installed packages.  It is
imported for a command line that names it and for nothing else: no file can ask for it.
"""

import functools
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.engines import DEFAULT, make_engine
from codesign_jax.engines.base import recording
from codesign_jax.optimize import Optimizer, OptimizerState, Space
from codesign_jax.policy import ControlLoop, Policy, searched
from codesign_jax.rollout import CostFunction
from codesign_jax.scene import InputError, Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import Outcome, Params, Trace

FOLDER = "code"
"""Folder of a run with the modules that it was made with."""
_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def is_user_code(name: str) -> bool:
    """Whether a name is one of the user's own, and none of this package's."""
    return ":" in name


def problem(name: str) -> str | None:
    """The problem with the name itself, in words; nothing is imported."""
    module, colon, attribute = name.rpartition(":")
    if colon and module.endswith(".py"):
        dotted = ".".join(Path(module.removesuffix(".py")).parts)
        if _NAME.fullmatch(better := f"{dotted}:{attribute}"):
            return f"{name!r} names a file in place of a module; did you mean {better}?"
    if _NAME.fullmatch(name):
        return None
    return f"{name!r} must be MODULE:NAME, such as mine:Search for the class Search of mine.py"


def contents(names: Iterable[str]) -> dict[str, bytes]:
    """The modules of these names by the names of their files in a run folder.

    They are the file that each name's module was read from, and the one that defines the object
    where that is another; what these import is not among them.
    """
    code_files = {}
    for name in filter(is_user_code, names):
        target = _load(name)
        modules = {name.partition(":")[0], getattr(target, "__module__", None)}
        for module in modules & {*sys.modules}:
            code_files[f"{FOLDER}/{module}.py"] = _source(name, module).read_bytes()
    return code_files


def make_cost(name: str, scene: Scene) -> tuple[CostFunction, bool]:
    """Imports a cost and tries it without values; also whether a grasp ends where it is lost."""
    flag = f"--cost {name}"
    cost = _load(name, "--cost")
    _refuse_signature(flag, cost, ("scene", "trace", "ctrl"))
    stops = getattr(cost, "stop_when_lost", False)
    if not isinstance(stops, bool):
        raise InputError.of("type", f"{flag}: its attribute stop_when_lost must be True or False")

    forces = getattr(cost, "record_forces", False)
    if not isinstance(forces, bool):
        raise InputError.of("type", f"{flag}: its attribute record_forces must be True or False")

    def judge(trace: Trace, params: Params, trials: Any) -> Outcome:
        ctrl = rollout.prepare(scene, params, trials)[1]
        initial = jnp.zeros(len(ctrl), jnp.int32)
        options = rollout.Options(record_qpos=not stops, stop_when_lost=stops, cost=cost)
        return rollout.judge(scene, trace, ctrl, initial, trials, options)

    world = jax.tree.map(
        lambda v: jnp.asarray(v)[None], (_hand(scene), rollout.nominal_trial(scene))
    )
    fields, ctrl = jax.eval_shape(lambda p, t: rollout.prepare(scene, p, t), *world)
    dtype = jnp.result_type(float)
    series: Any = jax.ShapeDtypeStruct((1, scene.num_steps), dtype)
    size = (1, scene.num_steps, fields.start.shape[-1] if not stops else 0)
    qpos: Any = jax.ShapeDtypeStruct(size, dtype)
    trace = Trace(series, series, series, qpos)
    if forces:
        engine = recording(make_engine(DEFAULT, scene))
        trace = trace._replace(forces=jax.eval_shape(engine.rollout, fields, ctrl).forces)
    _tried(flag, cost, lambda: jax.eval_shape(judge, trace, *world))
    return cost, stops


def make_policy(name: str, scene: Scene) -> tuple[Policy, Scene]:
    """Imports a policy, or a class that makes one of a scene, and tries it without values.

    With it the scene that has what the policy lets a search move, see `policy.searched`.
    """
    return _policy(f"--policy {name}", _load(name, "--policy"), scene)


@functools.lru_cache(maxsize=16)
def _policy(flag: str, code: Any, scene: Scene) -> tuple[Policy, Scene]:
    policy = code
    if inspect.isclass(policy):
        _refuse_signature(flag, policy, ("scene",))
        policy = _tried(flag, code, lambda: code(scene))
    _refuse_signature(flag, policy, ("carry", "observation"))
    scene = _tried(flag, code, lambda: searched(scene, policy))
    loop = ControlLoop(make_engine(DEFAULT, scene), policy)
    world = _hand(scene), rollout.nominal_trial(scene)
    _tried(flag, code, lambda: jax.eval_shape(loop.first_command, *world))
    return policy, scene


def make_optimizer(name: str, space: Space, num_particles: int | None = None) -> Optimizer:
    """Imports an optimiser's class, or whatever makes one from a space."""
    flag = f"--optimizer {name}"
    make = _load(name, "--optimizer")
    _refuse_signature(flag, make, ("space",))
    optimizer = _tried(flag, make, lambda: make(space))
    missing = [
        n for n in ("space", "keeps_best", "init", "ask", "tell") if not hasattr(optimizer, n)
    ]
    if missing:
        raise InputError.of(
            "missing", f"{flag}: it lacks {', '.join(missing)} of optimize.Optimizer"
        )
    if any(leaf is optimizer for leaf in jax.tree.leaves(optimizer)):
        raise InputError.of(
            "type",
            f"{flag}: it is no pytree: make it a dataclass and register that with "
            "jax.tree_util.register_dataclass",
        )
    if num_particles is not None:
        _try(flag, make, optimizer, num_particles)
    return optimizer


def _try(flag: str, make: Any, optimizer: Optimizer, n: int) -> None:
    low = np.asarray(optimizer.space.low)
    high = np.asarray(optimizer.space.high)
    seed = jnp.asarray((low + high) / 2, float)
    mask = np.ones(low.shape, bool)
    state = _tried(flag, make, lambda: optimizer.init(jax.random.key(0), seed, n))
    if not isinstance(state, OptimizerState) or np.shape(state.particles) != (n, low.size):
        raise InputError.of(
            "type",
            f"{flag}: init must return an optimize.OptimizerState with particles ({n}, {low.size})",
        )

    def episode(state: OptimizerState) -> tuple[jax.Array, Any]:
        population = optimizer.ask(state, mask)
        return population, optimizer.tell(state, population, jnp.zeros(n), mask)

    population, result = _tried(flag, make, lambda: jax.eval_shape(episode, state))
    if population.shape != (n, low.size):
        raise InputError.of(
            "size", f"{flag}: ask returns {population.shape}, not ({n}, {low.size})"
        )
    if not (isinstance(result, tuple) and len(result) == 2 and _same(state, result[0])):
        raise InputError.of(
            "size",
            f"{flag}: tell must return a state, with the arrays of init's in shape and type, "
            "and an optimize.Info (`optimize.protocol.summarize` makes one)",
        )


def _same(before: Any, after: Any) -> bool:
    """Whether two trees have the same arrays in shape and type."""
    like = jax.eval_shape(lambda: before)
    if jax.tree.structure(like) != jax.tree.structure(after):
        return False
    pairs = zip(jax.tree.leaves(like), jax.tree.leaves(after), strict=True)
    return all((a.shape, a.dtype) == (b.shape, b.dtype) for a, b in pairs)


def _hand(scene: Scene) -> Params:
    space = design_space(scene.hand)
    return space.params(space.default())


def _load(name: str, flag: str = "") -> Any:
    begin = f"{flag} {name}".strip()
    if words := problem(name):
        raise InputError.of("syntax", f"{flag}: {words}".removeprefix(": "))
    module, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        importlib.invalidate_caches()
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise InputError.of("user_code", f"{begin}: {_where(error, None)}") from error
        raise InputError.of(
            "missing",
            f"{begin}: there is no module {module!r} in {folder} or among the installed packages",
        ) from error
    except (Exception, SystemExit) as error:
        raise InputError.of(
            "user_code", f"{begin}: importing it fails: {_where(error, None)}"
        ) from error
    finally:
        sys.path.remove(folder)
    if not hasattr(imported, attribute):
        place = getattr(imported, "__file__", None) or module
        raise InputError.of("user_code", f"{begin}: {place} has no {attribute!r}")
    return getattr(imported, attribute)


def _source(name: str, module: str) -> Path:
    try:
        return Path(inspect.getsourcefile(sys.modules[module]) or "").resolve(strict=True)
    except (TypeError, OSError) as error:
        raise InputError.of(
            "missing",
            f"{name}: module {module} has no file of Python code, which a run keeps a copy of",
        ) from error


def _refuse_signature(flag: str, function: Any, arguments: tuple[str, ...]) -> None:
    expected = f"a function of ({', '.join(arguments)})"
    if not callable(function):
        raise InputError.of("type", f"{flag}: it is {type(function).__name__}, not {expected}")
    try:
        inspect.signature(function).bind(*arguments)
    except ValueError:  # it does not tell
        pass
    except TypeError as error:
        raise InputError.of("type", f"{flag}: it must be {expected}: {error}") from error


def _tried(flag: str, code: Any, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except Exception as error:
        raise InputError.of("user_code", f"{flag}: {_where(error, code)}") from error


def _where(error: BaseException, code: Any) -> str:
    """An error with the line of the user's code that it comes from; of its last line if no code."""
    words = f"{type(error).__name__}: {' '.join(str(error).split())}"
    try:
        source_file = None if code is None else inspect.getsourcefile(code)
    except TypeError:
        source_file = None
    frames = traceback.extract_tb(error.__traceback__)
    lines = [
        f
        for f in frames
        if f.filename == source_file or (source_file is None and "importlib" not in f.filename)
    ]
    return f"{words} ({lines[-1].filename}, line {lines[-1].lineno})" if lines else words
