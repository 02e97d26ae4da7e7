"""A grasp as a model that plain MuJoCo opens and simulates as the engine `mujoco` does.

MJCF has no word for `body_invweight0`, which this project declares instead of deriving it from
masses (`model.contact_invweight`): MuJoCo's compiler computes its own, and contacts get another
stiffness.  It enters a contact of bodies 1 and 2 only through the regularization of its normal,
  R = (1 - d) / d (w_1 + w_2),
with d the pair's impedance, which is constant here.  The pair's impedance can therefore take up
the difference: with W the declared and w the compiled sum of the two,
  (1 - d') / d' = (1 - d) / d W / w.
The reference acceleration -B v - K d r of a violation r has in MuJoCo's direct format
solref = (-k, -b) the coefficients K = k / d^2 and B = b / d: it stays if both are multiplied by
d' / d.  Friction follows from the normal's R and B.  Formulas of MuJoCo: documentation,
Computation, "Parameters".
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from codesign_jax.export import mjcf
from codesign_jax.model import contact_invweight, morphology
from codesign_jax.model.held import keeps
from codesign_jax.model.layout import sections_grow
from codesign_jax.model.pairs import SOLIMP
from codesign_jax.scene import Scene, effects, silicones
from codesign_jax.types import Params, Trial

_SOFTNESS = (1e-4 / (1 - 1e-4), (1 - 1e-4) / 1e-4)
"""Of (1 - d) / d, as MuJoCo keeps an impedance d between 0.0001 and 0.9999."""


NONE: Mapping[str, float] = MappingProxyType({})


class Inexpressible(ValueError):
    """A contact that MJCF cannot say."""


def differences(scene: Scene) -> list[str]:
    """What of a scene the model lacks or has in another form, a sentence each."""
    left_out = {name: effect.plain for name, effect in effects.EFFECTS.items() if effect.plain}
    acts = {name: getattr(scene.effects, name) for name in left_out}
    acts |= {"friction_memory": keeps(scene), "section_growth": sections_grow(scene)}
    sentences = [
        f"the model is without effects.{name}: {sentence}"
        for name, sentence in left_out.items()
        if acts[name]
    ]
    if scene.hand.section.law == "elements":
        sentences.append(
            'the model is without hand.section.law = "elements": springs and moments of joints '
            "are linear, with the moment per pressure that bends free fingers as far"
        )
    sentences.append(
        "the model takes centrifugal and Coriolis forces whole: bodies that turn by more than half "
        "a radian a step gain energy, which engine structured prevents"
    )
    if scene.effects.surface == "hull":
        sentences.append(
            'the model has effects.surface = "hull" as spheres at its rings and capsules of fingers'
        )
    return sentences + [
        f"the model has the mesh {shape.name!r} as its convex hull"
        for shape in scene.objects.object
        if shape.mesh
    ]


def single_object(scene: Scene, params: Params, trial: Trial) -> tuple[Scene, Trial]:
    """The scene with the trial's object alone and linear walls, and the trial in it."""
    scene = silicones.under(_with_chambers(scene, params), neo_hookean=False)
    alone = dataclasses.replace(scene.objects, object=(scene.objects.object[int(trial.shape)],))
    return dataclasses.replace(scene, objects=alone), trial._replace(shape=np.int32(0))


def _with_chambers(scene: Scene, params: Params) -> Scene:
    """A scene whose sections have the law "chamber", and bend as far without load as before."""
    if scene.hand.section.law == "chamber":
        return scene
    section = dataclasses.replace(scene.hand.section, law="chamber")
    hand = dataclasses.replace(scene.hand, section=section)
    plain = silicones.under(dataclasses.replace(scene, hand=hand), neo_hookean=False).hand
    wanted = morphology.free_bends(scene.hand, params)
    bends = morphology.free_bends(plain, params, neo_hookean=False)
    factor = np.where(bends > 0, wanted / np.where(bends > 0, bends, 1.0), 1.0)
    moment = scene.hand.material.moment_factor * factor[:, None]  # a factor of each finger
    material = dataclasses.replace(hand.material, moment_factor=moment)
    return dataclasses.replace(scene, hand=dataclasses.replace(hand, material=material))


def engine_model(
    scene: Scene, spec: mujoco.MjSpec, shares: Mapping[str, float] = NONE
) -> mujoco.MjModel:
    """Compiles a spec to the model of the engine `mujoco`, with declared inverse weights."""
    if shares:
        spec = spec.copy()
        for pair in spec.pairs:
            if (share := _share(pair, shares)) < 1:
                _absorb(pair, 1 / share)
    model = spec.compile()
    model.body_invweight0[1:] = contact_invweight(scene)
    return model


def text(scene: Scene, spec: mujoco.MjSpec, shares: Mapping[str, float] = NONE) -> str:
    """MJCF which plain MuJoCo compiles to a model of the same dynamics as `engine_model`."""
    compiled = spec.compile().body_invweight0[:, 0]
    declared = contact_invweight(scene)
    body_of = {geom.name: geom.parent.id for geom in spec.geoms}
    for pair in spec.pairs:
        names = pair.geomname1, pair.geomname2
        bodies = [body_of[name] for name in names]
        mass = declared * sum(body > 0 for body in bodies) / _share(pair, shares)
        if not _absorb(pair, mass / compiled[bodies].sum()):
            why = "" if scene.effects.wrist else ", for effects.wrist = false makes the palm heavy"
            raise Inexpressible(
                f"the contact of {names[0]} and {names[1]} would need an impedance outside of "
                f"MuJoCo's 0.0001 to 0.9999{why}; the binary model (.mjb) has the contact"
            )
    return mjcf.text(spec)


def _share(pair: mujoco.MjsPair, shares: Mapping[str, float]) -> float:
    return min(shares.get(name, 1.0) for name in (pair.geomname1, pair.geomname2))


def _absorb(pair: mujoco.MjsPair, ratio: float) -> bool:
    """Gives a pair the impedance and reference of the module's formulas; False if it cannot."""
    d = float(pair.solimp[0])
    softness = (1 - d) / d * ratio
    if not _SOFTNESS[0] <= softness <= _SOFTNESS[1]:
        return False
    impedance = 1 / (1 + softness)
    pair.solimp = [impedance, impedance, *SOLIMP]
    pair.solref = [impedance / d * float(v) for v in pair.solref]
    return True
