"""XLA's handlers in this computer's machine code, made and loaded by LLVM.  Needs llvmlite.

A handler is the same for every device in its version, checks and errors.  It is written in LLVM's
language, with instructions of its own (`LlvmFunction`): it is no kernel.  XLA knows it before the
kernel that it calls is compiled: a thread does this, for seconds, while JAX traces and XLA compiles
the program around it.  A call waits until it is there.

The environment variable CODESIGN_KERNEL_OPTIMIZATION says how much LLVM optimises: 2, the default,
or 0, which takes half of LLVM's time, for programs that run for milliseconds.  A kernel may ask for
less than the default, see `launch.Kernel`.

Source: LLVM Language Reference Manual.
"""

import contextlib
import ctypes
import functools
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any

import llvmlite
import llvmlite.binding as binding

from codesign_jax import reuse
from codesign_jax.compiler import ffi
from codesign_jax.compiler.values import INPUT, OUTPUT, Layout

_TYPES = {1: "i8", 4: "i32", 8: "i64"}


def type_of(structure: type[ctypes.Structure], field: str) -> str:
    kind = dict(structure._fields_)[field]  # type: ignore[arg-type]
    return "ptr" if kind is ctypes.c_void_p else _TYPES[ctypes.sizeof(kind)]


def constant(name: str, text: str) -> str:
    raw = text.encode() + b"\0"
    quoted = "".join(f"\\{byte:02X}" for byte in raw)
    return f'@{name} = private constant [{len(raw)} x i8] c"{quoted}"\n'


class LlvmFunction:
    """A function that is being written."""

    def __init__(self, head: str):
        self.head = head
        self.lines = []
        self.first = []
        self.count = 0
        self.ended = False

    def name(self, prefix: str = "t") -> str:
        self.count += 1
        return f"{prefix}{self.count}"

    def let(self, text: str) -> str:
        """Adds an instruction; returns the name of its result."""
        name = "%" + self.name()
        self.lines.append(f"{name} = {text}")
        return name

    def do(self, text: str) -> None:
        """Adds an instruction without a result."""
        self.lines.append(text)

    def end(self, text: str) -> None:
        self.lines.append(text)
        self.ended = True

    def start(self, label: str) -> None:
        """Begins a basic block, to which the one before goes on unless it has ended."""
        if not self.ended:
            self.lines.append(f"br label %{label}")
        self.lines.append(f"{label}:")
        self.ended = False

    @contextlib.contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """What is added in this context runs if a condition holds."""
        yes = self.name("yes")
        after = self.name("after")
        self.end(f"br i1 {condition}, label %{yes}, label %{after}")
        self.start(yes)
        yield
        self.start(after)

    def local(self, kind: str, count: int = 1) -> str:
        """Memory of the function's frame, made once whatever loops surround it."""
        name = "%" + self.name("m")
        self.first.append(f"{name} = alloca {kind}, i64 {count}, align 8")
        return name

    def byte(self, base: str, offset: int | str) -> str:
        return self.let(f"getelementptr i8, ptr {base}, i64 {offset}")

    def at(self, base: str, structure: type[ctypes.Structure], field: str) -> str:
        return self.byte(base, getattr(structure, field).offset)

    def get(self, base: str, structure: type[ctypes.Structure], field: str) -> str:
        return self.let(f"load {type_of(structure, field)}, ptr {self.at(base, structure, field)}")

    def put(self, base: str, structure: type[ctypes.Structure], field: str, value: object) -> None:
        kind = type_of(structure, field)
        self.do(f"store {kind} {value}, ptr {self.at(base, structure, field)}")

    def record(self, structure: type[ctypes.Structure], **values: object) -> str:
        """A structure of XLA's interface in the function's frame; what is not given is 0."""
        place = self.local(f"[{ctypes.sizeof(structure)} x i8]")
        self.do(f"store [{ctypes.sizeof(structure)} x i8] zeroinitializer, ptr {place}")
        for field, value in {"struct_size": ffi.size(structure), **values}.items():
            self.put(place, structure, field, value)
        return place

    def text(self) -> str:
        return "\n".join([self.head + " {", "entry:", *self.first, *self.lines, "}", ""])


SEEN = ("call frame", "functions", "metadata")
"""Structures whose sizes a handler checks and notes when it is registered."""


def seen(name: str) -> str:
    """Name of the sizes of `SEEN` that a handler noted, 64-bit numbers."""
    return f"{name}_seen"


WAITING, FAILED = 0, 1
"""What a handler finds in place of its kernel's address."""


def awaited(name: str) -> str:
    """Name of two 64-bit numbers: address of the kernel, see `WAITING`, and of an error's text."""
    return f"{name}_awaited"


DECLARATIONS = "declare i32 @nanosleep(ptr, ptr)\n"
PAUSE = 1_000_000
"""Pause of a handler that waits for its kernel [ns]; 50 us take a tenth of a core's time."""


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
        self.name = name
        self.layout = layout
        self.code = LlvmFunction(f"define ptr @{name}(ptr %frame) nounwind")
        self.globals = [
            f"@{seen(name)} = global [{len(SEEN)} x i64] zeroinitializer\n",
            f"@{awaited(name)} = global [2 x i64] [i64 {WAITING}, i64 0]\n",
        ]
        self.messages = 0
        self.api = self.code.get("%frame", ffi.CallFrame, "api")
        self._answer()
        self.ctx = self.code.get("%frame", ffi.CallFrame, "ctx")
        self.data: dict[int, str] = {}
        self.blocks = self._arrays()

    def message(self, text: str) -> str:
        self.messages += 1
        name = f"{self.name}_message{self.messages}"
        self.globals.append(constant(name, text))
        return f"@{name}"

    def fail(self, code: int, message: str) -> None:
        """Returns an error to XLA; message: address of its text, which XLA copies."""
        c = self.code
        record = c.record(ffi.ErrorCreate, message=message, errc=code)
        create = c.get(self.api, ffi.Api, "error_create")
        error = c.let(f"call ptr {create}(ptr {record})")
        c.end(f"ret ptr {error}")

    def kernel(self) -> str:
        """Address of the kernel, for which the handler waits; an error if there will be none."""
        c = self.code
        pause = c.local("[2 x i64]")
        c.do(f"store [2 x i64] [i64 0, i64 {PAUSE}], ptr {pause}")
        c.start("await_kernel")
        address = c.let(f"load atomic i64, ptr @{awaited(self.name)} acquire, align 8")
        with c.when(c.let(f"icmp eq i64 {address}, {WAITING}")):
            c.let(f"call i32 @nanosleep(ptr {pause}, ptr null)")
            c.end("br label %await_kernel")
        with c.when(c.let(f"icmp eq i64 {address}, {FAILED}")):
            place = c.byte(f"@{awaited(self.name)}", 8)
            self.fail(ffi.INTERNAL, c.let(f"load ptr, ptr {place}"))
        return c.let(f"inttoptr i64 {address} to ptr")

    def call(self, function: str, record: str) -> str:
        """Calls one of XLA's functions; returns its error or null."""
        pointer = self.code.get(self.api, ffi.Api, function)
        return self.code.let(f"call ptr {pointer}(ptr {record})")

    def text(self) -> str:
        return DECLARATIONS + "".join(self.globals) + self.code.text()

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
                structures = (
                    ("%frame", ffi.CallFrame),
                    (self.api, ffi.Api),
                    (metadata, ffi.Metadata),
                )
                for k, (base, structure) in enumerate(structures):
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
        c = self.code
        blocks = ""
        for part, role in (("args", INPUT), ("rets", OUTPUT)):
            places = self.layout.of(role)
            given = c.at("%frame", ffi.CallFrame, part)
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
        c = self.code
        array = self.layout.arrays[place]
        rank = 1 + len(array.shape)
        requirement = f"array {place} to be {array}"
        self._demand(
            [
                f"uge i64 {c.get(buffer, ffi.Buffer, 'struct_size')}, {ffi.size(ffi.Buffer)}",
                f"eq i32 {c.get(buffer, ffi.Buffer, 'dtype')}, {ffi.DTYPES[array.dtype]}",
                f"eq i64 {c.get(buffer, ffi.Buffer, 'rank')}, {rank}",
            ],
            requirement,
        )
        dims = c.get(buffer, ffi.Buffer, "dims")
        sizes = [c.let(f"load i64, ptr {c.byte(dims, 8 * k)}") for k in range(rank)]
        wanted: list[object] = [1 if array.shared else blocks or sizes[0], *array.shape]
        self._demand([f"eq i64 {s}, {w}" for s, w in zip(sizes, wanted, strict=True)], requirement)
        self.data[place] = c.get(buffer, ffi.Buffer, "data")
        return blocks or ("" if array.shared else sizes[0])

    def _demand(self, tests: list[str], requirement: str) -> None:
        """Returns an error unless all comparisons hold."""
        c = self.code
        holds = "true"
        for test in tests:
            holds = c.let(f"and i1 {holds}, {c.let('icmp ' + test)}")
        with c.when(c.let(f"xor i1 {holds}, true")):
            self.fail(ffi.INVALID_ARGUMENT, self.message(f"kernel {self.name} needs {requirement}"))


OPTIMIZATION = "CODESIGN_KERNEL_OPTIMIZATION"
LOCK = threading.RLock()
"""Held while a kernel is compiled and registered."""

_loaded: dict[str, "Loaded"] = {}


@functools.cache
def vector_bytes() -> int:
    features = binding.get_host_cpu_features()
    return 64 if features.get("avx512f") else 32 if features.get("avx") else 16


def identity() -> tuple[object, ...]:
    """What machine code of this processor depends on besides its source.

    The first two, LLVM's level of optimisation and version, are what a GPU's code depends on.
    """
    return (
        _level(),
        llvmlite.__version__,
        binding.get_default_triple(),
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
    )


def _level() -> int:
    text = os.environ.get(OPTIMIZATION, "2")
    if text not in ("0", "2"):
        raise ValueError(f"{OPTIMIZATION} = {text!r} must be 0 or 2")
    return int(text)


def _machine(level: int = 2) -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        cpu=binding.get_host_cpu_name(),
        features=binding.get_host_cpu_features().flatten(),
        opt=level,
        jit=True,
    )


def compile(text: str, level: int = 2, *, passes: bool = True) -> bytes:
    """Object file of a program in LLVM's language.

    Args:
      text: The program.
      level: At which machine code is chosen, 1 or 2, and the highest of other passes.
      passes: Whether it is optimised before.
    """
    # Where the environment says 0, machine code is still chosen at this level. At 0 that would take
    # a fourth of the time, but multiplications and additions are fused here and not there, and the
    # bits of a world then depend on its neighbours.
    machine = _machine(level)
    module = binding.parse_assembly(text)
    module.triple = machine.triple
    if not passes:
        return machine.emit_object(module)
    options = binding.create_pipeline_tuning_options(speed_level=min(level, _level()))
    # Everything is in vectors already, and loops over links are to stay loops.
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    builder = binding.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


class Loaded:
    """An object file in memory, for the rest of the process."""

    def __init__(self, code: bytes):
        """Loads it; functions of the C library are found by their names."""
        engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
        engine.add_object_file(binding.ObjectFileRef.from_data(code))
        engine.finalize_object()
        self.engine = engine
        # Threads of XLA may still be in the code when the interpreter ends: it is never freed.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(engine))

    def function(self, name: str) -> int:
        return self.engine.get_function_address(name)

    def numbers(self, name: str, count: int) -> Any:
        """A global variable of 64-bit numbers, to read and to write."""
        return (ctypes.c_uint64 * count).from_address(self.engine.get_global_value_address(name))


def known(name: str) -> bool:
    return name in _loaded


def prepare(text: str, *, keep: bool = True) -> Loaded:
    """A handler in memory; `keep`: whether it may be found on disk, and kept there."""
    name = f"handler_{reuse.digest(text, *identity())}"
    file = reuse.Kept(reuse.kernel_file(name) if keep else None)
    # It runs for microseconds.
    return Loaded(file.read() or file.write(compile(text, passes=False)))


def supply(name: str, loaded: Loaded, make: Callable[[], int]) -> threading.Thread:
    """Gives a handler the address of its kernel, which a thread makes; an error is its calls'."""
    place = loaded.numbers(awaited(name), 2)

    def work() -> None:
        try:
            place[0] = make()
        except Exception as error:  # LLVM's, the driver's: whatever it is, nobody waits for ever
            text = ctypes.create_string_buffer(f"kernel {name}: {error}".encode())
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(text))  # XLA's threads read it
            place[1] = ctypes.addressof(text)
            place[0] = FAILED

    # The interpreter waits for it before it ends: LLVM's code is not taken away under it.
    thread = threading.Thread(target=work, name=f"compiles {name}")
    thread.start()
    return thread


def register(name: str, loaded: Loaded, platform: str) -> None:
    """Makes a handler known to XLA."""
    try:
        ffi.register(name, loaded.function(name), platform)
    except ffi.KernelUnavailable as error:
        sizes = loaded.numbers(seen(name), len(SEEN))
        structures = (ffi.CallFrame, ffi.Api, ffi.Metadata)
        for what, size, structure in zip(SEEN, sizes, structures, strict=True):
            if size and size < ffi.size(structure):
                raise ffi.KernelUnavailable(
                    f"XLA's {what} has {size} bytes; handlers are written for {ffi.size(structure)}"
                ) from error
        raise
    _loaded[name] = loaded
