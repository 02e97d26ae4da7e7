"""Hard case 33: the hull's contact force converges to that of a continuous skin."""

import dataclasses

import numpy as np

from codesign_jax import model
from tests.helpers import grasps
from tests.stability.bench import bench, pinch
from tests.stability.oracle import Reader
from tests.stability.table import Found, case
from tests.stability.touch import SPHERE

DEEP = 1.5e-3  # of the sphere in the finger's flat side [m]
DENSITIES = ((2, 8), (4, 16), (8, 32))  # rings a link, points a ring; the first is the default
PLACES = 16  # of the sphere along and across the finger, at random
HEAVY = 1e9  # [kg, kg m^2]


def skinned(rings, points):
    base = pinch(
        effects__surface="hull",
        discretization__hull_rings=rings,
        discretization__hull_points=points,
    )
    return dataclasses.replace(base, gravity=0.0)


def pressed_forces(b):
    """Forces of the kernel on spheres that stand in the flat side of a straight finger [N].

    Hand and sphere are so heavy that the step moves nothing: the force is k times the depth.
    """
    params, trial = grasps.hand_world(b.scene, length=0.1)
    fields = b.fields([params] * PLACES, [trial._replace(shape=np.int32(SPHERE))] * PLACES)
    fields.start[:, 2] = 1.0
    reader, lay = Reader(b.scene, fields), model.layout(b.scene)
    data, link = reader.at(fields.start[0]), lay.bodies[0, 1]
    radius, frame = reader.model.geom_size[-1, 0], data.xmat[link].reshape(3, 3)
    # Behind the second joint the sphere touches neither the palm nor the other finger.
    along, across = np.random.default_rng(33).uniform([[0.1], [-1]], [[0.9], [1]], (2, PLACES))
    place = [0.1 / lay.links * along, 1e-3 * across, np.full(PLACES, DEEP - radius)]
    fields.start[:, -7:-4] = data.xpos[link] + np.stack(place, 1) @ frame.T
    fields.dof_armature[:, : int(lay.dofs.max()) + 1] = HEAVY
    fields.body_mass[:, -1] = mass = 1e3
    fields.dof_M0[:, -6:-3] = mass
    ctrl = b.hold(b.h, *np.c_[fields.start[:, :6], np.zeros((PLACES, 2))])
    return mass * b.run(fields, ctrl).object_velocity[:, 0] / b.h @ -frame[:, 2], radius


def hull_force(engine, step, precision):
    """A stiffness k / w^2 per area, along the sphere's radii, adds up to pi k (r - d) d^2 / w^2."""
    errors = []
    for density in DENSITIES:
        base = skinned(*density)
        force, radius = pressed_forces(bench(base, engine, step, precision))
        stiffness = base.contact.normal_stiffness / base.hand.section.width**2
        expected = np.pi * stiffness * (radius - DEEP) * DEEP**2
        errors.append(np.sqrt(np.mean((force / expected - 1) ** 2)))
    note = ", ".join(f"{r} x {p}: {e:.1%}" for (r, p), e in zip(DENSITIES, errors, strict=True))
    assert errors[0] > errors[1] > errors[2], note
    # Points 2.5 mm apart on a patch of 19 mm; one more or less of its 60 is 2 %.
    return Found(errors[-1], 0.02, note)


case(
    33,
    "sphere pressed into the hull",
    "error of the force, 256 points a link, against a continuous skin, relative",
    steps=(1.0,),
    precisions=("float64",),
)(hull_force)
