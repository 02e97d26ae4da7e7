"""One time step of a block of worlds inside the kernel, and which worlds may go on.

`Step.advance` is a step, in this order:

1. `Step.assemble` reads the state, and finds bodies, forces and contacts: palm and object first
   (`palm_and_object`), then link by link to the tips (`link_forces`), with each link's contacts
   with object and table (`SdfCollision`); then those of the hand with itself (`SelfCollision`).
2. `Newton.solve` finds the accelerations at which all forces balance.
3. `record.write` writes the contacts' forces, if they are recorded.
4. `semi_implicit_euler` moves the worlds that go on.

What a part leaves for the next ones is in memory, by link (`rows.Scratch`) or by contact
(`rows.Contact`), or it is returned: `Assembly`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import (
    chambers,
    friction_memory,
    objects,
    record,
    step_contacts,
)
from codesign_jax.engines.structured.kernel.body_motion import (
    WRIST,
    bases_before,
    carried_momentum,
    link_forces,
    palm_and_object,
)
from codesign_jax.engines.structured.kernel.finger_shapes import FingerShapes
from codesign_jax.engines.structured.kernel.memory import BoundTable, anywhere, loop, zeros
from codesign_jax.engines.structured.kernel.newton import Convergence, Limits, Newton
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem
from codesign_jax.engines.structured.kernel.rows import Hand, Scratch, WorldState
from codesign_jax.engines.structured.kernel.sdf_collision import SdfCollision
from codesign_jax.engines.structured.kernel.self_collision import SelfCollision
from codesign_jax.engines.structured.kernel.step_contacts import StepContacts
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.kernel.team_solver import team_rows
from codesign_jax.engines.structured.lanes import apply_columns, dot, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import kinematics as kin
from codesign_jax.engines.structured.laws.integration import integrate
from codesign_jax.engines.structured.laws.kinematics import State


class Assembly(NamedTuple):
    """A step's problem, but for what is in the scratch table."""

    state: dict[str, Lanes]  # Of wrist and object, by row of `rows.WorldState`
    # What `palm_and_object` returns; "now" is the warm start, the accelerations of the last step
    bodies: dict[str, Any]
    world_object: WorldObject  # The object of each lane's world
    contacts: StepContacts  # Those that were found
    fingers: FingerShapes | None  # Where fingers are; None without contacts of the hand with itself
    fast: jax.Array  # Whether a link turns by more than `inertia.LARGEST_TURN`, bool, a scalar
    centre: Lanes  # The hand's centre from the object's [m], shape (3, 1, world)


class Step(StepMemory):
    """One time step of a block."""

    def advance(
        self,
        arm: Lanes,
        pressure: Lanes,
        undecided: Callable,
        waiting: Any,
        speed: Any,
        limits: Limits,
        begins: Any,
        recorded: BoundTable | None = None,
    ) -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        """Advances the block.

        Args:
          arm: Commands of the arm frame, shape (6, 1, world).
          pressure: Chamber pressures, lanes; with `air_mass` the chambers' charges, see `laws.air`.
          undecided: Whether a world takes this step, from distance and height before it.
          waiting: Undecided worlds, which must converge.
          speed: Largest velocity before the step.
          limits: How hard the step is solved.
          begins: Whether the rollout begins, a scalar; see `_keep_overlap`.
          recorded: Where the contacts' forces are written; None to record none.

        Returns:
          Entries of the trace, by name: distance and height before the step, decrement and
          iterations of the solver and, with slots, overflow; the largest velocity after the step;
          the worlds that have moved, and so go on.
        """
        layout = self.layout
        assembly = self.assemble(arm, pressure)
        now = assembly.bodies["now"]
        jax.lax.cond(begins, lambda: self._keep_overlap(assembly), lambda: None)
        convergence = Convergence(lanes([self.like], (), wide=False), jnp.int32(0))
        if limits.iterations:
            problem = Problem(self, assembly.contacts, assembly.bodies["palm"])
            now, convergence = Newton(problem).solve(now, waiting, *limits)
        if recorded is not None:
            record.write(self, assembly.contacts, recorded)
        distance = lanewise(lambda c: jnp.sqrt(dot(c, c)), assembly.centre).lane
        height = assembly.state["position"][2].lane
        goes_on = waiting & undecided(distance, height)
        overflow = {}
        if layout.has_slots:
            overflow["overflow"] = self._overflow(assembly.contacts, waiting)
            goes_on &= overflow["overflow"] == 0
        new_speed, good = semi_implicit_euler(self, assembly, now, goes_on, speed)
        count = jnp.full_like(height, convergence.count)
        # Decrements of decided worlds are reported as 0; no iterations are spent on them.
        decrement = jnp.where(waiting, convergence.decrement.lane, 0.0)
        solved = {"decrement": decrement, "iterations": count}
        return {"distance": distance, "height": height} | solved | overflow, new_speed, good

    def assemble(self, arm: Lanes, pressure: Lanes) -> Assembly:
        """Reads the state, and leaves bodies, forces and contacts in the scratch table.

        Args:
          arm: Commands of the arm frame [m, rad], shape (6, 1, world).
          pressure: Pressures of the chambers [Pa], lanes of a finger; with `air_mass` charges.
        """
        layout = self.layout
        state = {name: self.world_state.read(name) for name in layout.world_state.groups}
        run = partial(palm_and_object, layout.scene.discretization.timestep)
        bodies = lanewise(run, state, arm, self.palm_constants())
        world_object = objects.read(layout.scene, self.block, self.world, self.hand, self.grid)
        if layout.grows:
            self.grow(pressure)
        contacts = step_contacts.begin(self, bodies["columns"])
        return self._forward(state, bodies, pressure, world_object, contacts)

    def _keep_overlap(self, assembly: Assembly) -> None:
        """Keeps the largest overlap of two bodies of worlds whose grasp begins in this step.

        A world with a larger one than the scene's limit is refused; `engines.depths` says the
        same of worlds that no kernel simulates.
        """
        state = assembly.state
        contacts = assembly.contacts
        depths = [c.deepest().lane for c in contacts.field_contacts.values()]
        if assembly.fingers and contacts.self_contacts:
            depths.append(assembly.fingers.deepest(contacts.self_contacts).lane)
        deepest = self.like
        for depth in depths:
            deepest = jnp.maximum(deepest, depth)
        if self.layout.team > 1:
            deepest = self.block.over_team(deepest, jnp.maximum)
        deepest = self.block.fold(deepest, jnp.maximum)
        begun = jnp.where(state["step"].lane > 0, state["overlap"].lane, deepest)
        self.world_state.write(WorldState.overlap, lanes([begun], (), wide=False))

    def _overflow(self, contacts: StepContacts, waiting: jax.Array) -> jax.Array:
        """One for worlds that had too few slots for their contacts in this step, else zero."""
        assert contacts.self_contacts is not None
        most = self.block.fold(contacts.self_contacts.overflow(), jnp.maximum)
        return jnp.where(waiting & (most > 0), 1.0, 0.0).astype(most.dtype)

    def store_chain(self, i: Any, chain: tuple) -> None:
        """Called with what the forward pass carries before joint i, and behind the last one."""

    def store_before(self, i: Any, chain: tuple) -> None:
        """Called with origin, frame and velocity before joint i where the last step began."""

    def _carry_momenta(self, state: dict, chain: tuple[Lanes, ...]) -> None:
        """Adds the forces that carry over the momenta of links that turn fast.

        Args:
          chain: Origin, frame and velocity of the fingers' bases.
        """
        scene = self.layout.scene
        given = *(state[n] for n in WRIST), *(self.hand.read(n) for n in (Hand.mount, Hand.base))
        before = lanewise(partial(bases_before, scene.discretization.timestep), *given)

        def link(i: Any, chains: tuple) -> tuple:
            self.store_before(i, chains[1])
            joint = self.joint(i) | {"order": self.order(i)}
            run = partial(carried_momentum, scene)
            now, before, _, force = lanewise(run, *chains, self.link_constants(i), joint)
            self.write(Scratch.smooth, lanewise(jnp.add, self.read(Scratch.smooth, i), force), i)
            return now, before

        loop(self.layout.links, link, (chain, before), self.layout.size)

    def _bases(self, bodies: dict) -> tuple[Lanes, ...]:
        """The fingers' bases: origin, frame, velocity, bias, acceleration, and weighted centre."""
        names = (Hand.mount, Hand.base, Hand.centre_weight, Hand.stub_centre)
        mount, base, weight, stub = (self.hand.read(n) for n in names)
        frame, origin = lanewise(kin.mounted, bodies["place"], bodies["frame"], mount, base)

        def weighted(place, frame, stub, weight):
            return weight * (place + apply_columns(frame, stub))

        weight = lanewise(weighted, bodies["place"], bodies["frame"], stub, weight)
        wide = zeros((6,), self.like)
        palm = bodies["vel"], bodies["bias"], bodies["now"].palm_acc
        vel, bias, link_acc = (lanewise(jnp.add, v, wide) for v in palm)
        return origin, frame, vel, bias, link_acc, weight

    def _store_link(self, i: Any, stored: dict[str, Lanes], mass: Lanes) -> None:
        """Stores a link for the solver, whose steps begin at none.

        Args:
          i: Number of the link.
          stored: What `link_forces` leaves to the solver, by row of `rows.Scratch`.
          mass: The link's mass [kg].
        """
        none = zeros((6,), self.like)
        steps = {"step_acc": zeros((self.layout.axes,), self.like), "step_link_acc": none}
        if Scratch.chord_link_acc in self.scratch:
            steps |= {Scratch.chord_link_acc: none}
        every = stored | steps
        if self.layout.team > 1:
            every = team_rows(every, (mass, stored["body_centre"], stored["tensor"]))
        for name, value in every.items():
            self.write(name, value, i)

    def _forward(
        self,
        state: dict,
        bodies: dict,
        pressure: Lanes,
        world_object: WorldObject,
        contacts: StepContacts,
    ) -> Assembly:
        """Bodies, forces and contacts from the palm to the tips, left in the scratch table.

        From link to link go its motion (`chain`), the sum of the links' weighted centres (`middle`)
        and the least share of velocity products of any link (`least`), see
        `inertia.share_of_products`.
        """
        layout = self.layout
        start = self._bases(bodies)
        origin, frame, vel, _, link_acc, _ = start
        if layout.scene.effects.air_mass:
            pressure = chambers.end_pressures(self, pressure)
        fingers = search = None
        if contacts.self_contacts and contacts.sides:
            fingers = FingerShapes(self, contacts.sides, bodies["vel"])
            search = SelfCollision(fingers, contacts.self_contacts, bodies)
            search.clear()
            fingers.start(link_acc, vel, frame, origin)
        fields = SdfCollision(self, contacts, bodies, world_object)

        def link(i: Any, carry: tuple) -> tuple:
            *chain, middle, least = carry
            self.store_chain(i, chain)
            joint = self.joint(i) | {"pressure": pressure, "order": self.order(i)}
            run = partial(link_forces, layout.scene)
            constants = self.link_constants(i)
            chain, stored = lanewise(run, tuple(chain), constants, joint)
            least = lanewise(jnp.minimum, least, stored.pop("share"))
            self._store_link(i, stored, constants["mass"])
            weight = self.hand.read(Hand.centre_weight, i + 1)
            middle = lanewise(add_weighted, middle, stored["body_centre"], weight)
            fields.of_link(i, chain)
            if fingers:
                fingers.link(i, chain[4], chain[2], chain[1], chain[0])
            return (*chain, middle, least)

        start = (*start, lanewise(jnp.ones_like, start[0][0]))
        *chain, middle, least = loop(layout.links, link, start, layout.size)
        self.store_chain(layout.links, tuple(chain))
        fast = anywhere(least.lane < 1)
        jax.lax.cond(fast, lambda: self._carry_momenta(state, start[:3]), lambda: None)
        if search:
            search.find()
        if fingers and layout.team > 1:
            fields.of_rings(fingers)
        counted = contacts.counted()
        fields.of_palm_and_object(state)
        count = layout.num_fingers * layout.links
        middle = self.block.sum(middle)
        centre = lanewise(lambda c: c / count, middle)
        return Assembly(state, bodies, world_object, counted, fingers, fast, centre)


def add_weighted(total, centre, weight):
    """Adds a link's centre, times its weight in the hand's centre."""
    return total + weight * centre


def semi_implicit_euler(
    step: StepMemory, assembly: Assembly, now: Iterate, goes_on: Any, speed: Any
):
    """Semi-implicit Euler; worlds that are decided or whose step fails stay as they were.

    Args:
      assembly: The step's problem; `now`: the accelerations of the step.
      goes_on: Worlds that are undecided and take the step, bool, shape (lane,).
      speed: Largest velocity before the step, shape (lane,).

    Returns the largest velocity after the step, and whether the world has moved.
    """
    layout = step.layout
    h = layout.scene.discretization.timestep
    state = assembly.state
    columns = assembly.bodies["columns"]
    new = lanewise(partial(body_after_step, h), state, columns, now.wrist, now.object_acc)
    size = lanewise(_largest, new)

    def link(i: Any, largest: Lanes) -> Lanes:
        rate, q, top = lanewise(partial(joint_after_step, h), *step.joint(i).values())
        step.scratch.write(Scratch.new_finger, q, i)
        step.scratch.write(Scratch.new_finger_vel, rate, i)
        return lanewise(_worse, largest, top)

    fingers = loop(layout.links, link, zeros((), step.like), layout.size).lane
    largest = _worse(size.lane, step.block.fold(fingers, _worse))
    limit = step.constant("speed").lane
    good = goes_on & (largest <= limit)
    acc = {"acc_wrist": now.wrist, "acc_object": now.object_acc}
    for name, value in {**new, **acc}.items():
        kept = lanewise(jnp.where, lanes([good], (), wide=False), value, state[name])
        step.world_state.write(name, kept)

    def store(i: Any, x: Any) -> Any:
        for name in ("finger", "finger_vel"):
            value = step.scratch.read(f"new_{name}", i)
            old = step.finger_state.read(name, i)
            kept = lanewise(jnp.where, lanes([good], (), wide=False), value, old)
            step.finger_state.write(name, kept, i)
        return x

    jax.lax.fori_loop(0, layout.links, store, jnp.int32(0))
    friction_memory.store(step, assembly.contacts, good)
    return jnp.where(goes_on, largest, speed), good


def body_after_step(h: float, state: dict, columns, wrist, obj) -> dict:
    """Wrist and object after a step, by row of `rows.WorldState`.

    Args:
      h: Time step [s].
      state: Their state before it, by the same names.
      columns: Columns of the object's orientation before it, shape (3, 3, ...).
      wrist: Accelerations of the wrist, shape (6, ...).
      obj: Those of the object, shape (6, ...).
    """
    names = ("wrist", "position", "quat", "wrist_vel", "linear_vel", "angular_vel")
    # The fingers' joints are moved link by link, see `joint_after_step`.
    old = State(finger=0.0, finger_vel=0.0, acc=None, **{n: state[n] for n in names})  # type: ignore[arg-type]
    new = integrate(old, columns, kin.Acc(wrist, 0.0, obj), h)  # type: ignore[arg-type]
    return {n: getattr(new, n) for n in names}


def _worse(a: jax.Array, b: jax.Array) -> jax.Array:
    """The larger one, or what is not finite."""
    return jnp.where((b > a) | (b != b), b, a)


def _largest(new: dict):
    velocities = [new[n] for n in ("wrist_vel", "linear_vel", "angular_vel")]
    top = jnp.abs(velocities[0][0])
    for value in velocities:
        for i in range(value.shape[0]):
            top = _worse(top, jnp.abs(value[i]))
    places = [new["wrist"][i] for i in range(6)] + [new["position"][i] for i in range(3)]
    place = total(places + [new["quat"][i] for i in range(4)])
    return jnp.where(place == place, top, place)


def joint_after_step(h: float, q, rate, acc):
    """A joint after the step: velocities, angles, and the largest velocity."""
    rate = rate + h * acc
    q = q + h * rate
    top = jnp.abs(rate[0])
    for k in range(1, rate.shape[0]):
        top = _worse(top, jnp.abs(rate[k]))
    return rate, q, top
