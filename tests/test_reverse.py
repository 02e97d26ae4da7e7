"""The derivative of a rollout: a kernel against differences of the kernel, and planted faults."""

import contextlib
import functools
import importlib.util
import os
import shutil
import subprocess
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import reuse, scene
from codesign_jax.compiler import gpu, launch, thread
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import (
    Limits,
    Program,
    adjoint_step,
    contacts_vjp,
    cotangents,
    friction_memory,
    program,
    residual_vjp,
)
from codesign_jax.engines.structured.kernel.adjoint import AdjointProgram, Cotangents, StatePath
from codesign_jax.engines.structured.kernel.adjoint_step import AdjointSolve
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables
from codesign_jax.engines.structured.kernel.rollout import Inputs
from codesign_jax.engines.structured.kernel.rows import Record
from codesign_jax.engines.structured.lanewise import lanewise
from tests.helpers import fixtures, grasps
from tests.helpers.differences import Case, curled, weights_of
from tests.helpers.planted_faults import chosen, name_of

DATA = grasps.DATA
STEP = 3e-7
BOUND = 1e-8
"""Of the largest derivative of any group.  Differences lose rounding of 1e-15 over the step, and
the step times the kinks within it; with ten times the step they err by 5e-8."""
EVERYTHING = {
    "effects__surface": "hull",
    "effects__finger_finger": True,
    "effects__finger_palm": True,
    "effects__finger_itself": True,
    "effects__neo_hookean": True,
    "effects__friction_memory": True,
    "effects__air_mass": True,
    "pneumatics__exponent": 1.3,
    "contact__finger_finger_friction": 0.6,  # not the object's
}


SMALL = {
    "effects__finger_finger": True,
    **grasps.off("palm_object palm_table finger_table twist"),
}
"""For what quick tests ask of one kernel."""


DEEP = 1e6
"""Depth of the object [m] that no world reaches; beyond it the bound tells a world's fault."""


class Fault(NamedTuple):
    """What is wrong in the reverse pass of a world: functions of the right cotangents or results.

    By a stage's name, or a pair of bodies, of its results (`seeds`) and arguments (`results`), by
    class and name of `methods`; and `names` of what no cotangent is kept.
    """

    seeds: dict = {}
    results: dict = {}
    methods: dict = {}
    names: tuple = ()


def none(tree):
    return lanewise(partial(jax.tree.map, jnp.zeros_like), tree)


def without(place, *fields):
    """Of several cotangents one, or fields of it, is zero."""

    def change(values):
        new = list(values)
        new[place] = (
            none(new[place])
            if not fields
            else new[place]._replace(**{f: none(getattr(new[place], f)) for f in fields})
        )
        return type(values)(new)

    return change


def without_frames(line):
    """A segment of a centre line whose neighbours' frames have no cotangents."""
    return line._replace(frames=none(line.frames))


def inside(place, change):
    """Of several cotangents one is wrong by `change`."""

    def changed(values):
        new = list(values)
        new[place] = change(new[place])
        return type(values)(new)

    return changed


CONTACTS = (AdjointSolve, "of_contacts")
SMOOTH = (AdjointSolve, "smooth")
FAULTS = {
    "links do not hand on what velocities cause": Fault(results={"of_link": without(0, "bias")}),
    "links do not hand on virtual motions": Fault(seeds={"of_link": without(0, "along")}),
    "links have no power": Fault(seeds={"of_link": without(1)}),
    "the palm does not feel the fingers": Fault(seeds={"of_palm": without(0, "link_acc", "along")}),
    "the arm's commands do nothing": Fault(results={"of_palm": without(1)}),
    "angles hand on nothing": Fault(seeds={"_joint_after_step": without(1)}),
    "the object's frame stands still": Fault(names=("columns",)),
    "the object's velocity does nothing": Fault(names=("object_vel",)),
    "the table stands still": Fault(names=("position",)),
    "rings hand nothing to their link": Fault(
        results={"finger_object": inside(0, without(0)), "finger_table": inside(0, without(0))}
    ),
    "rings of one size": Fault(names=("ring",)),
    "chambers of one volume": Fault(names=("volume",)),
    "a palm of one size": Fault(names=("palm_ring",)),
    "rings on fingers stand still": Fault(results={"finger_finger": inside(0, without(0))}),
    "the other finger's segment stands still": Fault(results={"finger_finger": without(1)}),
    "a segment's neighbours stand still": Fault(
        results={"finger_finger": inside(1, inside(1, without_frames))}
    ),
    "a finger's own segment stands still": Fault(results={"finger_itself": without(1)}),
    "fingers held nothing in the step before": Fault(results={"finger_finger": without(3)}),
    "the palm's disc stands still": Fault(results={"finger_palm": without(1)}),
    "rings held nothing in the step before": Fault(results={"finger_object": without(3)}),
    "points held nothing in the step before": Fault(results={"object_table": without(3)}),
    "what rings hold asks nothing of accelerations": Fault(
        results={"wrench_of_cotangents.<locals>.of_jar": without(0)}
    ),
    "what fingers hold asks nothing of accelerations": Fault(
        results={"load_cotangents.<locals>.of_held": without(0)}
    ),
    "both fingers own a contact": Fault(
        methods={(contacts_vjp, "only_on"): lambda right, mask, tree: tree}
    ),
    "contacts push on the right side": Fault(
        methods={CONTACTS: lambda right, self, contacts, *rest: contacts.inertia_and_wrench(*rest)}
    ),
    "contacts of another stiffness": Fault(
        methods={CONTACTS: lambda right, *_: (lanewise(lambda m: 0.99 * m, right[0]), right[1])}
    ),
    "smooth forces on the right side": Fault(
        methods={SMOOTH: lambda right, self, i: [*self.problem.read("smooth", item=i), right[1]]}
    ),
    "palm without conjugate gradients": Fault(
        methods={(adjoint_step.Coupling, "correct"): lambda right, self, step, idle: step}
    ),
}


class Planted:
    """Stages of the reverse pass, wrong in the worlds of the faults; `used`: what was planted."""

    def __init__(self, faults):
        self.faults = faults
        self.used = set()
        self.step = None

    def mine(self, number):
        """Lanes of a fault's world."""
        return self.step.constant("penetration").lane - DEEP == number

    def each(self, kind, key):
        """Faults of a stage or method: their wrong results and lanes."""
        for number, (name, fault) in enumerate(self.faults.items()):
            if key in (known := getattr(fault, kind)):
                self.used.add(name)
                yield known[key] if isinstance(known, dict) else none, self.mine(number)

    def pull(self, function, args, fixed, bars):
        """Instead of `pull`."""
        stage = name_of(function)
        if stage == "power":
            _, stage = function.args  # the pair of bodies
        for change, mine in self.each("seeds", stage):
            bars = chosen(mine, change(bars), bars)
        pulled = cotangents.pull(function, args, fixed, bars)
        for change, mine in self.each("results", stage):
            pulled = chosen(mine, change(pulled), pulled)
        return pulled

    def method(self, owner, name):
        """Instead of a method."""
        right = getattr(owner, name)

        def call(*args, **kwargs):
            result = right(*args, **kwargs)
            for change, mine in self.each("methods", (owner, name)):
                result = chosen(mine, change(result, *args), result)
            return result

        return call

    def add(self, right):
        """Instead of `CotangentTables.add`."""

        def call(this, values, *args):
            kept = {
                key: functools.reduce(
                    lambda v, f: chosen(f[1], none(v), v), self.each("names", key), value
                )
                for key, value in values.items()
            }
            return right(this, kept, *args)

        return call


@contextlib.contextmanager
def planted(faults):
    """Kernels of derivatives that are made within have the faults."""
    fault = Planted(faults)
    with pytest.MonkeyPatch.context() as patch:
        for module in (residual_vjp, contacts_vjp, friction_memory, adjoint_step):
            patch.setattr(module, "pull", fault.pull)
        for owner, name in {key for f in faults.values() for key in f.methods}:
            patch.setattr(owner, name, fault.method(owner, name))
        patch.setattr(CotangentTables, "add", fault.add(CotangentTables.add))
        start = adjoint_step.ReverseStep.__init__

        def prepare(self, *args):
            start(self, *args)
            fault.step = self

        patch.setattr(adjoint_step.ReverseStep, "__init__", prepare)
        # Sound kernels must neither be found in the place of this one nor find it.
        patch.setattr(reuse, "code_digest", lambda: f"planted: {sorted(faults)}")
        patch.setattr(program, "of_code", lambda _: None)
        patch.setattr(reuse, "kept", lambda path, build: build())
        yield
    assert fault.used == set(faults), set(faults) - fault.used


@functools.cache
def checked(wrong=False):
    """One kernel of sound worlds; or `wrong`: one with all faults, whose other worlds are sound.

    Derivatives along the groups' directions, by central differences; of a sound world for two
    weights, one plus twice the other, and zero; of the faults' worlds; of a world in company.
    """
    with jax.enable_x64(True):
        the_scene = grasps.pinch("box", links=8, **EVERYTHING)
        case = Case(the_scene, curled(the_scene, 3, bend=0.8, height=0.03, seed=3))
        slopes = derivatives(case, FAULTS if wrong else {})
        slopes.difference, trace = case.differences(weights_of(case.start), STEP)
    assert (trace["moved"] == 1).all()
    return slopes


@functools.cache
def small():
    """Sound worlds of a kernel with few contacts, without differences."""
    with jax.enable_x64(True):
        the_scene = grasps.pinch("sphere", links=2, **SMALL)
        slopes = derivatives(Case(the_scene, curled(the_scene, 8)), {})
    named = dict(zip(slopes.names, slopes.sound[0], strict=True))
    assert named["cone.finger_object"] and named["cone.finger_finger"]
    return slopes


def derivatives(case, faults):
    """Derivatives along the groups' directions, of sound worlds behind those of the faults."""
    with jax.enable_x64(True):
        first, second = (weights_of(case.start, seed) for seed in (0, 1))
        both = type(first)(*(a + 2.0 * b for a, b in zip(first, second, strict=True)))
        each = [first] * len(faults) + [first, second, both, first.times(0.0)]
        place = case.rows(1, "penetration").start
        tables = case.many(len(each))
        # Sound worlds stand between those of the faults in the other order.
        orders = np.arange(len(each)), np.random.default_rng(2).permutation(len(each))
        assert (orders[1] != orders[0]).all() or faults
        out = case.execute(tables)
        cotangent_sets = []
        with planted(faults) if faults else contextlib.nullcontext():
            for order in orders:
                number = np.full(tables[1].shape[0] * case.program.block, 1e3)
                number[: len(each)] = order
                tables[1][:, place] = (DEEP + number).reshape(-1, case.program.block)
                cotangent_sets.append(case.bars(tables, out, [each[k] for k in order]))
        slopes = np.array([case.along(cotangent_sets[0], w) for w in range(len(each))])
    count = len(faults)
    alone = tuple(
        [[case.world(b, w) for b in bars[:6]] for w in np.argsort(order)[count : count + 3]]
        for bars, order in zip(cotangent_sets, orders, strict=True)
    )
    names = [name for _, name in case.groups]
    slopes_by_kind = {"sound": slopes[count:], "wrong": slopes[:count], "alone": alone}
    return SimpleNamespace(names=names, **slopes_by_kind)


@pytest.mark.slow  # 46 s; quick: test_engines differentiates this kernel
def test_derivatives_by_every_group_equal_central_differences():
    """Hull, contact between fingers, palm, wrist, softening: everything that a scene may have."""
    c = checked()
    slope = c.sound[0]
    largest = np.abs(c.sound[0]).max()
    for name, *row in zip(c.names, slope, c.difference, strict=True):
        print(name, *(f"{v:.6e}" for v in row))
    named = dict(zip(c.names, np.abs(slope), strict=True))
    cones = [s for n, s in named.items() if n.startswith(("cone.", "palm_")) and n != "palm_disc"]
    assert len(cones) == 9 and min(cones) > 1e-6 * largest  # all bodies touch
    assert np.abs(slope - c.difference).max() < BOUND * largest


@pytest.mark.slow  # a minute for what differences notice; quick: that sound ones agree with them
@pytest.mark.parametrize("name", FAULTS)
def test_differences_notice_a_fault(name):
    """Some group's derivative is wrong by much more than the bound."""
    c = checked(wrong=True)
    wrong = c.wrong[list(FAULTS).index(name)]
    error = np.abs(wrong - c.difference).max() / np.abs(c.difference).max()
    print(f"{error:.1e}")
    assert not error < 10 * BOUND


SOUND = [small, pytest.param(checked, marks=pytest.mark.slow)]  # spheres, and everything


@pytest.mark.parametrize("worlds", SOUND)
def test_derivatives_are_linear_in_the_cotangents(worlds):
    first, second, both, zero = worlds().sound
    largest = np.abs(first).max() + 2 * np.abs(second).max()
    # Rounding of float64, and of what conjugate gradients leave of a direction: 1e-12 of it.
    assert np.abs(first + 2 * second - both).max() < 1e-10 * largest
    assert (zero == 0).all()


@pytest.mark.parametrize("worlds", SOUND)
def test_derivatives_do_not_depend_on_company(worlds):
    """The same world between others, at another place: the same bits."""
    for mine, other in zip(*worlds().alone, strict=True):
        for a, b in zip(mine, other, strict=True):
            np.testing.assert_array_equal(a, b)


HULL = {"effects__surface": "hull"}
ELEMENTS = {"effects__neo_hookean": True, "section__thread_depth": 0.3}
MIXED = DATA / "mixed.toml"  # a mesh, which still trials take, and a primitive
SCENES = {
    "spheres": {"discretization__spheres_per_link": 2, "effects__finger_finger": True},
    "neo-Hookean": {"effects__neo_hookean": True, "effects__finger_finger": True},
    "no friction": {"effects__friction": "none", **HULL},
    "rigid wrist": {"effects__wrist": False},
    "bending alone": {"effects__twist": False, "effects__lateral_bending": False},
    "no gravity, no table": {"effects__gravity": False, "effects__object_table": False},
    "mesh": {"objects": MIXED},
    "mesh and hull": {"objects": MIXED, **HULL},
    "three fingers": {"hand": "tripod3", "effects__finger_finger": True},
    "capsule": {"shape": "capsule"},
    "fast": {"shape": "box", "links": 3},
    "fixtures": {},
    "sections by elements": {"section__law": "elements", **ELEMENTS, **HULL},
    "sections that grow": {
        "section__law": "elements",
        "effects__section_growth": True,
        "effects__finger_finger": True,
        "effects__finger_palm": True,
        "effects__finger_itself": True,
        "effects__friction_memory": True,
        **ELEMENTS,
        **HULL,
    },
    "tapered sections by elements": {
        "hand": DATA / "tapered.toml",
        "section__law": "elements",
        "section__winding": "single",
        "effects__section_growth": True,
        **ELEMENTS,
        **HULL,
    },
    "tapered": {
        "hand": DATA / "tapered.toml",
        "effects__finger_finger": True,
        "effects__finger_itself": True,
        "effects__neo_hookean": True,
        "effects__air_mass": True,
        **HULL,
    },
}
# One of each kind, near enough that the curled hand touches them.
FIXTURES = fixtures.WALL.replace("0.06, 0.0, 0.05", "0.06, 0.0, 0.03") + fixtures.POST
FIXTURES += fixtures.SLOPES.replace("0.0, 0.045, 0.0", "0.0, 0.03, 0.0")


@pytest.mark.slow  # quick: the scene with everything
@pytest.mark.parametrize("name", SCENES)
def test_derivatives_of_scenes(name, tmp_path):
    """Each group as above; of two difference steps the one with the smaller error counts."""
    with jax.enable_x64(True):
        if name == "fixtures":
            overrides = {"discretization.links": 2, "effects.surface": "hull"}
            overrides |= {"effects.friction_memory": True}
            the_scene = fixtures.loaded(tmp_path, FIXTURES, "box", **overrides)
        else:
            the_scene = grasps.pinch(**{"shape": "sphere", "links": 2} | SCENES[name])
        start = curled(the_scene, 8)
        if name == "fast":  # links and object turn by up to a radian a step, see `laws.inertia`
            start.qvel[6:-6] *= 60.0 / np.abs(start.qvel[6:-6]).max()
            start.qvel[-3:] = [30.0, -50.0, 40.0]
        case = Case(the_scene, start)
        weights = weights_of(case.start)
        tables = case.many(1)
        errors = []
        slope = case.along(case.bars(tables, case.execute(tables), [weights]))
        # With the capsule the differences by the wrist's start err by 2e-6 at a step of 1e-6, by a
        # hundredth at a tenth of it, and by 7e-10 at 2e-8; below that rounding grows.
        for step in (1e-7, 2e-8) if name == "capsule" else (1e-6, 1e-7):
            difference, outputs = case.differences(weights, step)
            assert (outputs["moved"] == 1).all()
            errors.append(np.abs(slope - difference) / np.abs(slope).max())
        for (_, group), *row in zip(case.groups, slope, *errors, strict=True):
            print(group, *(f"{v:.2e}" for v in row))
        slopes = dict(zip((group for _, group in case.groups), slope, strict=True))
        size = "grid_factor" if name.startswith("mesh") else "object_size"
        assert slopes["cone.finger_object"] and slopes[size]
        assert np.min(errors, 0).max() < BOUND


def ptx(the_scene):
    """PTX of the reverse pass, of the forward pass before it, and of one that records forces."""
    program = AdjointProgram(the_scene, Limits(9, 9, 1e-6), backend="gpu", width=32)
    inputs = kernel_inputs(program)
    rows = program.path_rows(states=True)
    ends = shape(1, rows[0], program.size), shape(1, rows[1], program.block)
    whole = shape(STEPS, rows[0], program.size), shape(STEPS, rows[1], program.block)
    path = StatePath(*whole, *ends, shape(1, 1, program.block))
    bars = Cotangents(*ends, shape(STEPS, 3, program.block))
    arguments = program._arguments(inputs, path, bars)
    yield device_code(*program._adjoint_call(arguments), arguments, program.size, (6, 7, 8))
    forward = Program(the_scene, program.limits, backend="gpu", width=32, team=1)
    yield device_code(*forward._call(inputs, False, 1), inputs, program.size, (2,))
    record = Record(touch=True)
    recording = Program(the_scene, program.limits, backend="gpu", width=32, record=record)
    inputs = kernel_inputs(recording)
    call, outputs = recording._call(inputs, False, 0)
    memory = (5,) if recording.team > 1 else ()
    yield device_code(call, outputs, inputs, recording.size, (2,), memory)


STEPS = 2


def shape(*sizes) -> Any:
    return jax.ShapeDtypeStruct((1, *sizes), np.float32)


def kernel_inputs(program):
    """Shapes of the inputs of a block."""
    rows = program.path_rows(states=True)
    return Inputs(
        shape(program.hand.rows, program.columns),
        shape(program.world.rows, program.block),
        shape(rows[0], program.columns),
        shape(rows[1], program.block),
        shape(STEPS, 6, program.block),
        shape(STEPS, program.columns),
    )


def device_code(call, outputs, arguments, lanes, scratch, onchip=()):
    arrays = jax.tree.leaves(arguments)
    exchanged = (*scratch, *onchip) if onchip else ()
    kernel = launch.Kernel(
        "test", "gpu", lanes, scratch=scratch, onchip=onchip, exchanged=exchanged
    )
    layout = launch.describe(arrays, jax.tree.leaves(outputs), kernel)
    return thread.assembly(gpu.block_code(launch.kernel_jaxpr(call, arrays), layout))


def valid(code):
    """Whether it is for the oldest GPU, and without a stack in memory."""
    return ".target sm_80" in code and "shfl.sync.bfly.b32" in code and "__local_depot" not in code


def assembler():
    """NVIDIA's assembler for PTX, of its package on PyPI or of a CUDA that is installed."""
    package = importlib.util.find_spec("nvidia")
    places = package.submodule_search_locations if package else None
    folders = [f"{place}/cuda_nvcc/bin" for place in places or ()]
    return shutil.which("ptxas", path=os.pathsep.join([*folders, os.environ["PATH"]]))


@pytest.mark.slow  # .ci/run has that of the default scene
@pytest.mark.skipif(assembler() is None, reason="ptxas, NVIDIA's assembler, is not installed")
@pytest.mark.parametrize("name", ["paper", "paper_spheres", "build"])
def test_nvidias_assembler_takes_the_kernels(name, tmp_path):
    """Without a GPU: the driver's assembler is the same program. And it refuses another text."""
    for number, code in enumerate(ptx(scene.load(name))):
        assert valid(code)
        (tmp_path / "right.ptx").write_text(code)
        (tmp_path / "wrong.ptx").write_text(code.replace("fma.rn.f32", "fma.rn.f31", 1))
        for text, accepted in ("wrong", False), ("right", True):
            command = [assembler(), "-arch=sm_80", f"{text}.ptx", "-o", f"{text}.cubin"]
            done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
            assert (done.returncode == 0) == accepted, (number, done.stderr)


SHORT = {"effects__palm_object": False, "effects__palm_table": False, "effects__twist": False}


def rollout_slopes(engine, fields, ctrl):
    """Gradients of a weighted sum of everything that the trace shows."""

    def value(fields, ctrl):
        trace = engine.rollout(fields, ctrl, trajectory=True)
        random = np.random.default_rng(0)
        shown = trace.distance, trace.height, trace.speed, trace.qpos, trace.last
        return sum((x * random.normal(size=x.shape).astype(x.dtype)).sum() for x in shown)

    slopes, ctrl_slopes = jax.jit(jax.grad(value, (0, 1), allow_int=True))(fields, ctrl)
    numbers = slopes._replace(shape=None)  # an index, which has no derivative
    return jax.tree.map(np.asarray, (numbers, ctrl_slopes))


@pytest.mark.slow  # four kernels; quick: the parts of a segment are those of the whole path
def test_segments_have_the_bits_of_the_whole_path():
    """Of worlds that fall and touch, one of which fails; truncated ones have others."""
    the_scene = grasps.pinch("sphere", links=2, **SHORT)
    fields, ctrl = grasps.batch_inputs(the_scene, *grasps.random_worlds(the_scene, 3, 3))
    fields, ctrl = jax.tree.map(np.array, (fields, ctrl[:, 300:325]))
    fields.start[:, 2] = 0.09
    ctrl[:, :, 2] = 0.09
    ctrl[2, 17:, 6] = np.nan
    whole = rollout_slopes(StructuredEngine(the_scene), fields, ctrl)
    parts = rollout_slopes(StructuredEngine(the_scene, segment=10), fields, ctrl)
    cut = rollout_slopes(StructuredEngine(the_scene, segment=10, truncate=True), fields, ctrl)
    for a, b in zip(*map(jax.tree.leaves, (whole, parts)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(whole[1]).all() and (whole[1][2, 18:] == 0).all()
    np.testing.assert_array_equal(cut[1][:, 20:], whole[1][:, 20:])
    assert (cut[1][:2, :20] != whole[1][:2, :20]).any()


@pytest.mark.slow
def test_gradients_of_random_worlds_are_finite():
    """2,000 worlds of the default scene in float32, a second each: through inflation and lift."""
    the_scene = scene.load("paper")
    count = 2000
    fields, ctrl = grasps.batch_inputs(the_scene, *grasps.random_worlds(the_scene, 0, count))
    engine = StructuredEngine(the_scene)
    gradients = jax.jit(jax.grad(lambda c: engine.rollout(fields, c).distance.sum()))(ctrl[:, :420])
    assert np.isfinite(gradients).all() and (np.abs(gradients).max((1, 2)) > 0).mean() > 0.99
