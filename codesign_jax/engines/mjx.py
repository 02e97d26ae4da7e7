"""Stock MJX: the same model and equations in JAX, on any platform, in the caller's float type."""

import contextlib
import io
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

# MJX prints that it lacks NVIDIA Warp, an optional backend that is not used here. A warning or an
# error on its way is no print and passes.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

from codesign_jax.engines.base import Bodies, Equal, refuse_forces, refuse_meshes
from codesign_jax.engines.structured import bodies
from codesign_jax.judge import verdict
from codesign_jax.model import (
    ModelFields,
    MujocoFields,
    RolloutState,
    compile_template,
    layout,
    mujoco_fields,
    section_springs,
    softening_moments,
    split,
)
from codesign_jax.model.layout import centre_weights
from codesign_jax.scene import Scene, effects
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.types import Forces, Trace

_STATIC = ("wrap_prm",)
"""Fields that MJX takes for constants: what a world has of its own is applied as a force."""


def _refuse_fixtures(scene: Scene) -> None:
    problems = [
        Problem(
            "unsupported",
            f"object {shape.name!r} is a {shape.type}, and engine mjx has no contact of it with "
            f"fixture {fixture.name!r}, a {fixture.type}; use engine structured or mujoco",
        )
        for shape in scene.objects.object
        for fixture in scene.fixture
        if scene.effects.object_table and {shape.type, fixture.type} == {"box", "cylinder"}
    ]
    if problems:
        raise InputError(problems)


class MjxEngine(Equal):
    """Steps every world with `mjx.step` under vmap and scan."""

    name = "mjx"

    def __init__(self, scene: Scene):
        """Puts the scene's template on the device; the float type is jax's at this moment."""
        refuse_meshes(scene, self.name)
        effects.refuse(scene.effects, self.name)
        _refuse_fixtures(scene)
        self.scene = scene
        self.template = mjx.put_model(compile_template(scene))
        self.data = mjx.make_data(self.template)

    def _key(self) -> tuple:
        return self.scene.structure, self.data.qpos.dtype

    def model(self, arrays: MujocoFields) -> mjx.Model:
        """Returns the template with the arrays of one world.

        NumPy fields become JAX arrays: MJX takes a NumPy field for the same at every body of a
        depth of the tree, and refuses fingers whose mounts lie at different points.
        """
        given = {k: v for k, v in arrays.of_model.items() if k not in _STATIC}
        values = {name: jnp.asarray(value) for name, value in given.items()}
        return self.template.tree_replace(values)  # type: ignore[arg-type]

    def reset(self, fields: ModelFields) -> mjx.Data:
        """Returns the start state of one world."""
        return self.data.replace(qpos=fields.qpos, qvel=jnp.asarray(fields.qvel))

    def step(
        self, arrays: MujocoFields, fields: ModelFields, data: mjx.Data, ctrl: jax.Array
    ) -> mjx.Data:
        """Advances one world by one time step under controls of shape (nu,)."""
        dofs = layout(self.scene).dofs
        if fields.law is not None:
            springs = section_springs(self.scene, fields, data.qpos[dofs], ctrl[6:])
            data = data.replace(qfrc_applied=data.qfrc_applied.at[dofs].set(springs[0]))
            arrays = arrays._replace(
                dof_damping=jnp.asarray(arrays.dof_damping).at[dofs].set(springs[1]),
                dof_armature=jnp.asarray(arrays.dof_armature).at[dofs].set(springs[2]),
            )
            return mjx.step(self.model(arrays), data.replace(ctrl=ctrl))
        bend = dofs[..., 0]
        moments = None
        if self.scene.effects.neo_hookean:
            moments = softening_moments(self.scene, fields, data.qpos[bend])
        if arrays.wrap_prm is not None:
            share = (arrays.wrap_prm - self.template.wrap_prm).reshape(bend.shape)
            more = share * (arrays.actuator_gainprm[6:, 0] * ctrl[6:])[:, None]
            moments = more if moments is None else moments + more
        if moments is not None:
            data = data.replace(qfrc_applied=data.qfrc_applied.at[bend].set(moments))
        return mjx.step(self.model(arrays), data.replace(ctrl=ctrl))

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        return bodies.observer(self.scene, fields)

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        refuse_forces(self.name)

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        """See `Engine.rollout`.

        The worlds are mapped within the loop over time: around it, `jax.vmap` would take apart and
        build again what JAX has traced of a step.
        """

        def body(carry: RolloutState, u: jax.Array) -> tuple[RolloutState, Trace]:
            return jax.vmap(partial(self._advance, trajectory))(arrays, fields, carry, u)

        arrays = jax.vmap(partial(mujoco_fields, self.scene.structure))(fields)
        start = split(self.scene, jnp.asarray(fields.start, ctrl.dtype))
        with jax.default_matmul_precision("highest"):  # TF32 would spoil the solver on a GPU
            end, trace = jax.lax.scan(body, start, jnp.moveaxis(ctrl, 1, 0))
        trace = jax.tree.map(lambda v: jnp.moveaxis(v, 0, 1), trace)
        return trace._replace(last=jnp.concatenate(end, 1))

    def _advance(
        self,
        trajectory: bool,
        arrays: MujocoFields,
        fields: ModelFields,
        carry: RolloutState,
        u: jax.Array,
    ) -> tuple[RolloutState, Trace]:
        lay = layout(self.scene)
        bounds = verdict.bounds(fields.constants)
        data = self.reset(fields).replace(
            qpos=carry.qpos, qvel=carry.qvel, qacc_warmstart=carry.acc
        )
        new = self.step(arrays, fields, data, u)
        # Positions computed by a step belong to the state before it.
        weights = jnp.asarray(centre_weights(lay, fields.share), u.dtype)
        centre = weights @ new.xipos
        middle = new.xipos[lay.object]
        distance = jnp.linalg.norm(middle - centre)
        height = middle[2]
        qpos = carry.qpos if trajectory else carry.qpos[:0]
        step = carry.step[0]
        going = carry.going[0] > 0
        before = carry.speed[0]
        entry = Trace(distance, height, before, qpos)
        # The sum makes the speed not finite if any position is not.
        speed = jnp.abs(new.qvel).max() + 0.0 * new.qpos.sum()
        goes_on = going & verdict.goes_on(bounds, distance, height, before, step, to_end=trajectory)
        moved = goes_on & verdict.slow(bounds, speed)
        state = carry._replace(qpos=new.qpos, qvel=new.qvel, acc=new.qacc_warmstart)
        state = jax.tree.map(lambda a, b: jnp.where(moved, a, b), state, carry)
        now = jnp.where(goes_on, speed, before)
        numbers = {"step": step + 1, "going": moved.astype(step.dtype), "speed": now}
        return state._replace(**{name: value[None] for name, value in numbers.items()}), entry
