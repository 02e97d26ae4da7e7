"""Says whether this checkout and another one write the same kernels, scene by scene.

python -m scripts.same_kernels /path/to/other/checkout      # exit status 1 if any differs

Compares the LLVM text that the compiler writes for a block on CPUs and for a thread on NVIDIA GPUs
(no GPU is needed), of rollouts, a derivative and recorded forces, both in this Python environment.
Run it before a change that must leave the simulation as it is goes to main.  A checkout that has
this module runs its own copy of it, so that the names that it uses may move.

A kernel is *same* if its text is, and *reordered* if it has the same operations on the same values
in another order, see `without_order`: it computes the same numbers.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[1]
SCENES: dict[str, dict[str, Any]] = {
    "paper": {},
    "paper_spheres": {"name": "paper_spheres"},
    "household meshes": {"object_set": "household"},
    "neo_hookean": {"effects": {"neo_hookean": True}},
    "pressure_dynamics, lateral_threshold": {
        "effects": {"pressure_dynamics": True, "lateral_threshold": True}
    },
    "air_mass, no friction_memory": {"effects": {"air_mass": True, "friction_memory": False}},
    "fixtures": {"name": "edge"},
    "law elements": {"overrides": {"hand": {"section": {"law": "elements"}}}},
    "no contacts of the hand with itself": {
        "effects": {"finger_finger": False, "finger_palm": False, "finger_itself": False}
    },
    "derivative of paper": {"derivative": True},
    "forces of paper": {"forces": True},
}
WORLDS = 64
STEPS = 20
NAME = re.compile(r"%[A-Za-z]\w*")
# Intrinsics that neither read nor write memory, nor wait for other lanes
PURE = re.compile(
    r"@llvm\.(nvvm\.(div|sqrt|rcp|rsqrt|ex2|lg2|sin|cos|read)"
    r"|vector\.reduce|fptosi|fptoui|fabs|fma|rint|floor|ceil|sqrt|exp|exp2|log|log2|sin|cos"
    r"|copysign|maximum|minimum|maxnum|minnum|smax|smin|umax|umin|abs|ctpop|ctlz|cttz)\b"
)
EXCHANGE = "@llvm.nvvm.shfl.sync"
"""Lanes read one another's registers: between two effects in any order."""


def texts(values: dict[str, Any], backend: str) -> list[str]:
    """LLVM texts of the kernels that a rollout of a scene asks for, in the order of the calls."""
    import jax
    import jax.numpy as jnp

    from codesign_jax import rollout, scene
    from codesign_jax.compiler import cpu, launch, thread
    from codesign_jax.engines.structured import StructuredEngine
    from codesign_jax.engines.structured.kernel import program
    from codesign_jax.scene import parameters

    chosen = scene.load(
        values.get("name", "paper"),
        object_set=values.get("object_set"),
        overrides={"effects": values.get("effects", {}), **values.get("overrides", {})},
    )
    space = parameters.design_space(chosen.hand)
    trials = rollout.sample_trials(chosen, jax.random.key(0), WORLDS)
    texts_by_key: dict[str, str] = {}

    def record(call: Any, inputs: Any, outputs: Any, kernel: Any) -> list[Any]:
        avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in inputs]
        # Asked for with one block and then with all of them; the text is that of a block.
        key = repr((kernel, [(x.shape[1:], x.dtype) for x in avals]))
        if key not in texts_by_key:
            layout = launch.describe(inputs, outputs, kernel)
            jaxpr = launch.kernel_jaxpr(call, avals)
            cpus = backend == "cpu"
            texts_by_key[key] = (
                cpu.block_code(jaxpr, layout) if cpus else thread.write(jaxpr, layout, "kernel")
            )
        unread = {*kernel.scratch, *kernel.onchip}
        return [None if k in unread else jnp.zeros(x.shape, x.dtype) for k, x in enumerate(outputs)]

    def distance(design: jax.Array, trials: Any) -> jax.Array:
        engine = StructuredEngine(chosen)

        def run(trial: Any) -> Any:
            params = space.params(design)
            forces = values.get("forces", False)
            return rollout.grasp(chosen, engine, params, trial, steps=STEPS, record_forces=forces)

        return jax.vmap(run)(trials).distance.sum()

    function = jax.grad(distance) if values.get("derivative") else distance
    with (
        mock.patch.object(jax, "default_backend", lambda: backend),
        mock.patch.object(launch, "available", lambda platform: None),
        mock.patch.object(program, "launch", record),
    ):
        jax.clear_caches()  # what was traced for the other backend
        jax.eval_shape(function, jnp.asarray(space.default(), jnp.float32), trials)
    return [*texts_by_key.values()]


def without_order(text: str) -> str:
    """What a text computes, the same for each order of operations that do not depend on each other.

    Values have the names of the expressions that give them. Those of loads depend on what was
    stored before: on the number of stores, branches and other effects, which keep their order and
    are the lines that are left.
    """
    names: dict[str, str] = {}
    kept: list[str] = []
    effects = 0

    def named(expression: str) -> str:
        return NAME.sub(lambda m: names.get(m.group(), m.group()), expression)

    lines = [line.strip() for line in text.splitlines()]
    for line in lines:
        if line.endswith(":"):
            names["%" + line[:-1]] = f"%block{len(names)}"
    for line in lines:
        name, assigned, expression = (
            line.partition(" = ") if line.startswith("%") else ("", "", line)
        )
        called = re.search(r"\bcall\b", expression) is not None
        pure = called and (PURE.search(expression) or EXCHANGE in expression)
        if line.endswith(":"):
            effects += 1
            kept.append("%" + line[:-1])
        elif expression.startswith("phi "):
            names[name] = f"%phi{len(kept)}"
            kept.append(line)
        elif assigned and (pure or not (called or expression.startswith("alloca "))):
            reads = expression.startswith("load ") or EXCHANGE in expression
            content = f"{effects if reads else ''}: {named(expression)}"
            names[name] = "%" + hashlib.sha256(content.encode()).hexdigest()[:16]
        else:
            effects += 1
            if assigned:
                names[name] = f"%effect{effects}"
            kept.append(line)
    # At the end, as a loop's first value may have the name of one that comes behind it.
    return "\n".join(named(line) for line in kept)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def digests() -> dict[str, list[list[str]]]:
    """SHA-256 of the texts and of the texts without their order, by scene and backend."""
    by_case = {}
    for name, values in SCENES.items():
        for backend in ("cpu", "gpu"):
            every = texts(values, backend)
            by_case[f"{name}, {backend}"] = [[_digest(t), _digest(without_order(t))] for t in every]
            print(name, backend, [len(t) for t in every], file=sys.stderr, flush=True)
    return by_case


def verdict(mine: list, theirs: list | None) -> str:
    """How a scene's kernels compare; older copies of this module tell the texts' digests alone."""
    if not mine or theirs is None or len(mine) != len(theirs):
        return "DIFFERENT"
    texts_of_others = [other if isinstance(other, str) else other[0] for other in theirs]
    if texts_of_others == [text for text, _ in mine]:
        return "same"
    return "reordered" if [pair[1] for pair in mine] == [o[1] for o in theirs] else "DIFFERENT"


def of(folder: Path) -> dict[str, list]:
    """The digests of a checkout, by a process that imports the package from there."""
    script = folder / "scripts" / Path(__file__).name
    command = [sys.executable, str(script if script.exists() else Path(__file__)), "--print"]
    environment = {**os.environ, "PYTHONPATH": str(folder), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def main() -> int:
    """Prints a line for each scene and backend; returns 1 if any differs, and 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path, nargs="?", help="folder of the other checkout")
    parser.add_argument("--print", action="store_true", help="print this checkout's digests alone")
    args = parser.parse_args()
    if args.print:
        print(json.dumps(digests()))
        return 0
    if args.other is None:
        parser.error("name the folder of the other checkout")
    mine = of(ROOT)
    theirs = of(args.other.resolve())
    verdicts = {name: verdict(mine[name], theirs.get(name)) for name in mine}
    for name, said in verdicts.items():
        print(f"{said:9}  {name}")
    return int("DIFFERENT" in verdicts.values())


if __name__ == "__main__":
    sys.exit(main())
