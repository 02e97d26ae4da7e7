"""A grasp in 3D that plays in a browser, offline: one HTML file, or a piece of a page.

The viewer is `web/replay.js`: fingers deform with their links, the camera turns while it plays.  A
browser without WebGL shows a film strip instead, which the page has with it.
"""

import base64
import html
import io
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from codesign_jax import files
from codesign_jax.report import animation, bodies
from codesign_jax.report.replay import Replay
from codesign_jax.scene import Scene

_WEB = Path(__file__).parent / "web"
_TABLE = 0.6  # half side of the table that is drawn [m]
# The skin is drawn with at least so many rings of a link and points of a ring.
_RINGS = 2
_POINTS = 16
_FRAME = 780  # height of a notebook's frame [px]
_NEAR = 0.5  # distance of the strip's camera [m]
_LEAST_FORCE = 1e-3
"""Force [N] from which on a contact is shown."""

_FRAGMENT = """
<div class="replay" id="{name}">
<canvas class="view"></canvas><p class="message"></p><div class="strip"></div>
<div class="controls">
<button class="play" type="button">Play</button>
<div class="track">
<input class="time" type="range" min="0" value="0" step="0.01" aria-label="time [s]">
<div class="phases"></div></div>
<select class="speed" aria-label="speed"><option value="1">1 x</option>
<option value="0.5">0.5 x</option><option value="0.25">0.25 x</option>
<option value="0.1">0.1 x</option>
</select>
<label hidden><input type="checkbox" class="forces"> forces</label>
<label><input type="checkbox" class="turning"> turn</label>
<button class="home" type="button">Reset view</button>
</div>
<div class="label"></div>
</div>
<p class="note turn">Drag to turn, scroll to zoom, shift-drag to move; click a phase to go there.
Forces: contact points, and the force of each finger on the object. A square of the table: 5 cm.</p>
"""
_START = """<script>startReplay(document.getElementById("{name}"), {data});</script>
"""

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>
{style}</style><script>
{script}</script></head><body>
{body}
</body></html>
"""


def fragment(scene: Scene, grasp: Replay, name: str = "replay") -> str:
    """HTML of a grasp, for a page that `page` makes; it plays and turns once it is seen."""
    shown = data(scene, grasp) | {"strip": strip(scene, grasp), "turn": True}
    # "<" appears in no JSON but inside strings, where its escape means the same.
    text = json.dumps(shown).replace("<", "\\u003c")
    return element(name) + _START.format(name=html.escape(name), data=text)


def element(name: str) -> str:
    """HTML of the place where `web/replay.js` shows a grasp."""
    return _FRAGMENT.format(name=html.escape(name))


def page(title: str, body: str, *scripts: str) -> str:
    """A whole page."""
    script = "\n".join([*scripts, web("charts.js"), web("replay.js")])
    return _PAGE.format(title=html.escape(title), style=web("style.css"), script=script, body=body)


def web(name: str) -> str:
    """Text of a file of the folder `web`."""
    return (_WEB / name).read_text(encoding="utf-8")


def write(scene: Scene, grasp: Replay, path: Path, *, title: str, text: list[str]) -> Path:
    """Writes a grasp alone as an HTML file."""
    tags = ["pre" if "\n" in line else "p" for line in text]  # lines of a table stay lines
    lines = "".join(
        f"<{tag}>{html.escape(line)}</{tag}>\n" for tag, line in zip(tags, text, strict=True)
    )
    body = f"<h1>{html.escape(title)}</h1>\n{lines}{fragment(scene, grasp)}"
    files.make_folder_of(path)
    with files.atomically(path) as part:
        part.write_text(page(title, body), encoding="utf-8")
    return path


class Notebook(NamedTuple):
    """A grasp in 3D as the value of a notebook's cell: it plays and turns, see `fragment`."""

    scene: Scene
    grasp: Replay

    def _repr_html_(self) -> str:
        """A page in a frame: whatever a notebook's own page has, the viewer does not meet it."""
        whole = html.escape(page("A grasp in 3D", fragment(self.scene, self.grasp)))
        style = f"width: 100%; height: {_FRAME}px; border: 0"
        return f'<iframe title="a grasp in 3D" srcdoc="{whole}" style="{style}"></iframe>'


def data(scene: Scene, grasp: Replay) -> dict[str, Any]:
    """What web/replay.js reads of a grasp, of JSON's types."""
    motion = bodies.motion(scene, grasp)
    parts = shown_parts(scene, grasp)
    frames, count = motion.pose.shape[:2]
    return {
        "parts": [_part(part) for part in parts],
        "poses": _encode(motion.pose, np.float32),
        "sizes": _encode(motion.size, np.float32) if (motion.size != 1).any() else None,
        "frames": frames,
        "bodies": count,
        "rate": motion.rate,
        "object": int(parts[-1].body[0, 0]),
        "contacts": _contacts(scene, grasp, motion.rate, [part.name for part in parts]),
        "phases": phases(scene),
        "still": scene.phase_ends["lift"],
        "table": _TABLE,
        "camera": {"target": [0.0, 0.0, 0.15], "distance": 0.6, "azimuth": -0.9, "elevation": 0.3},
    }


def shown_parts(scene: Scene, grasp: Replay) -> list[bodies.Part]:
    """The parts that the viewer shows, their skin's mesh fine enough for the eye."""
    return bodies.parts(bodies.finer(scene, _RINGS, _POINTS), grasp)


def _contacts(
    scene: Scene, grasp: Replay, rate: float, names: Sequence[str]
) -> dict[str, str] | None:
    """What presses on the object in each frame, see web/replay.js; None where nobody recorded it.

    Args:
      rate: Frames of a second.
      names: Names of the parts.
    """
    touch = grasp.trace and grasp.trace.forces and grasp.trace.forces.touch
    if not touch:
        return None
    every = round(1 / (rate * scene.discretization.timestep))
    numbers = {"palm": [names.index("palm")], "finger": [*range(scene.num_fingers)]}
    sets = []
    for kind, contacts in touch.items():
        force = contacts.tangential - np.asarray(contacts.pressing)[..., None] * contacts.normal
        rows = np.concatenate([contacts.point, force], -1)[::every]
        rows = rows.reshape(len(rows), len(numbers[kind]), -1, 6)
        part = np.broadcast_to(np.array(numbers[kind])[:, None, None], (*rows.shape[:-1], 1))
        sets.append(np.concatenate([part, rows], -1).reshape(len(rows), -1, 7))
    every_contact = np.concatenate(sets, 1)
    acts = np.linalg.norm(every_contact[..., 4:], axis=-1) > _LEAST_FORCE
    return {
        "count": _encode(acts.sum(1), np.uint16),
        "values": _encode(every_contact[acts], np.float32),
    }


def strip(scene: Scene, grasp: Replay) -> list[tuple[str, str]]:
    """Pictures of a grasp at the ends of its phases: captions, and WebP files in base64."""
    ends = [("start", 0.0), *phases(scene)]
    spans = [
        (later - first, k) for k, ((_, first), (_, later)) in enumerate(itertools.pairwise(ends))
    ]
    k = max(spans)[1]
    amid = (f"amid {ends[k + 1][0]}", (ends[k][1] + ends[k + 1][1]) / 2)
    moments = [("start", 0.0), *((f"end of {name}", end) for name, end in ends[1:])]
    moments.insert(k + 1, amid)
    times = np.array([time for _, time in moments])
    captioned = []
    camera = animation.following(scene, grasp, times, animation.CAMERA._replace(distance=_NEAR))
    pictures = animation.frames(scene, grasp, times, size=(240, 240), camera=camera)
    for (caption, time), frame in zip(moments, pictures, strict=True):
        file = io.BytesIO()
        Image.fromarray(frame).save(file, "webp", quality=80)
        picture = base64.b64encode(file.getvalue()).decode()
        captioned.append((f"{caption}, {time:g} s", picture))
    return captioned


def phases(scene: Scene) -> list[tuple[str, float]]:
    """Names and end times [s] of the phases that a scene has, in order."""
    return [("release" if n == "ungrasp" else n, end) for n, end in scene.phase_ends.items()]


def _part(part: bodies.Part) -> dict[str, Any]:
    kinds = {"body": np.uint16, "face": np.uint32}
    arrays = {
        name: _encode(getattr(part, name), kinds.get(name, np.float32))
        for name in ("first", "second", "body", "weight", "face")
    }
    return {"name": part.name, "color": part.color} | arrays


def _encode(array: np.ndarray, kind: type) -> str:
    little = np.dtype(kind).newbyteorder("<")
    return base64.b64encode(np.ascontiguousarray(array, little).tobytes()).decode()
