"""An MjSpec as MJCF text that compiles to the same numbers.

MuJoCo's own writer keeps six digits of a number.  A grasp is chaotic once fingers slide on the
object, so that six digits are another grasp; here every number that the writer abbreviates is
replaced by the compiled model's, in as many digits as name a float64.
"""

from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

_DIFFERENCE = 1e-12
"""Relative difference between numbers of a model and of its file: rounding of unit vectors."""

# The signature of the spec's whole text, and its strings. Skins are for looking at only.
_NOT_PHYSICS = ("signature", "names")


def text(spec: mujoco.MjSpec) -> str:
    """Returns MJCF that plain MuJoCo compiles to the same model as the spec, to rounding."""
    model = spec.compile()
    root = ElementTree.fromstring(spec.to_xml())
    for element, parent in _walk(root, None):
        for attribute, value in _numbers(spec, model, element, parent).items():
            element.set(attribute, " ".join(repr(float(v)) for v in np.ravel(value)))
    ElementTree.indent(root)
    xml = ElementTree.tostring(root, encoding="unicode") + "\n"
    if lost := differences(model, mujoco.MjModel.from_xml_string(xml)):
        raise RuntimeError(f"numbers of the model that its MJCF does not have: {', '.join(lost)}")
    return xml


def differences(first: mujoco.MjModel, second: mujoco.MjModel) -> list[str]:
    """Names of the arrays and options in which two models differ by more than rounding."""
    names = [n for n in dir(first) if not n.startswith(("_", "skin_")) and n not in _NOT_PHYSICS]
    options = [n for n in dir(first.opt) if not n.startswith("_")]
    pairs = [(n, getattr(first, n), getattr(second, n)) for n in names]
    pairs += [(f"opt.{n}", getattr(first.opt, n), getattr(second.opt, n)) for n in options]
    return [name for name, a, b in pairs if not _same(a, b)]


def _same(a: Any, b: Any) -> bool:
    if not isinstance(a, (int, float, np.ndarray)):
        return True  # methods, and structures without numbers of their own
    a = np.asarray(a)
    b = np.asarray(b)
    if a.shape != b.shape:
        return False
    scale = np.abs(a).max(initial=0.0)
    return bool(np.all(np.abs(a.astype(float) - b) <= _DIFFERENCE * scale))


def _walk(element: ElementTree.Element, parent: ElementTree.Element | None):
    yield element, parent
    for child in element:
        yield from _walk(child, element)


def _numbers(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    element: ElementTree.Element,
    parent: ElementTree.Element | None,
) -> dict[str, Any]:
    if element.tag == "option":
        o = model.opt
        names = ("timestep", "gravity", "impratio", "tolerance")
        return {name: getattr(o, name) for name in names}
    if element.tag == "pair" and parent is not None and parent.tag == "contact":
        geoms = [model.geom(element.get(key)).id for key in ("geom1", "geom2")]
        pairs = np.stack([model.pair_geom1, model.pair_geom2], 1)
        index = np.nonzero((pairs == geoms).all(1) | (pairs == geoms[::-1]).all(1))[0][0]
        names = ("friction", "solref", "solimp")
        return {name: getattr(model, f"pair_{name}")[index] for name in names}
    if element.tag == "inertial" and parent is not None:
        return _written(element, _INERTIAL, model.body(parent.get("name")))
    if element.tag == "mesh":
        return {"vertex": spec.mesh(element.get("name")).uservert}
    if element.get("type") == "mesh":
        return {}  # the compiled model has geom and vertices in the frame of its inertia
    accessor, names = _NAMED.get(element.tag, (None, {}))
    if accessor is None or element.get("name") is None:
        return {}
    return _written(element, names, accessor(model)(element.get("name")))


def _written(element: ElementTree.Element, names: dict[str, str], values: Any) -> dict[str, Any]:
    """Numbers of those attributes that the writer has given; others have MuJoCo's default."""
    numbers = {}
    for attribute, field in names.items():
        if (entry := element.get(attribute)) is not None:
            numbers[attribute] = np.ravel(getattr(values, field))[: len(entry.split())]
    return numbers


_INERTIAL = {"pos": "ipos", "quat": "iquat", "mass": "mass", "diaginertia": "inertia"}
_NAMED: dict[str, tuple[Callable[[mujoco.MjModel], Callable], dict[str, str]]] = {
    "body": (lambda m: m.body, {"pos": "pos", "quat": "quat"}),
    "joint": (
        lambda m: m.joint,
        {"stiffness": "stiffness", "damping": "damping", "armature": "armature"},
    ),
    "geom": (lambda m: m.geom, {"size": "size", "pos": "pos", "quat": "quat"}),
    "camera": (lambda m: m.camera, {"pos": "pos", "quat": "quat"}),
    "general": (lambda m: m.actuator, {"gainprm": "gainprm", "biasprm": "biasprm"}),
    "key": (lambda m: m.key, {"time": "time", "qpos": "qpos", "qvel": "qvel", "ctrl": "ctrl"}),
    "numeric": (lambda m: m.numeric, {"data": "data"}),
}
