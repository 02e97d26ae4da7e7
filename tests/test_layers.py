"""Imports point one way: nothing imports what comes after it, and no modules import in a circle."""

import ast
import functools
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from codesign_jax import reuse

ROOT = Path(__file__).parents[1]

# What stands in a line may import lines before it, and its own folder.
LAYERS = """
files interrupts sizes statistics terminal
reuse
array_files
types provenance
compiler optimize
scene
axes model control judge.verdict devices
engines cost
preflight policy section_sizes
rollout
user_code measurements
batch
codesign env finger sampling
judge
tolerances
runs
report
export
commands
studio
cli
__main__
"""
ORDER = {name: level for level, line in enumerate(LAYERS.split("\n")) for name in line.split()}
TOPS = ("codesign_jax", "scripts")
ENGINE = "codesign_jax.engines.structured"
STUDIES = {"accuracy", "benchmark", "effects", "experiments", "search"}


def modules(root=ROOT):
    """Files by the dotted names of their modules."""
    paths = {}
    for top in TOPS:
        for path in sorted((root / top).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            paths[".".join(parts).removesuffix(".__init__")] = path
    return paths


@functools.cache
def parse(path):
    """The syntax tree of a file, which nobody changes."""
    return ast.parse(path.read_text(encoding="utf-8"))


def inner(node):
    """Statements right inside of a node; expressions, which hold no imports, are most nodes."""
    for field in ("body", "handlers", "orelse", "finalbody", "cases"):
        yield from getattr(node, field, ())


def imports(tree, names, *, inside=True, types=True):
    """Modules that a syntax tree imports; `types`: also what only the type checker sees."""
    for node in inner(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and not types:
            continue
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name in names)
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                module = full if full in names else node.module
                if module in names:
                    yield module
        elif inside or not isinstance(node, ast.FunctionDef):
            yield from imports(node, names, inside=inside, types=types)


@functools.cache
def graph(**options):
    """Modules that each module imports; `inside`: also those that functions import when called."""
    names = modules()
    return {n: set(imports(parse(path), names, **options)) for n, path in names.items()}


# Within the engine `structured`: what stands in a folder may import those before it.
STRUCTURED = ["laws", "kernel"]


def within(mine, theirs):
    """What forbids an import between the folders of the engine `structured`, or None."""
    root = ["codesign_jax", "engines", "structured"]
    if mine[:3] != root or theirs[:3] != root:
        return None
    my_folder, their_folder = (parts[3] if len(parts) > 3 else "" for parts in (mine, theirs))
    if (
        my_folder in STRUCTURED
        and their_folder in STRUCTURED
        and STRUCTURED.index(their_folder) > STRUCTURED.index(my_folder)
    ):
        return f"{their_folder} comes after {my_folder}"
    return None


def wrong(name, other):
    """What forbids an import, or None."""
    mine = name.split(".")
    theirs = other.split(".")
    if problem := within(mine, theirs):
        return problem
    if theirs[0] == "scripts" and mine[0] != "scripts":
        return "the package does not know the studies"
    if mine[0] == "scripts":
        if theirs[0] == "scripts" and theirs[1:2] and mine[1] != theirs[1] != "shared":
            if mine[1] == "shared" or theirs[1] in STUDIES:
                return "studies share through scripts.shared"
        return None
    if len(mine) == 1 or len(theirs) == 1:
        return None
    before, after = layer(theirs), layer(mine)
    if before != after and not ORDER[before] < ORDER[after]:
        return f"{before} comes after {after}, or beside it"
    return None


def layer(parts):
    """Name in `LAYERS` of a module: its own, or that of its part of the package."""
    alone = ".".join(parts[1:3])
    return alone if alone in ORDER else parts[1]


# What knows worlds by the interface of `engines/base.py` alone.
BEHIND = ("policy", "preflight", "env", "export", "rollout", "judge", "codesign")


def test_what_stands_on_an_engine_knows_its_interface_alone():
    inside = [
        f"{name} imports {other}"
        for name, others in graph().items()
        if name.split(".")[1:2] and name.split(".")[1] in BEHIND
        for other in others
        if other.startswith(ENGINE)
    ]
    assert not inside, "\n".join(inside)


def test_every_part_of_the_package_has_its_layer():
    parts = {layer(name.split(".")) for name in modules() if name.startswith("codesign_jax.")}
    assert parts == set(ORDER)


def test_imports_point_one_way():
    problems = [
        f"{name} imports {other}: {problem}"
        for name, others in graph().items()
        for other in sorted(others)
        if (problem := wrong(name, other))
    ]
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize(
    ("name", "other", "forbidden"),
    [
        ("codesign_jax.rollout", "codesign_jax.codesign", True),
        ("codesign_jax.codesign", "codesign_jax.rollout", False),
        ("codesign_jax.optimize.schedule", "codesign_jax.scene.hand", True),
        ("codesign_jax.compiler.cpu", "codesign_jax.scene", True),
        ("codesign_jax.runs.loop", "scripts.shared.output", True),
        ("codesign_jax.engines.mjx", "codesign_jax.judge.verdict", False),
        ("codesign_jax.engines.mjx", "codesign_jax.judge.cases", True),
        ("codesign_jax.judge.verdict", "codesign_jax.judge.cases", True),
        ("codesign_jax.judge.stress", "codesign_jax.runs.selection", True),
        ("codesign_jax.tolerances", "codesign_jax.runs.selection", True),
        (f"{ENGINE}.laws.rings", f"{ENGINE}.kernel.newton", True),
        (f"{ENGINE}.kernel.newton", f"{ENGINE}.laws.rings", False),
        ("scripts.shared.output", "scripts.experiments.report", True),
        ("scripts.accuracy.report", "scripts.benchmark", True),
        ("scripts.accuracy.budget", "scripts.calibration", False),
    ],
)
def test_an_import_against_the_arrows_would_be_found(name, other, forbidden):
    assert bool(wrong(name, other)) == forbidden


def test_no_modules_import_in_a_circle():
    """Also not through a folder's `__init__`, nor where only the type checker sees it."""
    links = {name: others - {name} for name, others in graph(inside=False).items()}
    try:
        tuple(TopologicalSorter(links).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_kernel_depends_on_what_its_key_leaves_out():
    """Kept kernels are known by the digest of the code that writes them."""
    folders = {path.name for path in (ROOT / "codesign_jax").iterdir() if path.is_dir()}
    assert set(reuse.UNRELATED) <= folders
    links = graph(types=False)
    reached = set()
    left = ["codesign_jax.engines.structured.kernel.program"]
    while left:
        name = left.pop()
        if name not in reached:
            reached.add(name)
            left += links.get(name, ())
    assert "codesign_jax.engines.structured.kernel.newton" in reached
    assert not {n for n in reached if n.split(".")[1:2] and n.split(".")[1] in reuse.UNRELATED}


def parallel(tree):
    """Lines that assign three names or more from as many expressions: `a, b, c = x, y, z`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            target = node.targets[0]
            if isinstance(target, ast.Tuple) and len(target.elts) >= 3:
                yield node.lineno


def test_assignments_stand_one_a_line():
    folders = [ROOT / name for name in ("codesign_jax", "scripts", "tests")]
    paths = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    assert [f"{path}:{line}" for path in paths for line in parallel(parse(path))] == []
    assert list(parallel(ast.parse("a, b, c = 1, 2, 3\na, b = b, a"))) == [1]


# Methods that are parts of a constructor
CONSTRUCTORS = {"__init__", "by_item", "_tables"}


def assigned_later(tree):
    """Attributes that a class's methods assign once its objects are made, by line."""
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    methods = [m for c in classes for m in c.body if isinstance(m, ast.FunctionDef)]
    for method in methods:
        if method.name not in CONSTRUCTORS:
            for node in ast.walk(method):
                if isinstance(node, ast.Attribute) and not isinstance(node.ctx, ast.Load):
                    yield f"{node.lineno}: {method.name} assigns {ast.unparse(node)}"


def test_the_structured_engine_hands_values_on():
    """What a part of a step makes is returned, not set because another part reads it later."""
    later = []
    for path in sorted((ROOT / ENGINE.replace(".", "/")).rglob("*.py")):
        later += [f"{path.name}:{line}" for line in assigned_later(parse(path))]
    assert not later, "\n".join(later)
    source = "class A:\n  def __init__(self):\n    self.x = 1\n  def f(self):\n    self.x = 2"
    assert [*assigned_later(ast.parse(source))] == ["5: f assigns self.x"]


# Words that say nothing of a value.
RIDDLES = {"found", "own", "one", "how"}


def identifiers(tree):
    """Every identifier of a syntax tree: variables, parameters, attributes, functions, imports."""
    for node in ast.walk(tree):
        for field in ("id", "arg", "attr", "name", "asname"):
            if isinstance(name := getattr(node, field, None), str):
                yield name


def test_no_name_is_a_riddle():
    """A name says what a value is."""
    riddles = []
    for top in ("codesign_jax", "scripts", "tests", "notebooks"):
        for path in sorted((ROOT / top).rglob("*.py")):
            names = [name for name in identifiers(parse(path)) if name in RIDDLES]
            if names:
                riddles.append(f"{path.relative_to(ROOT)}: {', '.join(names)}")
    assert not riddles, "\n".join(riddles)


def test_riddles_are_found_wherever_a_name_stands():
    lines = ("own = 1", "def how(): pass", "f(one=1)", "x.found", "def f(*own): pass")
    lines += ("import a as one", "try: pass\nexcept E as how: pass", "lambda own: 1")
    for line in lines:
        assert RIDDLES & {*identifiers(ast.parse(line))}, line
    assert not RIDDLES & {*identifiers(ast.parse('x["own"] = "one"; owner = found_again'))}
