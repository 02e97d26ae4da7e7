"""Writes a Pallas kernel in LLVM's assembly language, one operation of its jaxpr after the other.

The walk through the jaxpr has loops, branches and accesses to memory.
"""

from typing import Any

import jax
import numpy as np
from jax.extend import core

from codesign_jax.compiler.instructions import Instructions
from codesign_jax.compiler.rules import RULES
from codesign_jax.compiler.straight_line import StraightLine
from codesign_jax.compiler.values import Ref, Value

_INLINE = ("jit", "pjit", "closed_call", "custom_jvp_call", "remat2", "checkpoint")
_NO_OPERATION = (
    "broadcast_in_dim",
    "broadcast_to",
    "reshape",
    "squeeze",
    "stop_gradient",
    "copy",
    "optimization_barrier",
    "reshard",
)


class Writer(Instructions):
    """Writes the instructions of a kernel's jaxpr.

    Attributes:
      last_of_group: Whether a load is the last of several from the same array at the same lanes.
    """

    def __init__(self, lanes: int):
        super().__init__(lanes)
        self.following: list[Any] = []  # operations behind the present one
        self.last_of_group = True
        self.read: set[Any] = set()  # variables that some operation needs

    def begin_loop(self, counters: list[str], length: int) -> None:
        """Called before the body of a loop of some length; counters grow by one in every round."""

    def end_loop(self) -> None:
        """Called after the body of a loop."""

    # Control

    def _phis(self, values: list[Value], source: str) -> tuple[list[Value], list[int]]:
        """Values that depend on where control comes from, and their lines, which `_close` ends."""
        results = []
        lines = []
        for value in values:
            name = "%" + self.name()
            lines.append(len(self.lines))
            kind = self.type(value.kind, value.wide)
            self.lines.append(f"{name} = phi {kind} [ {self.operand(value)}, %{source} ]")
            results.append(Value(value.kind, value.wide, name))
        return results, lines

    def _close(self, lines: list[int], values: list[str], source: str) -> None:
        for line, value in zip(lines, values, strict=True):
            self.lines[line] += f", [ {value}, %{source} ]"

    def _carried(self, variables: Any, values: list[Value]) -> list[Value]:
        """Values as wide as the variables that hold them, each with a name or known."""
        wide = [
            self.splat(v) if var.aval.shape else v for var, v in zip(variables, values, strict=True)
        ]
        return [v if v.text is None or not v.known else self._plain(v) for v in wide]

    def _condition(self, value: Value) -> str:
        value = self.narrow(value)
        if value.wide:
            raise NotImplementedError(
                "a kernel's condition differs between its lanes: reduce it over the lanes first"
            )
        return self.typed(value)

    def loop(self, equation: Any, args: list) -> list:
        """A scan without inputs and outputs: a loop of fixed length."""
        p = equation.params
        split, carried, each_round = scan_parts(p)
        if each_round or len(equation.outvars) != carried:
            raise NotImplementedError(
                "a kernel's scan has no inputs or outputs of each round: use memory instead"
            )
        variables = p["jaxpr"].jaxpr.invars[split:]
        consts = args[:split]
        start = self._carried(variables, args[split:])
        if not p["length"]:
            return start
        label = self.name("L")
        end = self.name("L")
        source = self.here
        self.lines.append(f"br label %{label}")
        self.start(label)
        values, lines = self._phis([Value("i32", False, None, 0), *start], source)
        inner = p["jaxpr"]
        grown = [values[1 + k].text for k in counters(inner.jaxpr, split)]
        self.begin_loop(grown, p["length"])  # type: ignore[arg-type]
        new = self._carried(variables, self.run(inner.jaxpr, inner.consts, [*consts, *values[1:]]))
        operands = [self.operand(v) for v in new]
        self.end_loop()
        following = self.emit(f"add nsw i32 {values[0].text}, 1")
        going = self.emit(f"icmp slt i32 {following}, {p['length']}")
        self._close(lines, [following, *operands], self.here)
        self.lines.append(f"br i1 {going}, label %{label}, label %{end}")
        self.start(end)
        return new

    def while_loop(self, equation: Any, args: list) -> list:
        """A while loop; its condition is the same on all lanes."""
        p = equation.params
        a = p["cond_nconsts"]
        b = p["body_nconsts"]
        cond_consts = args[:a]
        body_consts = args[a : a + b]
        start = self._carried(equation.outvars, args[a + b :])
        top = self.name("L")
        inside = self.name("L")
        end = self.name("L")
        source = self.here
        self.lines.append(f"br label %{top}")
        self.start(top)
        values, lines = self._phis(start, source)
        cond = p["cond_jaxpr"]
        body = p["body_jaxpr"]
        (going,) = self.run(cond.jaxpr, cond.consts, [*cond_consts, *values])
        going = self._condition(going)
        self.lines.append(f"br {going}, label %{inside}, label %{end}")
        self.start(inside)
        new = self.run(body.jaxpr, body.consts, [*body_consts, *values])
        operands = [self.operand(v) for v in self._carried(equation.outvars, new)]
        self._close(lines, operands, self.here)
        self.lines.append(f"br label %{top}")
        self.start(end)
        return values

    def branch(self, equation: Any, args: list) -> list:
        """A conditional of two branches; its predicate is the same on all lanes."""
        predicate = args[0]
        operands = args[1:]
        if len(equation.params["branches"]) != 2:
            raise NotImplementedError("a kernel's conditional has two branches: nest them")
        no, yes = equation.params["branches"]
        if predicate.kind != "b":
            predicate = self.compute("icmp ne", predicate, self.like(predicate, 0), kind="b")
        labels = (self.name("L"), self.name("L"))
        end = self.name("L")
        predicate = self._condition(predicate)
        self.lines.append(f"br {predicate}, label %{labels[0]}, label %{labels[1]}")
        outcomes = []
        sources = []
        for branch, label in zip((yes, no), labels, strict=True):
            self.start(label)
            values = self.run(branch.jaxpr, branch.consts, operands)
            outcomes.append(self._carried(equation.outvars, values))
            sources.append(self.here)
            self.lines.append(f"br label %{end}")
        self.start(end)
        results, lines = self._phis(outcomes[0], sources[0])
        self._close(lines, [self.operand(v) for v in outcomes[1]], sources[1])
        return results

    # Memory

    def indices(self, ref: Ref, equation: Any, leaves: list[Value]) -> list[Value]:
        """Index in each dimension of an access to memory; a whole slice is the lane."""
        (indexer,) = jax.tree.unflatten(equation.params["tree"], leaves)
        positions = []
        for index, size in zip(indexer.indices, ref.shape, strict=True):
            if isinstance(index, Value):
                positions.append(self.narrow(index))
            elif isinstance(index, int | np.integer):
                positions.append(Value("i32", False, None, int(index)))
            elif index.size == size == self.lanes:  # a slice
                positions.append(self.lane_index())
            else:
                raise NotImplementedError(
                    f"a kernel's slice has {index.size} of {size} elements: it must be whole and "
                    f"have one of each of the {self.lanes} lanes"
                )
        return positions

    def _read_follows(self, equation: Any) -> bool:
        """Whether the same array is read next at the same lanes, but for indices in between."""
        for other in self.following:
            if other.primitive.name == "get":
                same = other.invars[0] is equation.invars[0]
                return same and other.invars[-1] is equation.invars[-1]
            if other.primitive.name not in ("add", "mul", "convert_element_type", *_NO_OPERATION):
                return False
        return False

    def _check_shape(self, equation: Any) -> None:
        shape = equation.outvars[0].aval.shape
        if shape not in ((), (self.lanes,)):
            raise NotImplementedError(
                f"a kernel reads or writes one number of each lane at a time, not shape {shape}: "
                "give every index but the lane's a number, or an array over the lanes"
            )

    # The walk through the jaxpr

    def run(self, jaxpr: Any, consts: Any, args: list) -> list:
        """Writes the instructions of a jaxpr; returns its results."""
        values: dict[Any, Any] = {}

        def read(atom: Any) -> Any:
            if not isinstance(atom, core.Literal):
                return values[atom]
            dtype = atom.aval.dtype  # pyright: ignore[reportAttributeAccessIssue]  # of its subclasses
            return self.constant(np.asarray(atom.val, dtype))

        numbers = [self.constant(np.asarray(c)) for c in consts]
        values.update(zip(jaxpr.constvars, numbers, strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        atoms = [a for e in jaxpr.eqns for a in e.invars] + list(jaxpr.outvars)
        self.read |= {a for a in atoms if not isinstance(a, core.Literal)}
        for k, equation in enumerate(jaxpr.eqns):
            self.following = jaxpr.eqns[k + 1 :]
            results = self.equation(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, equation: Any, args: list) -> list:
        name = equation.primitive.name
        params = equation.params
        if name in _INLINE:
            inner = params.get("jaxpr", params.get("call_jaxpr"))
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), args)
        if name == "straight_line":
            return self.straight_line(params["program"], args)
        if name in _NO_OPERATION:
            return [self.splat(args[0]) if equation.outvars[0].aval.shape else args[0]]
        control = {"scan": self.loop, "while": self.while_loop, "cond": self.branch}
        if name in control:
            return control[name](equation, args)
        if name in ("get", "swap"):
            self._check_shape(equation)
        if name == "get":
            self.last_of_group = not self._read_follows(equation)
            return [self.load(args[0], self.indices(args[0], equation, args[1:]))]
        if name == "swap":
            place = self.indices(args[0], equation, args[2:])
            before = self.load(args[0], place) if equation.outvars[0] in self.read else None
            self.store(args[0], place, args[1])
            return [before]
        if name not in RULES:
            raise NotImplementedError(
                f"no LLVM instruction for JAX's operation {name!r} in a kernel; "
                f"write it with others or add a rule to {RULES_FILE}"
            )
        return [RULES[name](self, equation, *args)]

    def straight_line(self, program: StraightLine, args: list) -> list:
        """Many operations that JAX has as one; their values are all as wide as the lanes."""

        def known(number: Any) -> Value:
            return self.splat(self.constant(np.asarray(number)))

        def apply(operation: Any, operands: list) -> Value:
            return RULES[operation.primitive.name](self, operation, *operands)

        return program.run(args, known, apply)


RULES_FILE = "codesign_jax/compiler/rules.py"


def scan_parts(params: dict[str, Any]) -> tuple[int, int, int]:
    """How many operands of a scan are constants, carried, and inputs of each round.

    JAX up to 0.10 has numbers for it, later versions a tree of the operands.
    """
    if "num_consts" in params:
        consts = params["num_consts"]
        carried = params["num_carry"]
        return consts, carried, len(params["jaxpr"].jaxpr.invars) - consts - carried
    consts, carried, each_round = (len(part) for part in params["ft_in"].unpack())
    return consts, carried, each_round


def counters(jaxpr: Any, consts: int) -> list[int]:
    """Which of a loop's carried values grow by one in every round."""
    places = []
    carried = jaxpr.invars[consts:]
    for k, (before, after) in enumerate(zip(carried, jaxpr.outvars, strict=True)):
        for e in jaxpr.eqns:
            step = e.invars[1] if e.primitive.name == "add" else None
            if isinstance(step, core.Literal) and e.outvars[0] is after and e.invars[0] is before:
                places += [k] if step.val == 1 else []
    return places
