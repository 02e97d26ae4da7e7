"""Says whether this checkout and another one write the same kernels, scene by scene.

python -m scripts.same_kernels /path/to/other/checkout      # exit status 1 if any differs

Compares the LLVM text that the compiler writes for a block on CPUs and for a thread on NVIDIA GPUs
(no GPU is needed), of rollouts, a derivative and recorded forces, both in this Python environment.
Run it before a change that must leave the simulation as it is goes to main.  A checkout that has
this module runs its own copy of it, so that the names that it uses may move.
"""

import argparse
import hashlib
import json
import os
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
    "derivative of paper": {"derivative": True},
    "forces of paper": {"forces": True},
}
WORLDS = 64
STEPS = 20


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
        overrides={"effects": values.get("effects", {})},
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


def digests() -> dict[str, list[str]]:
    """SHA-256 of the texts, by scene and backend."""
    by_case = {}
    for name, values in SCENES.items():
        for backend in ("cpu", "gpu"):
            every = texts(values, backend)
            by_case[f"{name}, {backend}"] = [hashlib.sha256(t.encode()).hexdigest() for t in every]
            print(name, backend, [len(t) for t in every], file=sys.stderr, flush=True)
    return by_case


def of(folder: Path) -> dict[str, list[str]]:
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
    for name in mine:
        same = mine[name] == theirs.get(name) and len(mine[name]) > 0
        print(f"{'same' if same else 'DIFFERENT':9}  {name}")
    return int(any(mine[name] != theirs.get(name) or not mine[name] for name in mine))


if __name__ == "__main__":
    sys.exit(main())
