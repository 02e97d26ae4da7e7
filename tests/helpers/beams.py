"""One finger of the package that rests under loads."""

import dataclasses
import functools

from codesign_jax.scene import hand
from scripts.accuracy import beam
from tests.helpers.grasps import pinch


@functools.cache
def finger_scene(
    links,
    *,
    bending_only=True,
    gravity=0.0,
    timestep=0.01,
    shear_modulus=70e3,
    beta=6e-3,
    damping="added",
):
    the_scene = pinch(
        "sphere",
        links=links,
        discretization__timestep=timestep,
        discretization__spring_damping=damping,
        effects__lateral_bending=not bending_only,
        effects__twist=not bending_only,
        effects__finger_object=False,
        effects__finger_table=False,
        effects__palm_object=False,
        effects__palm_table=False,
    )
    one = dataclasses.replace(
        the_scene.hand,
        finger=(hand.Finger(azimuth=0.0, spread=0.0, radius=0.0, tilt=0.0),),
        wrist=hand.Wrist(1e5, 1e4, 1e3, 1e2),
        material=dataclasses.replace(
            the_scene.hand.material, shear_modulus=shear_modulus, damping_time=beta
        ),
    )
    return dataclasses.replace(the_scene, hand=one, gravity=gravity)


class Finger(beam.Finger):
    """The finger of `finger_scene`, waited for until even rounding has died away."""

    def __init__(self, links, length=0.1, **options):
        super().__init__(finger_scene(links, **options), length)

    def settle(self, force=(0, 0, 0), torque=(0, 0, 0), pressure=0.0, steps=3000):
        return super().settle(force, torque, pressure, steps=steps, rest=1e-10)
