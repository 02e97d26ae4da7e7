"""One finger on the bench: what it does under pressure and load, and what that tells of it.

The finger is the simulation's: a chain of equal segments with joints at their midpoints, the
springs and the moment of `model.morphology`.  Its rest is solved for, not simulated, so that a
measurement is compared, and the material fitted, in a second.

>>> import numpy as np
>>> from codesign_jax import finger, parameters, scene
>>> grasping = scene.load("paper")
>>> space = parameters.design_space(grasping.hand, "2d")
>>> mine = finger.of_design(grasping, space.params(space.default()), 0)
>>> table = {"pressure": np.array([20e3, 40e3]), "angle": np.array([0.20, 0.41])}  # Pa, rad
>>> found = finger.fit(mine, table)
>>> low, high = found.interval["shear_modulus"]  # Pa, with 90 %
>>> low < found.value["shear_modulus"] < high
True
"""

from codesign_jax.finger.advice import Advice, advice
from codesign_jax.finger.posterior import Posterior, fit
from codesign_jax.finger.prediction import opposed, predict, shifted, without_rest
from codesign_jax.finger.rest import TOO_FAR, Constants, Finger, NoRest, Rest, of_design
from codesign_jax.finger.threads import odds
from codesign_jax.measurements import MEASURED, read

__all__ = [
    "MEASURED",
    "TOO_FAR",
    "Advice",
    "Constants",
    "Finger",
    "NoRest",
    "Posterior",
    "Rest",
    "advice",
    "fit",
    "odds",
    "of_design",
    "opposed",
    "predict",
    "read",
    "shifted",
    "without_rest",
]
