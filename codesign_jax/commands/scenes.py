"""`codesign scenes`."""

from rich import box
from rich.table import Column, Table

from codesign_jax import scene as scenes
from codesign_jax.commands.flags import Scenes
from codesign_jax.scene import effects, library, schema
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console


def main(options: Scenes) -> int:
    if options.engine is not None and options.engine not in effects.ENGINES:
        hint = schema.nearest(options.engine, effects.ENGINES)
        raise InputError.of("unknown", f"--engine {options.engine!r} is not valid; {hint}")
    engines = effects.ENGINES if options.engine is None else (options.engine,)
    names = library.available("scenes") if options.name is None else [options.name]
    console = Console(soft_wrap=False)
    for scene in [scenes.load(name) for name in names]:
        console.print(f"{scene.name}: {' '.join(scene.description.split())}")
        if options.name or options.engine:
            console.print(_table(scene, engines))
    for kind in () if options.name else ("hands", "objects", "controls", "accuracy"):
        console.print(f"{kind}: {', '.join(library.available(kind))}")
    return 0


def _table(scene: scenes.Scene, engines: tuple[str, ...]) -> Table:
    # A narrow console breaks between words, never inside a name that a scene file may have.
    states = [Column(engine, min_width=len("unsupported")) for engine in engines]
    table = Table(Column("effect", no_wrap=True), *states, "meaning", box=box.SIMPLE)
    for name, effect in effects.EFFECTS.items():
        cells = [effects.state(scene.effects, name, engine) for engine in engines]
        table.add_row(name, *cells, effect.meaning)
    return table
