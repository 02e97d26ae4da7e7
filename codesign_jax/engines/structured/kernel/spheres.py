"""Contacts of the fingers' and the palm's spheres, and of the object's points with the table."""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.problem import Memory, relative
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import shapes
from codesign_jax.engines.structured.world_model import apply_columns

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.step import Step


class Spheres:
    """Enters contacts that have a place in memory each, whether they touch or not."""

    def __init__(self, step: "Step", at: dict[str, Any], m: Memory, thing: WorldObject):
        """Takes a step's memory and geometry, see `Step`."""
        self.step, self.p, self.at, self.m, self.thing = step, step.p, at, m, thing

    def of_link(self, i: Any, carry: tuple) -> None:
        """Contacts of a link's spheres; carry: its origin, frame, velocity, bias and motion."""
        p, m, at, now = self.p, self.m, self.at, self.at["now"]
        if not p.k:
            return
        origin, frame, vel, _, motion = carry
        sphere, radius = (p.hand.read(self.step.hand, n, i) for n in ("sphere", "radius"))
        centre = lanewise(
            lambda o, f, s: o[:, None] + apply_columns(f[:, :, None], s), origin, frame, sphere
        )
        for name in ("finger_object", "finger_table"):
            if name in m.contacts:
                geometry = self.step.geometry(name, centre, radius, at, self.thing)
                moves = (
                    relative(name, motion, now.palm_motion, now.object_motion),
                    relative(name, vel, at["vel"], at["object_vel"]),
                )
                m.contacts[name].create(i, geometry, *moves)

    def of_palm_and_object(self, state: dict) -> None:
        """Contacts of the palm's spheres, and of the object with the table."""
        p, m, at, now = self.p, self.m, self.at, self.at["now"]

        def create(name: str, i: Any, geometry: Any) -> None:
            moves = (
                relative(name, None, now.palm_motion, now.object_motion),
                relative(name, None, at["vel"], at["object_vel"]),
            )
            m.contacts[name].create(i, geometry, *moves)

        palm = [name for name in ("palm_object", "palm_table") if name in m.contacts]
        for i in range(p.palm_groups if palm else 0):
            point, radius = (
                p.hand.read(self.step.hand, n, i) for n in ("palm_point", "palm_radius")
            )
            centre = lanewise(
                lambda x, f, s: x[:, None] + apply_columns(f[:, :, None], s),
                at["place"], at["frame"], point,
            )  # fmt: skip
            for name in palm:
                create(name, i, self.step.geometry(name, centre, radius, at, self.thing))
        on_table = m.contacts.get("object_table")
        slots = self._table_points(state) if on_table else []
        for i in range(on_table.set.count if on_table else 0):
            part = [slots[k] for k in range(i * p.fingers, min((i + 1) * p.fingers, len(slots)))]
            create("object_table", i, self._deal(part))

    def _table_points(self, state: dict) -> list[tuple]:
        """Point, normal and gap of each slot of the object on the table, lanes of a world."""
        at = self.at
        height = state["position"][2]
        arms = objects.table_points(self.p.scene, self.thing, at["columns"], height)

        def compute(arms, height):
            point, normal, gap = shapes.on_table(arms, height)
            return [
                (point[:, k : k + 1], normal[:, k : k + 1], gap[None, k : k + 1])
                for k in range(gap.shape[0])
            ]

        return lanewise(compute, arms, height)

    def _deal(self, slots: list[tuple]) -> tuple[Lanes, Lanes, Lanes]:
        """Deals the slots (component, 1, world) out to the finger lanes."""
        p = self.p
        away = jnp.full((p.size,), 1e3, self.step.finger_state.dtype)
        dealt = []
        for field in range(3):
            values = [s[field] for s in slots]
            parts = []
            for c in range(values[0].parts.shape[0]):
                lane = away
                for k, value in enumerate(values):
                    lane = jnp.where(self.step.block.finger == k, value.parts[c].item(), lane)
                parts.append(lane)
            dealt.append(lanes(parts, (len(parts), 1), wide=True))
        return tuple(dealt)  # type: ignore[return-value]
