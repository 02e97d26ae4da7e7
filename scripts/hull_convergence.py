"""Contact force of the skinned hull against its mesh density.

  python -m scripts.hull_convergence --out FILE.json --figure FILE.png

A hand with long fingers closes on each object of the paper and is at rest just before the lift.
Two forces of the fingers on the object are measured at every density: with the hand where the
finest mesh came to rest (only the points differ) and where each mesh itself comes to rest.  In
float64.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from codesign_jax import control, model, rollout, scene
from codesign_jax.engines.structured import StructuredEngine, assembly
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import parameters
from codesign_jax.types import Trial
from scripts.shared import figures as pictures
from scripts.shared import output

DENSITIES = ((1, 4), (1, 8), (2, 8), (3, 12), (4, 16), (8, 32))
DESIGN = np.array([0.148, -0.059])  # length and arm height [m] of a hand that holds all three


@dataclasses.dataclass
class Options:
    """Where results go."""

    out: Path = Path("runs/hull_convergence.json")
    figure: Path | None = None


class Case:
    """The hand on every object of the set at one density."""

    def __init__(self, rings: int, points: int):
        """Prepares scene and worlds, one a shape."""
        density = {"hull_rings": rings, "hull_points": points}
        overrides = {"effects": {"surface": "hull"}, "discretization": density}
        self.scene = scene.load("paper_spheres", overrides=overrides)
        space = parameters.design_space(self.scene.hand, "2d")
        shapes = range(len(self.scene.objects.object))
        trials = [rollout.nominal_trial(self.scene, i) for i in shapes]
        params = [space.params(jnp.asarray(DESIGN))] * len(trials)
        batch = [jax.tree.map(lambda *v: jnp.stack(v), *x) for x in (params, trials)]
        fields = jax.vmap(lambda p, t: model.model_fields(self.scene, p, Trial(*t)))(*batch)
        self.ctrl = jax.vmap(lambda p, t: control.commands(self.scene, p, Trial(*t)))(*batch)
        self.engine = StructuredEngine(self.scene, tolerance=1e-10, iterations=60)
        self.hand, self.state = world_constants(self.scene, fields), self.engine.reset(fields)

    def settle(self) -> None:
        """Steps to just before the lift."""
        steps = round(self.scene.phases.inflate / self.scene.discretization.timestep) - 5

        run = jax.jit(lambda *args: self.engine.advance(*args)[1])
        self.state = run(self.hand, self.state, self.ctrl[:, :steps])

    def force(self, state) -> np.ndarray:
        """Sum of the normal forces that the penetrations cause [N], shape (world,)."""

        @jax.jit
        def total(hand, state, u):
            found = assembly.problem(self.scene, hand, state, u)[0]
            c = found.contacts["hull_object"]
            push = c.cone.normal * c.cone.spring * jnp.maximum(-c.distance, 0.0)
            return push.sum((0, 1, 2)), (push > 0).sum((0, 1, 2))

        found = total(self.hand, state, self.ctrl[:, 0].T)
        return np.stack([np.asarray(v) for v in found])


def main(options: Options) -> None:
    """Measures and writes."""
    cases = {d: Case(*d) for d in DENSITIES}
    rows, own = [], {}
    for d, case in cases.items():
        case.settle()
        own[d] = case.force(case.state)
        print(d, own[d], flush=True)
    finest = cases[DENSITIES[-1]].state
    for (rings, points), case in cases.items():
        rest, touching = own[rings, points]
        rows.append(
            {
                "hull_rings": rings,
                "hull_points": points,
                "force_same_place": case.force(finest)[0].tolist(),
                "force_at_rest": rest.tolist(),
                "points_in_contact": touching.tolist(),
            }
        )
        print(rows[-1], flush=True)
    shapes = [o.name for o in cases[DENSITIES[0]].scene.objects.object]
    record = {"shapes": shapes, "rows": rows}
    output.write_json(options.out, record)
    if options.figure:
        draw(record, options.figure)


def draw(record: dict, path: Path) -> None:
    """Relative deviation from the finest mesh against the vertices of a link."""
    figure = pictures.new(9, 3.6)
    rows = record["rows"]
    x = [r["hull_rings"] * r["hull_points"] for r in rows]
    for i, key in enumerate(("force_same_place", "force_at_rest")):
        axes = figure.add_subplot(1, 2, i + 1)
        for k, shape in enumerate(record["shapes"]):
            force = np.array([r[key][k] for r in rows])
            axes.plot(x[:-1], np.abs(force[:-1] / force[-1] - 1), "o-", label=shape)
        axes.set(xscale="log", yscale="log", xlabel="hull points a link", ylim=(1e-3, 1))
        axes.set_xticks(x[:-1], [str(n) for n in x[:-1]])
        axes.minorticks_off()
        axes.set_title(("hand in the same place", "each at its own rest")[i])
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("normal force, deviation from the finest mesh")
    figure.axes[0].legend()
    pictures.save(figure, path, dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(tyro.cli(Options))
