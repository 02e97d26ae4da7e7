"""The part of an XLA handler that is the same for every device: version, checks, errors."""

from codesign_jax.compiler import ffi
from codesign_jax.compiler.code import Code, constant
from codesign_jax.compiler.layout import INPUT, OUTPUT, Layout

SEEN = ("call frame", "functions", "metadata")
"""Structures whose sizes a handler checks and notes when it is registered."""


def seen(name: str) -> str:
    """Name of the sizes of `SEEN` that a handler noted, 64-bit numbers."""
    return f"{name}_seen"


class Handler:
    """A handler that is being written; what it does with its arrays is added by the device.

    Attributes:
      code: Its instructions.
      api, ctx: Pointers that XLA's functions are called with.
      data: Address of each array that XLA passes, by its place in the layout.
      blocks: Number of blocks, 64 bit.
    """

    def __init__(self, name: str, layout: Layout):
        """Writes the answer to XLA's question for the version, and the checks of the arrays."""
        self.name, self.layout = name, layout
        self.code = Code(f"define ptr @{name}(ptr %frame) nounwind")
        self.globals = [f"@{seen(name)} = global [{len(SEEN)} x i64] zeroinitializer\n"]
        self.messages = 0
        self.api = self.code.get("%frame", ffi.CallFrame, "api")
        self._answer()
        self.ctx = self.code.get("%frame", ffi.CallFrame, "ctx")
        self.data: dict[int, str] = {}
        self.blocks = self._arrays()

    def message(self, text: str) -> str:
        """A constant string."""
        self.messages += 1
        name = f"{self.name}_message{self.messages}"
        self.globals.append(constant(name, text))
        return f"@{name}"

    def fail(self, code: int, message: str) -> None:
        """Returns an error to XLA.

        Args:
          code: Kind of error.
          message: Address of its text, which XLA copies.
        """
        c = self.code
        record = c.record(ffi.ErrorCreate, message=message, errc=code)
        create = c.get(self.api, ffi.Api, "error_create")
        error = c.let(f"call ptr {create}(ptr {record})")
        c.end(f"ret ptr {error}")

    def call(self, function: str, record: str) -> str:
        """Calls one of XLA's functions; returns its error or null."""
        pointer = self.code.get(self.api, ffi.Api, function)
        return self.code.let(f"call ptr {pointer}(ptr {record})")

    def text(self) -> str:
        """The handler with its constants."""
        return "".join(self.globals) + self.code.text()

    def _answer(self) -> None:
        """Names the version that this was written for, if the structures are as large as they were.

        Otherwise the version stays 0.0, which XLA refuses.
        """
        c = self.code
        extension = c.get("%frame", ffi.CallFrame, "extension_start")
        with c.when(c.let(f"icmp ne ptr {extension}, null")):
            kind = c.get(extension, ffi.Extension, "type")
            with c.when(c.let(f"icmp eq i32 {kind}, {ffi.METADATA}")):
                metadata = c.get(extension, ffi.MetadataExtension, "metadata")
                fits = "true"
                found = ("%frame", ffi.CallFrame), (self.api, ffi.Api), (metadata, ffi.Metadata)
                for k, (base, structure) in enumerate(found):
                    size = c.get(base, structure, "struct_size")
                    c.do(f"store i64 {size}, ptr {c.byte('@' + seen(self.name), 8 * k)}")
                    large = c.let(f"icmp uge i64 {size}, {ffi.size(structure)}")
                    fits = c.let(f"and i1 {fits}, {large}")
                with c.when(fits):
                    version = c.at(metadata, ffi.Metadata, "api_version")
                    c.put(version, ffi.Version, "major_version", ffi.MAJOR)
                    c.put(version, ffi.Version, "minor_version", ffi.MINOR)
                c.end("ret ptr null")

    def _arrays(self) -> str:
        """Checks the arrays that XLA passes; returns the number of blocks."""
        c, blocks = self.code, ""
        for which, role in (("args", INPUT), ("rets", OUTPUT)):
            places = self.layout.of(role)
            given = c.at("%frame", ffi.CallFrame, which)
            self._demand(
                [
                    f"uge i64 {c.get(given, ffi.Arguments, 'struct_size')}, "
                    f"{ffi.size(ffi.Arguments)}",
                    f"eq i64 {c.get(given, ffi.Arguments, 'size')}, {len(places)}",
                ],
                f"{len(places)} {role}s",
            )
            values = c.get(given, ffi.Arguments, "values")
            for k, place in enumerate(places):
                buffer = c.let(f"load ptr, ptr {c.byte(values, 8 * k)}")
                blocks = self._array(place, buffer, blocks)
        return blocks

    def _array(self, place: int, buffer: str, blocks: str) -> str:
        """Checks one array; returns the number of blocks, once it is known."""
        c, array = self.code, self.layout.arrays[place]
        rank, what = 1 + len(array.shape), f"array {place} to be {array}"
        self._demand(
            [
                f"uge i64 {c.get(buffer, ffi.Buffer, 'struct_size')}, {ffi.size(ffi.Buffer)}",
                f"eq i32 {c.get(buffer, ffi.Buffer, 'dtype')}, {ffi.DTYPES[array.dtype]}",
                f"eq i64 {c.get(buffer, ffi.Buffer, 'rank')}, {rank}",
            ],
            what,
        )
        dims = c.get(buffer, ffi.Buffer, "dims")
        sizes = [c.let(f"load i64, ptr {c.byte(dims, 8 * k)}") for k in range(rank)]
        wanted: list[object] = [1 if array.shared else blocks or sizes[0], *array.shape]
        self._demand([f"eq i64 {s}, {w}" for s, w in zip(sizes, wanted, strict=True)], what)
        self.data[place] = c.get(buffer, ffi.Buffer, "data")
        return blocks or ("" if array.shared else sizes[0])

    def _demand(self, tests: list[str], what: str) -> None:
        """Returns an error unless all comparisons hold."""
        c, holds = self.code, "true"
        for test in tests:
            holds = c.let(f"and i1 {holds}, {c.let('icmp ' + test)}")
        with c.when(c.let(f"xor i1 {holds}, true")):
            self.fail(ffi.INVALID_ARGUMENT, self.message(f"kernel {self.name} needs {what}"))
