"""What a gradient of whole grasps costs on this device.

python -m scripts.gradient_cost --scenes paper paper_spheres --worlds 60 --json runs/gradients.json

With `CODESIGN_CACHE=off` in the environment it shows what a first call costs, otherwise, run twice,
a call that finds kernels and programs on disk.
"""

import json
from pathlib import Path

from codesign_jax import scene as scenes
from codesign_jax import use_compilation_cache
from scripts.shared import gradients, output, provenance


def main() -> int:
    """Command line."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--scenes", nargs="+", default=["paper_spheres", "paper"])
    parser.add_argument("--worlds", nargs="+", type=int, default=[60])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    use_compilation_cache()
    cases = []
    for name in arguments.scenes:
        for worlds in arguments.worlds:
            cases.append({"scene": name} | gradients.cost(scenes.load(name), worlds))
            print(json.dumps(cases[-1]), flush=True)
    if arguments.json:
        made = provenance.measurement(arguments.commit)
        output.write_json(arguments.json, {"provenance": made, "cases": cases})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
