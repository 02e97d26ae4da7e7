"""Plants faults in the kernel's own physics: each in one world of a kernel that has them all.

Where the kernel evaluates a stage of its physics, the worlds of a fault get that stage's wrong
result, so that the proof that checks notice them costs one compile and not one a fault.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import reuse
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Limits, Program, program, step
from codesign_jax.engines.structured.kernel.contact_list import ContactLayout
from codesign_jax.engines.structured.lanewise import lanes, lanewise
from codesign_jax.engines.structured.world_model import world_constants

FAR = 1e30
DEEP = 1e6
"""Depth of the object [m] that no world reaches; beyond it the bound tells a world's fault."""
NAMES = "chambers contact_list coupling self_collision finger_shapes sides friction_memory"
NAMES += " linear_system newton problem ring_pairs sdf_collision placement step"
MODULES = [import_module(f"{step.__package__}.{name}") for name in NAMES.split()]


class Fault(NamedTuple):
    """What is wrong in a world, and the comparison that must notice.

    Stages by qualified name: functions of the right stage and of its arguments. Methods by class
    and name: of the right method, the lanes of the world, the object, and its arguments. On the
    lanes of a `finger` alone, and `later`: in the second step, where there is a state before.
    """

    stages: dict[str, Callable]
    check: str = "acceleration"
    methods: dict[tuple[type, str], Callable] = {}
    finger: int | None = None
    later: bool = False


def name_of(function: Callable) -> str:
    """Qualified name of a stage."""
    return getattr(getattr(function, "func", function), "__qualname__", "")


def chosen(mine, wrong, right, *, wide=True):
    """The wrong numbers on a fault's lanes."""
    mask = lanes([mine], (), wide=wide)
    return lanewise(lambda m, w, r: jax.tree.map(partial(jnp.where, m), w, r), mask, wrong, right)


def cone_of(name, other):
    """Contacts of a pair of bodies have the friction cone of another pair."""

    def cone(right, mine, self, read, pair):
        sound = right(self, read, pair)
        if pair != name:
            return sound
        return chosen(mine, right(self, read, other), sound, wide=False)

    return Fault({}, methods={(ContactLayout, "cone"): cone})


class Planted:
    """Evaluates stages of the kernel, wrong in the worlds of the faults; `used`: what it met."""

    def __init__(self, faults: Mapping[str, Fault]):
        """Takes the faults; a fault's world has its number."""
        self.faults = faults
        self.used = set()
        self.step: Any = None

    def __call__(self, function: Callable, *args: Any) -> Any:
        """Instead of `lanewise`."""
        result = lanewise(function, *args)
        stage = name_of(function)
        for number, (name, fault) in enumerate(self.faults.items()):
            if stage in fault.stages:
                self.used.add((name, stage))
                mine = lanes([self.lanes(number)], (), wide=fault.finger is not None)
                wrong = lanewise(partial(self.wrong, fault.stages[stage], function), *args)
                result = lanewise(self.choose, mine, wrong, result)
        return result

    @staticmethod
    def wrong(change, function, *args):
        """A stage's wrong result."""
        leading = getattr(function, "args", ())
        return change(getattr(function, "func", function), *leading, *args)

    @staticmethod
    def choose(mine, wrong, right):
        """The wrong result on a fault's lanes, else the right one."""
        return jax.tree.map(partial(jnp.where, mine), wrong, right)

    def lanes(self, number: int) -> jax.Array:
        """Lanes on which a fault is now."""
        fault = [*self.faults.values()][number]
        step = self.step
        active = step.constant("penetration").lane - DEEP == number
        if fault.finger is not None:
            active = active & (step.block.finger == fault.finger)
        if fault.later:
            active = active & (step.world_state.read("acc_object")[0].lane != 0)
        return active

    def method(self, owner: type, name: str) -> Callable:
        """A method that is wrong in the worlds of all faults that have it."""
        right = getattr(owner, name)

        def call(this, *args):
            patched = right
            for number, (title, fault) in enumerate(self.faults.items()):
                change = fault.methods.get((owner, name))
                if change is not None:
                    self.used.add((title, name))
                    patched = partial(change, patched, self.lanes(number))
            return patched(this, *args)

        return call

    def expected_stages(self) -> set[tuple[str, str]]:
        """What `used` has once the kernel was traced, if it has all stages of the faults."""
        return {
            (name, stage)
            for name, fault in self.faults.items()
            for stage in (*fault.stages, *(method for _, method in fault.methods))
        }


@contextlib.contextmanager
def planted(faults: Mapping[str, Fault]) -> Iterator[Planted]:
    """Kernels that are made within have the faults, see `simulate`."""
    fault = Planted(faults)
    with pytest.MonkeyPatch.context() as patch:
        for module in MODULES:
            patch.setattr(module, "lanewise", fault)
        for owner, name in {key for f in faults.values() for key in f.methods}:
            patch.setattr(owner, name, fault.method(owner, name))
        start_step = step.Step.__init__

        def prepare(self, *args):
            start_step(self, *args)
            fault.step = self

        patch.setattr(step.Step, "__init__", prepare)
        # Sound kernels must neither be found in the place of this one nor find it.
        digest = f"planted: {sorted(faults)}"
        patch.setattr(reuse, "code_digest", lambda: digest)
        # What has no fault is traced once for all.
        patch.setattr(program, "of_code", lambda _: None)
        patch.setattr(reuse, "kernel_file", lambda name: None)
        yield fault
    missing = fault.expected_stages() - fault.used
    assert not missing, f"stages that the kernel has no more: {missing}"


def simulate(scene, fields, state, ctrl, number, iterations=30):
    """The kernel's trace with all states, solved to rounding; `number`: of each world's fault."""
    hand = world_constants(scene, fields)
    engine = StructuredEngine(scene)
    number = jnp.asarray(number, ctrl.dtype)[None]
    far = FAR + 0 * number
    hand = hand._replace(bounds=hand.bounds._replace(speed=far, penetration=DEEP + number))
    start = engine.state_at(engine.reset(fields), *state)
    program = Program.here(scene, Limits(iterations, 40, 1e-24), np.float64)
    return program.simulate(hand, start, ctrl, trajectory=True, states=True)[0]
