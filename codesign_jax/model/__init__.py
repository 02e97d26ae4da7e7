"""Scene to MuJoCo model, once a scene; parameters to batched model fields, as a pure function.

One MjSpec template a scene fixes the topology.  Each finger is a chain of `links` equal segments
with its joints at the segments' midpoints, so the first half segment is welded to the palm.  A ball
joint is three hinges on one body, bend (y), lateral (z) and twist (x) in this order or, in every
other joint, in the opposite one: the middle angle stays far from 90 degrees, each axis has its own
stiffness, and the chain is of second order also where it bends both ways.  Link frames have x along
the finger, y across (the bend axis) and z up from the inextensible bottom layer; positive bending
curls the tip towards that layer.

Springs are integrated linearly implicitly in every engine by the same substitution for diagonal
stiffness K and damping D: a dof_damping C and a dof_armature A in MuJoCo's integrator Euler with
eulerdamp disabled, which then solves (M + A) a = tau - K q - C v.  `layout.implicit_spring` has the
two integrators, implicit Euler and Newmark's.

>>> from codesign_jax import model, scene
>>> grasping = scene.load("paper")
>>> template = model.compile_template(grasping)  # a mujoco.MjModel
>>> model.layout(grasping).dofs.shape  # degrees of freedom by finger, link and axis
(4, 10, 3)
>>> template.nv == 6 + 4 * 10 * 3 + 6  # wrist, fingers, object
True
"""

from codesign_jax.model.fields import (
    ModelFields,
    joint_springs,
    model_fields,
    section_springs,
    softening_moments,
)
from codesign_jax.model.layout import Layout, contact_invweight, joint_axes, layout
from codesign_jax.model.mujoco_fields import MujocoFields, mujoco_fields
from codesign_jax.model.spec import build_spec, compile_model, compile_template
from codesign_jax.model.state import RolloutState, split

__all__ = [
    "Layout",
    "ModelFields",
    "MujocoFields",
    "RolloutState",
    "build_spec",
    "compile_model",
    "compile_template",
    "contact_invweight",
    "joint_axes",
    "joint_springs",
    "layout",
    "model_fields",
    "mujoco_fields",
    "section_springs",
    "softening_moments",
    "split",
]
