"""`codesign studio`: a hand on a page, simulated again as its sliders move.

Each tab of a browser is a `Tab` with a design of its own. One thread simulates for all of them in
turns, a step at a time, so that none waits long for another. A tab that was closed asks for
nothing.
"""

import contextlib
import functools
import json
import socket
import threading
import webbrowser
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection

from codesign_jax import preflight
from codesign_jax.commands import common
from codesign_jax.commands.flags import Studio as Options
from codesign_jax.interrupts import interruptible
from codesign_jax.judge.verdict import VERDICTS
from codesign_jax.report import bodies, viewer
from codesign_jax.runs import selection, tables
from codesign_jax.runs.progress import Busy
from codesign_jax.scene.schema import InputError
from codesign_jax.studio import server
from codesign_jax.studio.desk import COUNTS, Desk
from codesign_jax.studio.tab import Tab
from codesign_jax.terminal import Console


def main(options: Options) -> int:
    common.use_compilation_cache()
    problems = common.number_problems(("--port", options.port, 0, 65535))
    common.refuse(problems + common.place_problems("--out", options.out, folder=True))
    console = Console()
    desk = Desk(options)
    scene = desk.case.scene
    space = desk.case.space
    for note in preflight.notes(scene, space, {"the design": desk.case.design}):
        console.print(note)
    serve(desk, console)
    return 0


def serve(desk: Desk, console: Console) -> None:
    """Serves the studio until Ctrl-C; its page waits for the simulation, which is compiled."""
    options = desk.options
    studio = Studio(desk)
    listening, address = studio.listen(options.host, options.port)
    if options.host not in LOCAL:
        common.warn(
            f"--host {options.host}: other machines can reach this page. Its token guards it, but "
            "crosses the network unencrypted, as all else; an ssh tunnel to loopback is safer"
        )
    console.print(f"the studio: {address}")
    console.print("for this user's browser; Ctrl-C ends it")
    with listening:
        serving = threading.Thread(target=listening.serve_forever, daemon=True)
        serving.start()
        if options.open:
            webbrowser.open(address)
        try:
            with Busy(console, "compiling the simulation"):
                studio.begin()
            serving.join()
        finally:
            studio.close()


LOCAL = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine reaches."""


class Studio:
    """The tabs, and the thread that simulates for them."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.tabs: list[Tab] = []
        self._wake = threading.Event()
        self._begun = self._ended = False
        self.guard = server.Guard(_page(), everywhere=desk.options.host not in LOCAL)
        self._messages: dict[str, Any] = {}  # of the newest command, for tabs that connect again

    def listen(self, host: str, port: int) -> tuple[Server, str]:
        """A server whose `serve_forever` serves the studio, and the page's address."""
        try:
            listening = server.listen(self.guard, self.serve, host, port)
        except OSError as error:
            raise InputError.of("file", f"--host {host} --port {port}: {error.strerror}") from error
        named = socket.gethostname() if host in ("0.0.0.0", "::") else host
        named = f"[{named}]" if ":" in named else named
        port = listening.socket.getsockname()[1]
        return listening, f"http://{named}:{port}/?token={self.guard.token}"

    def begin(self) -> None:
        """Compiles what a moved slider needs; from then on tabs get what they ask for."""
        warm = self.desk.bench("").warm
        interruptible(warm, self.desk.case.design, lambda stage: self.tell("stage", stage))
        self._begun = True
        threading.Thread(target=self._work, daemon=True).start()

    def tell(self, kind: str, content: Any) -> None:
        """Sends a message of a command to all tabs, also to those that are opened later."""
        self._messages[kind] = content
        for tab in list(self.tabs):
            tab.send(kind, content)

    def serve(self, connection: ServerConnection) -> None:
        """Serves one tab until it is closed."""
        tab = Tab(self.desk, self.tell)
        self.tabs.append(tab)
        threading.Thread(target=_deliver, args=(tab, connection), daemon=True).start()
        try:
            tab.send("about", about(self.desk))
            if not self._begun:
                tab.send("state", "compiling the simulation: a minute or two the first time ...")
            for kind, content in self._messages.items():
                tab.send(kind, content)
            for text in connection:
                tab.receive(text)
                self._wake.set()
        except ConnectionClosed:
            pass
        finally:
            self.tabs.remove(tab)
            tab.close()

    def close(self) -> None:
        """Ends the work after its step."""
        self._ended = True
        self._wake.set()

    def _work(self) -> None:
        while not self._ended:
            self._wake.clear()
            if not any([tab.step() for tab in list(self.tabs)]):
                self._wake.wait()


def _deliver(tab: Tab, connection: ServerConnection) -> None:
    with contextlib.suppress(ConnectionClosed, OSError):
        while (messages := tab.messages()) is not None:
            for kind, content in messages.items():
                connection.send(json.dumps({kind: content}))


@functools.cache
def _page() -> str:
    body = viewer.web("studio.html").replace("REPLAY", viewer.element("replay"))
    return viewer.page("codesign studio", body, viewer.web("studio.js"))


def about(desk: Desk) -> dict[str, Any]:
    """What a page is told first: the design's parameters, and what there is to choose from."""
    scene = desk.case.scene
    space = desk.case.space
    per_finger, others = tables.by_finger(space)
    fingers = range(scene.num_fingers if per_finger else 0)
    groups = {f"Finger {f}": {k[f]: name for name, k in per_finger.items()} for f in fingers}
    parts = {
        f"Finger {f}": {"part": f"finger {f}", "color": bodies.finger_color(f)} for f in fingers
    }
    for title, morphology in (("Hand", True), ("Control", False)):
        groups[title] = {k: space.names[k] for k in others if space.is_morphology[k] == morphology}
    low, high = (space.in_units(v) for v in (space.low, space.high))
    parameters = [
        {
            "name": space.names[k],
            "label": next(members[k] for members in groups.values() if k in members),
            "unit": space.units[k],
            "low": round(float(low[k]), 9),  # bounds went to SI and back
            "high": round(float(high[k]), 9),
            "step": float(high[k] - low[k]) / 400,
        }
        for k in range(space.num_parameters)
    ]
    run = None
    if desk.record:
        chosen = selection.choose(scene, desk.record)
        particles = desk.record.history.cost.shape[1]
        run = {"episodes": desk.record.done, "particles": particles}
        if judged := desk.judged:
            words = f"The run's verdict on its recommended design: {judged.headline}"
            run |= {"verdict": words, "word": judged.verdict.word}
        run["chosen"] = [chosen.episode + 1, chosen.row]
    source = f"run {desk.options.run_folder}" if run else f"hand {scene.hand.name}"
    return {
        "title": f"{source}, objects {scene.objects.name}, design space {desk.file.preset}",
        "parameters": parameters,
        "groups": [
            {"title": t, "members": [*members]} | parts.get(t, {})
            for t, members in groups.items()
            if members
        ],
        "colors": [bodies.finger_color(f) for f in range(scene.num_fingers)],
        "design": common.shortest(space, desk.case.design),
        "objects": [shape.name for shape in scene.objects.object],
        "accuracies": desk.accuracies,
        "accuracy": desk.accuracy,
        "counts": COUNTS,
        "ends": VERDICTS,
        "worst": scene.cost.maximum,
        "run": run,
    }
